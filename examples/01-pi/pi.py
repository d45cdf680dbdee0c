"""Estimate pi by throwing darts: the paper's first listing as it is printed there.

Only the optional argument, the number of darts, was added.
"""
# mypy: allow-untyped-defs, allow-untyped-calls
# ruff: noqa: UP032

import random
import sys

import fiber


def worker(p):
    # Runs in the pool, once for every dart: did it land inside the quarter circle?
    return random.random() ** 2 + random.random() ** 2 < 1


def main():
    NUM_SAMPLES = int(float(sys.argv[1])) if len(sys.argv) > 1 else int(1e7)
    # Four processes; pool.map deals the range out to them and keeps the answers in order.
    pool = fiber.Pool(processes=4)
    count = sum(pool.map(worker, range(0, NUM_SAMPLES)))
    print("Pi is roughly {}".format(4.0 * count / NUM_SAMPLES))


if __name__ == "__main__":
    main()
