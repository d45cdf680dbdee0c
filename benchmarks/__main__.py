"""`python -m benchmarks` in the repository is `python benchmarks/run.py` anywhere."""

import sys

from benchmarks.command import main

sys.exit(main(sys.argv[1:]))
