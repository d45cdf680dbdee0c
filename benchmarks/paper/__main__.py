"""`python -m benchmarks.paper`: see command.py."""

import sys

try:
    from benchmarks.paper.command import main
except ModuleNotFoundError as error:
    sys.exit(
        f"benchmarks.paper needs {error.name}, which is not installed: make paper installs it, and "
        "pip install numpy matplotlib does"
    )

sys.exit(main(sys.argv[1:]))
