"""Runs simulated schedules outside of the tests.

python tests/simulation/run.py ledger 1234             one seed: what is planned, what happens
python tests/simulation/run.py ledger 10000 60000      many: stops at the first that fails
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from simulation.explore import Failure, describe, examine, run
from simulation.schedule import draw
from simulation.suites import SUITES, again


def show(suite: str, seed: int) -> bool:
    """Print the events of one schedule.  Return False if it breaks a promise."""
    schedule = draw(seed)
    trace: list[str] = []
    error = run(schedule, SUITES[suite], trace)
    print("planned:", *describe(schedule), "what happens:", *trace, sep="\n  ")
    return error is None


def search(suite: str, seeds: range) -> bool:
    """Run many; False if one breaks a promise, which is printed as small as it can be made."""
    began = time.perf_counter()
    for seed in seeds:
        try:
            examine(seed, SUITES[suite], again(suite, seed))
        except Failure as failure:
            print(failure)
            return False
    rate = len(seeds) / (time.perf_counter() - began)
    print(f"{len(seeds)} schedules keep all promises, {rate:.0f} a second")
    return True


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("suite", choices=SUITES)
    parser.add_argument("first", type=int, help="a seed")
    parser.add_argument("stop", type=int, nargs="?", help="the seed behind the last one")
    options = parser.parse_args()
    stop = options.stop or options.first + 1
    good = options.stop or show(options.suite, options.first)
    return 0 if good and search(options.suite, range(options.first, stop)) else 1


if __name__ == "__main__":
    sys.exit(main())
