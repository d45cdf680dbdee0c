"""Program that `endings` ends: a pool whose workers sleep while the program waits.

Run as a file, as a user's program is: `python endless_program.py CONTENDER`.
"""

import sys
import time


def report(number: int) -> int:
    """Give the argument back from a worker that is up."""
    return number


def main(contender: str) -> None:
    """Say on standard output that the workers are up, then wait for ever."""
    if contender.startswith("fiber"):
        import fiber as mp
    else:
        import multiprocessing as mp  # type: ignore[no-redef]  # the same face
    pool = mp.Pool(2)
    pool.map(report, range(8), 1)
    result = pool.map_async(time.sleep, [3600.0] * 100, 1)
    print("ready", flush=True)
    result.get()


if __name__ == "__main__":
    main(sys.argv[1])
