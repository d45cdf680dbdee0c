"""Program whose live page the documentation shows."""

from __future__ import annotations

import os
import random
import signal
import sys
import time

import fiber


def simulate(seed: int) -> int:
    """Stand for an episode of uneven length; a few fail."""
    time.sleep(random.Random(seed).uniform(0.02, 0.3))
    if seed % 120 == 7:
        raise ValueError("the simulator diverged")
    return seed


def evaluate(seed: int) -> int:
    """Stand for a longer test of a policy."""
    time.sleep(random.Random(seed).uniform(0.4, 0.8))
    return seed


def main() -> None:
    """Play a few generations, and lose a worker."""
    with fiber.Pool(24) as pool:
        for generation in range(3):
            episodes = pool.map_async(simulate, range(generation * 700, generation * 700 + 700))
            if generation == 1:
                time.sleep(1.0)
                worker = pool.workers()[5]
                if worker.pid is not None:
                    os.kill(worker.pid, signal.SIGKILL)
            episodes.wait()
            if generation < 2:
                pool.map(evaluate, range(48), chunksize=1)
            else:
                pool.map_async(evaluate, range(1200), chunksize=1)
        print("begun", flush=True)
        sys.stdin.readline()


if __name__ == "__main__":
    fiber.init(dashboard=True)
    main()
