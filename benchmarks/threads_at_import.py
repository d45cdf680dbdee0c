"""Start of pools in a program whose main module makes a JAX array when it is imported.

    python -m benchmarks.threads_at_import --workers 2 8

Prints seconds from the call of `Pool(n)` until a first map is done whose tasks use JAX, for the
program's first pool and for its second.  Each line is a new program.  Needs jax.
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median

CONTENDERS = {
    "Fiber": "import fiber as mp",
    "multiprocessing, forkserver": "mp = multiprocessing.get_context('forkserver')",
    "multiprocessing, spawn": "mp = multiprocessing.get_context('spawn')",
}
PROGRAM = """\
import multiprocessing, sys, time
import jax.numpy as jnp

ONES = jnp.ones((64, 64))

def task(number):
    return float((ONES @ jnp.full((64,), float(number))).sum())

if __name__ == "__main__":
    {contender}
    workers = int(sys.argv[1])
    for _ in range(2):
        begin = time.perf_counter()
        with mp.Pool(workers) as pool:
            pool.map(task, range(workers), 1)
            print(time.perf_counter() - begin, flush=True)
"""


def measure(contender: str, workers: int) -> list[float]:
    """Return seconds until the first map of the first and of the second pool of a new program."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder, "program.py")
        program.write_text(PROGRAM.format(contender=CONTENDERS[contender]))
        done = subprocess.run(
            [sys.executable, str(program), str(workers)],
            check=True,
            capture_output=True,
            text=True,
            timeout=600,
        )
    return [float(line) for line in done.stdout.split()]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 1 if jax is not installed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 8])
    parser.add_argument("--programs", type=int, default=3, help="programs for each median")
    options = parser.parse_args(arguments)
    if importlib.util.find_spec("jax") is None:
        print("jax is not installed: python -m pip install jax", file=sys.stderr)
        return 1
    print(f"{'':27}  workers  first pool  second pool   (median of {options.programs} programs)")
    for workers in options.workers:
        for contender in CONTENDERS:
            rounds = [measure(contender, workers) for _ in range(options.programs)]
            first, second = map(median, zip(*rounds, strict=True))
            print(f"{contender:27}  {workers:7}  {first:8.2f} s  {second:9.2f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
