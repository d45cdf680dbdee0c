"""Program that `coldstart` starts: a pool, its first map, and the moments of both.

Run as a file, as a user's program is: `python cold_program.py CONTENDER WORKERS NAMED_PIPE`. It
imports no module that the measure would then count, and ends when its standard input does.
"""

import os
import sys
import time


def stamp(path: str, what: str = "worker") -> None:
    """Write to the reader of the named pipe that this moment has come, by the machine's clock."""
    fd = os.open(path, os.O_WRONLY)
    os.write(fd, f"{what} {time.monotonic_ns()}\n".encode())
    os.close(fd)


def no_op(item: int) -> int:
    """Give the argument back."""
    return item


def main(contender: str, workers: int, path: str) -> None:
    """Do what a user's program does first."""
    if contender.startswith("fiber"):
        import fiber as mp
    else:
        import multiprocessing

        method = "forkserver" if contender == "forkserver" else "fork"
        mp = multiprocessing.get_context(method)  # type: ignore[assignment]  # the same face
    pool = mp.Pool(workers, stamp, (path,))
    pool.map(no_op, range(workers))
    stamp(path, "map")
    sys.stdin.readline()
    pool.terminate()
    pool.join()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3])
