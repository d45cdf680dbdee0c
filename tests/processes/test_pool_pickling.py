"""Items whose pickling, on a thread of their pool's, waits for something."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

import fiber
from fiber.errors import FiberError
from fiber.pool import Pool
from patience import PATIENCE
from processes.pool_programs import wait_until


class Asking:
    """Travels as the number that it asks for as it is pickled."""

    def __init__(self, ask: Callable[[], Any]) -> None:
        self._ask = ask

    def __reduce__(self) -> tuple[Any, ...]:
        return int, (self._ask(),)


absolute: Callable[[Any], Any] = abs
"""An item is a number only once it has travelled."""


def end(pool: Pool) -> None:
    pool.close()
    pool.join()


WAITS: dict[str, Callable[[Pool], Any]] = {
    "apply": lambda pool: pool.apply(abs, (-1,)),
    # A task may wait for results that exist, so these two ask for something that ends with the
    # pool.
    "apply_async": lambda pool: pool.apply_async(time.sleep, (PATIENCE,)).get(),
    "broadcast": lambda pool: pool.broadcast(abs, -1),
    "map": lambda pool: pool.map(abs, [-1]),
    "map an iterator": lambda pool: pool.map(abs, iter([-1])),
    "imap": lambda pool: next(pool.imap(time.sleep, [PATIENCE])),
    "join": end,
}


@pytest.mark.parametrize("ask", WAITS.values(), ids=WAITS.keys())
def test_a_wait_for_the_same_pool_is_refused(ask: Callable[[Pool], Any]) -> None:
    with fiber.Pool(1) as pool:
        found = pool.map_async(absolute, [Asking(lambda: ask(pool))])
        with pytest.raises(RuntimeError, match="cannot wait for a result of the same pool"):
            found.get(PATIENCE)
    pool.join()


def test_the_pickling_thread_may_get_a_result_that_is_ready() -> None:
    with fiber.Pool(1) as pool:
        result = pool.apply_async(abs, (-1,))
        result.wait(PATIENCE)
        assert pool.map_async(absolute, [Asking(result.get)]).get(PATIENCE) == [1]
    pool.join()


def test_another_pool_may_be_waited_for() -> None:
    with fiber.Pool(1) as pool, fiber.Pool(1) as other:
        found = pool.map_async(absolute, [Asking(lambda: other.apply(abs, (-1,)))])
        assert found.get(PATIENCE) == [1]
    pool.join()
    other.join()


def test_a_pool_may_be_terminated_while_another_worker_waits_to_be_started() -> None:
    with fiber.Pool(min_workers=1, max_workers=2) as pool:

        def terminate() -> None:
            members = pool._executor._scheduler.workers.members
            wait_until(lambda: len(members) == 2, "another worker is wanted")
            pool.terminate()

        found = pool.map_async(absolute, [Asking(terminate), 1])
        with pytest.raises(FiberError, match="terminated"):
            found.get(PATIENCE)
    pool.join()
