"""Run a script as Python would, with its random number generators seeded:

python script.py SEED PROGRAM [OPTION…]
"""

from __future__ import annotations

import importlib.util
import random
import runpy
import sys
from pathlib import Path

if __name__ == "__main__":
    seed, program, *options = sys.argv[1:]
    random.seed(int(seed))
    if importlib.util.find_spec("numpy"):
        import numpy as np

        np.random.seed(int(seed))
    sys.argv = [program, *options]
    sys.path[0] = str(Path(program).parent)
    runpy.run_path(program, run_name="__main__")
