"""Places are taken in turn by namespace, and a place that is given up is never lost."""

from __future__ import annotations

import asyncio

from fakes import virtual_time
from fiber_operator.cluster import NamespaceSemaphore
from fiber_operator.lease_monitor import in_turn
from fiber_operator.workqueue import Key


def test_a_namespace_does_not_wait_for_all_calls_of_another() -> None:
    begun: list[str] = []

    async def call(turns: NamespaceSemaphore, namespace: str) -> None:
        async with turns.take(namespace):
            begun.append(namespace)
            await asyncio.sleep(1)

    async def main() -> None:
        turns = NamespaceSemaphore(2)
        calls = [asyncio.create_task(call(turns, "flood")) for _ in range(100)]
        await asyncio.sleep(0.5)
        calls += [asyncio.create_task(call(turns, name)) for name in ("a", "b", "a")]
        await asyncio.gather(*calls)

    virtual_time.run(main())
    assert begun[:8] == ["flood", "flood", "flood", "a", "b", "flood", "a", "flood"]
    assert len(begun) == 103


def test_a_call_that_is_cancelled_gives_its_place_to_another() -> None:
    async def hold(turns: NamespaceSemaphore, released: asyncio.Event) -> None:
        async with turns.take("a"):
            await released.wait()

    async def main() -> None:
        turns, released = NamespaceSemaphore(1), asyncio.Event()
        first, second, third = (asyncio.create_task(hold(turns, released)) for _ in range(3))
        await asyncio.sleep(0)
        first.cancel()
        await asyncio.wait([first])
        # The place is the second's, which has not run since.
        second.cancel()
        await asyncio.wait([second])
        released.set()
        await third
        async with asyncio.timeout(1), turns.take("b"):
            pass

    virtual_time.run(main())


def test_keys_are_taken_one_of_each_namespace_after_the_other() -> None:
    keys = [Key("flood", "1"), Key("flood", "2"), Key("flood", "3"), Key("a", "1"), Key("b", "1")]
    assert in_turn(keys) == [keys[0], keys[3], keys[4], keys[1], keys[2]]
    assert in_turn([]) == []
