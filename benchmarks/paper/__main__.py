"""`python -m benchmarks.paper`: see command.py."""

import sys

from benchmarks.paper.command import main

sys.exit(main(sys.argv[1:]))
