"""`python -m benchmarks.operator_scale` in the repository; `make bench-operator` prepares it."""

import sys

from benchmarks.operator_scale.command import main

sys.exit(main(sys.argv[1:]))
