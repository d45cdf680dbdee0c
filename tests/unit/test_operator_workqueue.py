"""The queue of pools: each once, one reconcile at a time, in time."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine
from typing import Any

import pytest

from fakes import virtual_time
from fiber_operator.workqueue import (
    FIRST_BACKOFF,
    GAP,
    LONGEST_BACKOFF,
    MOST_RUNNING,
    PAUSE,
    Key,
    Result,
    WorkQueue,
)

A, B = Key("team", "a"), Key("team", "b")


class Reconciler:
    """Gives each reconcile the result that a test set, and writes down when it began."""

    def __init__(self) -> None:
        self.result: Result | Exception = Result()
        self.lasts = 0.0
        self.begun: list[tuple[float, Key]] = []
        self.at_once = self.most_at_once = 0

    async def __call__(self, key: Key) -> Result:
        self.begun.append((round(asyncio.get_running_loop().time(), 3), key))
        self.at_once += 1
        self.most_at_once = max(self.most_at_once, self.at_once)
        await asyncio.sleep(self.lasts)
        self.at_once -= 1
        if isinstance(self.result, Exception):
            raise self.result
        return self.result

    def times(self, key: Key = A) -> list[float]:
        return [when for when, whose in self.begun if whose == key]


@contextlib.asynccontextmanager
async def a_queue(concurrency: int = 8) -> AsyncIterator[tuple[WorkQueue, Reconciler]]:
    reconciler = Reconciler()
    queue = WorkQueue(reconciler, concurrency=concurrency)
    task = asyncio.ensure_future(queue.run())
    try:
        yield queue, reconciler
    finally:
        task.cancel()
        await asyncio.wait([task])


Test = Callable[[WorkQueue, Reconciler], Coroutine[Any, Any, None]]


def played(concurrency: int = 8) -> Callable[[Test], Callable[[], None]]:
    def decorate(test: Test) -> Callable[[], None]:
        async def main() -> None:
            async with a_queue(concurrency) as (queue, reconciler):
                await test(queue, reconciler)

        return lambda: virtual_time.run(main())

    return decorate


@played()
async def test_an_added_pool_is_reconciled_at_once(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    queue.add(A)
    await asyncio.sleep(10)
    assert reconciler.begun == [(0.0, A)]


@played()
async def test_a_thousand_additions_are_one_reconcile(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    for _ in range(1000):
        queue.add(A)
    await asyncio.sleep(10)
    assert reconciler.begun == [(0.0, A)]


@played()
async def test_additions_during_a_turn_are_one_more(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    reconciler.lasts = 3.0
    queue.add(A)
    await asyncio.sleep(1)
    for _ in range(10):
        queue.add(A)
    await asyncio.sleep(30)
    assert reconciler.times() == [0.0, 3.0 + GAP]
    assert reconciler.most_at_once == 1


@played()
async def test_events_wait_for_the_gap_and_urgent_ones_do_not(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    queue.add(A)
    await asyncio.sleep(0.1)
    queue.add(A)
    await asyncio.sleep(1)
    assert reconciler.times() == [0.0, GAP]
    queue.add(A)
    await asyncio.sleep(0.1)
    queue.add(A, urgent=True)
    await asyncio.sleep(1)
    assert reconciler.times()[2:] == [1.1, 1.2]


@played()
async def test_urgent_ones_during_a_turn_follow_at_once(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    reconciler.lasts = 2.0
    queue.add(A)
    await asyncio.sleep(1)
    queue.add(A, urgent=True)
    await asyncio.sleep(10)
    assert reconciler.times() == [0.0, 2.0]


@played()
async def test_a_pool_always_rests_between_reconciles(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    reconciler.result = Result(rest=4.0)
    queue.add(A)
    await asyncio.sleep(1)
    queue.add(A, urgent=True)
    await asyncio.sleep(20)
    assert reconciler.times() == [0.0, 4.0]


@played()
async def test_a_pause_of_the_events_ends_a_rest(queue: WorkQueue, reconciler: Reconciler) -> None:
    reconciler.result = Result(rest=4.0, early=True)
    queue.add(A)
    await asyncio.sleep(1)
    queue.add(A)
    await asyncio.sleep(PAUSE / 2)
    queue.add(A)
    await asyncio.sleep(20)
    assert reconciler.times() == pytest.approx([0.0, 1 + 1.5 * PAUSE])


@played()
async def test_a_shortened_rest_makes_the_next_rest_longer(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    reconciler.result = Result(rest=4.0, early=True)
    queue.add(A)
    await asyncio.sleep(1)
    queue.add(A)
    await asyncio.sleep(1)
    queue.add(A)  # it has not rested from its second reconcile and would owe for two
    await asyncio.sleep(20)
    assert reconciler.times() == pytest.approx([0.0, 1 + PAUSE, 8.0])


@played()
async def test_a_pool_rests_while_events_do_not_pause(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    reconciler.result = Result(rest=4.0, early=True)
    queue.add(A)
    for _ in range(90):
        await asyncio.sleep(PAUSE / 1.5)
        queue.add(A)
    assert reconciler.times() == pytest.approx([0.0, 4.0, 8.0])


@played()
async def test_no_pause_ends_the_rest_of_a_failed_pool(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    reconciler.result = Result(failed=True, rest=4.0, early=True)
    queue.add(A)
    await asyncio.sleep(1)
    queue.add(A)
    await asyncio.sleep(2)
    assert reconciler.times() == [0.0]


@played()
async def test_a_turn_may_ask_for_another(queue: WorkQueue, reconciler: Reconciler) -> None:
    reconciler.result = Result(requeue_after=7.0)
    queue.add(A)
    await asyncio.sleep(20)
    assert reconciler.times() == [0.0, 7.0, 14.0]


@played()
async def test_the_earlier_wish_wins(queue: WorkQueue, reconciler: Reconciler) -> None:
    queue.add(A, delay=100)
    queue.add(A, delay=5)
    queue.add(A, delay=50)
    await asyncio.sleep(200)
    assert reconciler.times() == [5.0]


@pytest.mark.parametrize("result", [Result(failed=True), RuntimeError("a fault of ours")], ids=str)
def test_failures_are_repeated_later_each_time(result: Result | Exception) -> None:
    @played()
    async def test(queue: WorkQueue, reconciler: Reconciler) -> None:
        reconciler.result = result
        queue.add(A)
        await asyncio.sleep(119)
        assert reconciler.times() == [0.0, 0.5, 1.5, 3.5, 7.5, 15.5, 31.5, 61.5, 91.5]
        reconciler.result = Result()
        await asyncio.sleep(10)
        reconciler.result = result
        queue.add(A)
        await asyncio.sleep(1)
        assert len(reconciler.begun) == 12, "after a success the wait begins anew"

    test()


@played()
async def test_an_event_shortens_the_wait_after_a_failure(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    reconciler.result = Result(failed=True)
    queue.add(A)
    await asyncio.sleep(40)
    queue.add(A, urgent=True)
    await asyncio.sleep(0.1)
    assert reconciler.times()[-1] == 40.0
    for _ in range(100):
        queue.add(A, urgent=True)
        await asyncio.sleep(0.01)
    assert len(reconciler.times()) == 9, "but not without any pause"


@played()
async def test_a_server_that_asks_to_wait_is_obeyed(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    reconciler.result = Result(failed=True, rest=20.0)
    queue.add(A)
    await asyncio.sleep(1)
    queue.add(A, urgent=True)
    await asyncio.sleep(25)
    assert reconciler.times() == [0.0, 20.0]


@played(concurrency=2)
async def test_pools_take_turns_side_by_side(queue: WorkQueue, reconciler: Reconciler) -> None:
    reconciler.lasts = 1.0
    for number in range(6):
        queue.add(Key("team", str(number)))
    await asyncio.sleep(0.5)
    assert (queue.statistics().running, queue.statistics().waiting) == (2, 4)
    await asyncio.sleep(10)
    assert reconciler.most_at_once == 2
    assert [when for when, _ in reconciler.begun] == [0.0, 0.0, 1.0, 1.0, 2.0, 2.0]


class Trouble(Reconciler):
    """Reconciler of pools in the namespace ``bad`` last and fail."""

    async def __call__(self, key: Key) -> Result:
        self.begun.append((asyncio.get_running_loop().time(), key))
        bad = key.namespace == "bad"
        await asyncio.sleep(10.0 if bad else 0.1)
        return Result(failed=bad)


async def in_trouble(queue: WorkQueue, pools: int, since: float) -> None:
    for number in range(pools):
        queue.add(Key("bad", str(number)))
    await asyncio.sleep(since)


@pytest.mark.parametrize("since", [0.0, 3.0, 60.0, 200.0])
@pytest.mark.parametrize("pools", [8, 40])
def test_pools_in_trouble_do_not_hold_up_the_others(pools: int, since: float) -> None:
    async def main() -> None:
        reconciler = Trouble()
        queue = WorkQueue(reconciler, concurrency=8)
        task = asyncio.ensure_future(queue.run())
        await in_trouble(queue, pools, since)
        added = asyncio.get_running_loop().time()
        queue.add(A)
        await asyncio.sleep(60)
        (began,) = reconciler.times()
        # What never had a reconcile cannot be known to be in trouble.
        assert began - added <= (12.0 if since < 10 else 1.0)
        task.cancel()
        await asyncio.wait([task])

    virtual_time.run(main())


@played(concurrency=1)
async def test_a_failing_pool_is_not_forgotten(queue: WorkQueue, reconciler: Reconciler) -> None:
    reconciler.result = Result(failed=True)
    queue.add(A)
    await asyncio.sleep(0.1)
    reconciler.result, reconciler.lasts = Result(), 1.0

    async def add_others() -> None:
        for number in range(60):
            queue.add(Key("team", str(number)))
            queue.add(Key("team", f"{number}-too"))
            await asyncio.sleep(1)

    await asyncio.wait_for(add_others(), 100)
    assert 10 < reconciler.times()[1] < 30


@played(concurrency=2)
async def test_a_turn_that_lasts_hands_its_place_on_to_so_many(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    reconciler.lasts = 100.0
    for number in range(20):
        queue.add(Key("team", str(number)))
    await asyncio.sleep(50)
    assert [when for when, _ in reconciler.begun] == [0, 0, 2, 2, 4, 4, 6, 6]
    assert reconciler.most_at_once == MOST_RUNNING * 2


@played()
async def test_a_pool_that_is_gone_is_forgotten(queue: WorkQueue, reconciler: Reconciler) -> None:
    reconciler.result = Result(forget=True)
    queue.add(A)
    await asyncio.sleep(1)
    assert queue.known() == []


@played()
async def test_a_pool_made_again_meanwhile_is_not_forgotten(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    reconciler.result, reconciler.lasts = Result(forget=True), 1.0
    queue.add(A)
    await asyncio.sleep(0.5)
    reconciler.result = Result(forget=True)
    queue.add(A, urgent=True)
    await asyncio.sleep(0.6)
    assert queue.known() == [A]
    assert len(reconciler.begun) == 2


@played()
async def test_statistics_count_waiting_and_running_pools(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    reconciler.lasts = 100.0
    queue.add(A)
    queue.add(B, delay=50)
    await asyncio.sleep(10)
    statistics = queue.statistics()
    assert (statistics.known, statistics.running, statistics.waiting) == (2, 1, 0)
    assert (statistics.longest_run, statistics.longest_wait) == (10.0, 0.0)
    assert statistics.since_last_end == 10.0


@played()
async def test_draining_waits_for_turns_and_begins_none(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    reconciler.lasts = 2.0
    queue.add(A)
    await asyncio.sleep(1)
    queue.add(B)
    queue.add(A)
    await queue.drain(5)
    assert asyncio.get_running_loop().time() == pytest.approx(2.0)
    await asyncio.sleep(10)
    assert reconciler.begun == [(0.0, A)]


@played()
async def test_draining_ends_after_its_grace(queue: WorkQueue, reconciler: Reconciler) -> None:
    reconciler.lasts = 1000.0
    queue.add(A)
    await asyncio.sleep(1)
    await queue.drain(5)
    assert asyncio.get_running_loop().time() == pytest.approx(6.0)


@played()
async def test_an_end_in_the_middle_of_a_turn_leaves_no_task(
    queue: WorkQueue, reconciler: Reconciler
) -> None:
    reconciler.lasts = 1000.0
    queue.add(A)
    await asyncio.sleep(1)


def test_the_longest_backoff_is_bounded() -> None:
    assert FIRST_BACKOFF * 2**10 > LONGEST_BACKOFF


class Flood(Reconciler):
    """Reconciler of pools in the namespace ``flood`` and in others; each takes a second."""

    def __init__(self) -> None:
        super().__init__()
        self.lasts = 1.0

    def delay(self, key: Key, since: float) -> float:
        return self.times(key)[0] - since


@pytest.mark.parametrize("result", [Result(), Result(failed=True), Result(requeue_after=0.0)])
@pytest.mark.parametrize("concurrency", [1, 8])
def test_the_pools_of_one_namespace_do_not_delay_those_of_another(
    concurrency: int, result: Result
) -> None:
    async def main() -> None:
        reconciler = Flood()
        reconciler.result = result
        queue = WorkQueue(reconciler, concurrency=concurrency)
        task = asyncio.ensure_future(queue.run())
        for number in range(1000):
            queue.add(Key("flood", str(number)), urgent=True)
        await asyncio.sleep(20.5)
        began = asyncio.get_running_loop().time()
        for name in "abc":
            queue.add(Key(name, "well"))
        await asyncio.sleep(10)
        # They begin at once, or as soon as one of those that work has ended.
        delays = [reconciler.delay(Key(name, "well"), began) for name in "abc"]
        assert max(delays) <= (2.0 if concurrency == 1 else 0.01)
        task.cancel()
        await asyncio.wait([task])

    virtual_time.run(main())


@played(concurrency=2)
async def test_namespaces_take_turns(queue: WorkQueue, reconciler: Reconciler) -> None:
    reconciler.lasts = 1.0
    for name in "ab":
        for number in range(4):
            queue.add(Key(name, str(number)))
    await asyncio.sleep(10)
    assert [key.namespace for _, key in reconciler.begun] == ["a", "b"] * 4
