"""Program that `jax_start` starts: its main module makes a JAX array when it is imported.

Run as a file, as a user's program is: `python jax_program.py CONTENDER WORKERS`. It prints the
seconds from the call of `Pool` until a first map is complete, for its first and its second pool.
"""

import sys
import time

import jax.numpy as jnp

ONES = jnp.ones((64, 64))


def task(number: int) -> float:
    """Multiply two arrays."""
    return float((ONES @ jnp.full((64,), float(number))).sum())


def main(contender: str, workers: int) -> None:
    """Make two pools, one after the other."""
    if contender.startswith("fiber"):
        import fiber as mp
    else:
        import multiprocessing

        mp = multiprocessing.get_context(contender)  # type: ignore[assignment]  # the same face
    for _ in range(2):
        begin = time.perf_counter()
        with mp.Pool(workers) as pool:
            pool.map(task, range(workers), 1)
            print(time.perf_counter() - begin, flush=True)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
