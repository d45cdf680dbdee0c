"""Measure Fiber beside multiprocessing and its peers: `python benchmarks/run.py --help`."""

import sys
from pathlib import Path

if __name__ == "__main__":
    # In place of this folder, whose module `pipes` would shadow the standard library's.
    sys.path[0] = str(Path(__file__).resolve().parent.parent)
    from benchmarks.command import main

    sys.exit(main(sys.argv[1:]))
