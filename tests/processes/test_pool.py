"""Calls of a pool and their keywords, on the local and the loopback backend."""

from __future__ import annotations

import itertools
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

import fiber
from census import wait_until
from fiber.pool import Pool
from patience import PATIENCE
from processes import pool_tasks as tasks

pytestmark = pytest.mark.usefixtures("backend")


@pytest.fixture
def pool() -> Iterator[Pool]:
    pool = fiber.Pool(3)
    yield pool
    pool.close()
    pool.join()


# Every call returns the same as in multiprocessing


def test_apply(pool: Pool) -> None:
    assert pool.apply(tasks.add, (1,), {"y": 2}) == 3
    assert pool.apply_async(tasks.add, args=(1,), kwds={"y": 2}).get(PATIENCE) == 3


@pytest.mark.parametrize("chunksize", [None, 1, 3, 1000])
@pytest.mark.parametrize("kind", [list, tuple, range, iter, dict.fromkeys, "generator"])
def test_map(pool: Pool, kind: Any, chunksize: int | None) -> None:
    if kind == "generator":
        source: Any = (x for x in range(50))
    else:
        source = range(50) if kind is range else kind(range(50))
    assert pool.map(tasks.square, source, chunksize) == [x * x for x in range(50)]


def test_each_chunk_has_its_own_copy_of_the_object_of_a_method(pool: Pool) -> None:
    for _ in range(2):
        log = tasks.Log()
        assert pool.map(log.add, range(6), 1) == [1] * 6
        assert pool.map(log.add, range(6), 3) == [1, 2, 3] * 2
        assert sorted(pool.imap_unordered(log.add, range(6), 2)) == [1, 1, 1, 2, 2, 2]
        assert pool.apply(log.add, (0,)) == 1
    assert log.items == []


@pytest.mark.parametrize("chunksize", [None, 1, 7])
def test_starmap_unpacks_the_arguments_of_each_call(pool: Pool, chunksize: int | None) -> None:
    pairs = list(zip(range(30), range(30, 0, -1), strict=True))
    assert pool.starmap(tasks.add, pairs, chunksize) == [30] * 30
    assert pool.starmap(tasks.add, iter(pairs), chunksize) == [30] * 30
    assert pool.starmap_async(tasks.add, pairs, chunksize).get(PATIENCE) == [30] * 30


@pytest.mark.parametrize("chunksize", [1, 4, 1000])
@pytest.mark.parametrize("lazily", [True, False])
def test_imap(pool: Pool, chunksize: int, lazily: bool) -> None:
    source: Any = iter(range(40)) if lazily else range(40)
    assert list(pool.imap(tasks.square, source, chunksize)) == [x * x for x in range(40)]


@pytest.mark.parametrize("chunksize", [1, 4])
def test_imap_unordered(pool: Pool, chunksize: int) -> None:
    found = pool.imap_unordered(tasks.square, iter(range(40)), chunksize)
    assert sorted(found) == [x * x for x in range(40)]


def test_none_may_be_a_result(pool: Pool) -> None:
    assert list(pool.imap(tasks.identity, [None, 1, None])) == [None, 1, None]
    assert pool.map(tasks.identity, [None] * 5) == [None] * 5
    assert pool.apply(tasks.identity, (None,)) is None
    naps = [0.05, 0, 0, 0.02, 0, 0]
    assert list(pool.imap(time.sleep, naps)) == [None] * len(naps)
    assert list(pool.imap_unordered(time.sleep, naps)) == [None] * len(naps)


@pytest.mark.parametrize("source", [[], (), range(0), "", iter([])])
def test_maps_of_an_empty_input_return_no_results(pool: Pool, source: Any) -> None:
    assert pool.map(tasks.square, source) == []
    assert list(pool.imap(tasks.square, source)) == []
    assert pool.map_async(tasks.square, source).get(PATIENCE) == []


def test_strings_and_bytes_are_iterables(pool: Pool) -> None:
    assert pool.map(tasks.identity, "abc") == ["a", "b", "c"]
    assert pool.map(tasks.identity, b"abc", 2) == [97, 98, 99]


@pytest.mark.parametrize("chunksize", [None, 1])
def test_objects_arrive_whole(pool: Pool, chunksize: int | None) -> None:
    values = [{"a": [1, (2, 3)]}, [1, 2], (1, [2]), tasks.Point(3), {4}, 1 << 100, 1j, b"x", "y"]
    assert pool.map(tasks.identity, values, chunksize) == values


def test_large_arguments_and_results(pool: Pool) -> None:
    import numpy as np

    arrays = [np.full(200_000, n) for n in range(6)]
    for chunksize in (None, 1, 2):
        back = pool.map(tasks.identity, arrays, chunksize)
        assert all((a == b).all() for a, b in zip(arrays, back, strict=True))
    assert (pool.apply(tasks.identity, (arrays[1],)) == arrays[1]).all()


@pytest.mark.parametrize("size", [1 << 20, (1 << 20) + 1, 5 << 20])
def test_messages_around_a_megabyte(pool: Pool, size: int) -> None:
    assert pool.map(len, [bytes(size)] * 3) == [size] * 3
    assert pool.apply(bytes, (size,)) == bytes(size)


def test_an_object_with_very_many_buffers(pool: Pool) -> None:
    import numpy as np

    arrays = [np.full(1000, n) for n in range(1500)]
    (back,) = pool.map(tasks.identity, [arrays])
    assert all((a == b).all() for a, b in zip(arrays, back, strict=True))
    back = pool.apply(tasks.identity, (arrays,))
    assert (back[1499] == arrays[1499]).all()


def test_lambdas_closures_partials_and_methods(pool: Pool) -> None:
    offset = 10
    assert pool.map(lambda x: x + offset, range(5)) == [10, 11, 12, 13, 14]
    assert pool.apply(lambda: offset) == 10
    assert pool.map(tasks.Point(3).scaled, [2]) == [tasks.Point(6)]


@pytest.mark.parametrize("call", ["map", "imap", "apply"])
def test_a_reused_object_is_returned_as_it_was_after_its_task(pool: Pool, call: str) -> None:
    if call == "map":
        found = pool.map(tasks.grow, range(300), chunksize=1)
    elif call == "imap":
        found = list(pool.imap(tasks.grow, range(300)))
    else:
        found = [r.get() for r in [pool.apply_async(tasks.grow, (x,)) for x in range(300)]]
    assert found == [[x] for x in range(300)]


def test_a_reused_array_is_returned_as_it_was_after_its_task(pool: Pool) -> None:
    found = pool.map(tasks.fill, range(30), chunksize=1)
    assert [array[0] for array in found] == list(range(30))
    assert [array[-1] for array in found] == list(range(30))


def test_arguments_are_sent_as_they_were_at_the_call(pool: Pool) -> None:
    import numpy as np

    array = np.zeros(10_000)
    results = []
    for n in range(50):
        array[:] = n
        results.append(pool.apply_async(tasks.identity, (array,)))
    assert [result.get(PATIENCE)[-1] for result in results] == list(range(50))


def test_stop_iteration_in_a_task_is_an_error_like_any_other(pool: Pool) -> None:
    for chunksize in (None, 1, 50):
        with pytest.raises(StopIteration):
            pool.map(tasks.stop_iteration, range(100), chunksize)
    pool.map(tasks.square, range(1000))  # warm: the next batch is large
    result = pool.map_async(tasks.stop_iteration, [0, 1, 2, 4] * 100 + [3] + [5] * 100)
    with pytest.raises(StopIteration):
        result.get(PATIENCE)


# Results


def test_a_second_get_gives_the_same_again(pool: Pool) -> None:
    for result in (pool.apply_async(tasks.identity, ([1],)), pool.map_async(abs, [-1, -2])):
        assert result.get(PATIENCE) is result.get(PATIENCE)
    failed = pool.apply_async(tasks.raise_value_error, (1,))
    with pytest.raises(ValueError, match="1") as first:
        failed.get(PATIENCE)
    with pytest.raises(ValueError, match="1") as second:
        failed.get(PATIENCE)
    assert first.value.args == second.value.args
    assert first.value.__cause__ is second.value.__cause__
    assert first.value is not second.value  # its traceback would grow


def test_results_can_be_asked_how_they_are(pool: Pool, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    result = pool.apply_async(tasks.wait_for, (gate,))
    assert not result.ready()
    with pytest.raises(ValueError, match="not ready"):
        result.successful()
    with pytest.raises(fiber.TimeoutError):
        result.get(timeout=0.001)
    with pytest.raises(fiber.TimeoutError):
        result.get(timeout=-1)
    result.wait(0.001)
    gate.touch()
    result.wait(PATIENCE)
    assert result.ready()
    assert result.successful()
    failed = pool.map_async(tasks.raise_if_odd, range(3))
    failed.wait(PATIENCE)
    assert not failed.successful()


def test_several_threads_may_wait_for_one_result(pool: Pool, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    result = pool.apply_async(tasks.wait_for, (gate,))
    found: list[str] = []
    threads = [
        threading.Thread(target=lambda: found.append(result.get(PATIENCE))) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    gate.touch()
    for thread in threads:
        thread.join(PATIENCE)
    assert found == ["gate"] * 4


def test_the_iterator_s_next_has_a_timeout(pool: Pool, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    iterator = pool.imap(tasks.wait_for, [gate])
    with pytest.raises(fiber.TimeoutError):
        iterator.next(0.001)
    gate.touch()
    assert iterator.next(timeout=PATIENCE) == "gate"
    with pytest.raises(StopIteration):
        iterator.next()
    with pytest.raises(StopIteration):
        next(iterator)


def test_a_map_raises_when_all_tasks_are_done(pool: Pool, tmp_path: Path) -> None:
    path = tmp_path / "runs"
    result = pool.map_async(tasks.raise_if_odd, range(20), 1)
    with pytest.raises(ValueError, match=r"\d+"):
        result.get(PATIENCE)
    assert pool.map(tasks.count, [path] * 3, 1)
    assert tasks.runs(path) == 3


def test_imap_goes_on_behind_a_task_that_raised(pool: Pool) -> None:
    iterator = pool.imap(tasks.raise_if_odd, range(4))
    found: list[Any] = []
    while len(found) < 4:
        try:
            found.append(next(iterator))
        except ValueError as error:
            found.append(error.args)
    assert found == [0, (1,), 2, (3,)]


# Callbacks


def test_without_a_thread_for_its_callback_a_result_is_there_and_that_is_seen(
    pool: Pool, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusal = RuntimeError("can't start new thread")
    shown: list[BaseException] = []
    monkeypatch.setattr(sys, "excepthook", lambda _kind, error, _traceback: shown.append(error))
    monkeypatch.setattr(pool._executor.threads.callbacks, "submit", mock.Mock(side_effect=refusal))
    called: list[int] = []
    assert pool.apply_async(tasks.square, (3,), callback=called.append).get(PATIENCE) == 9
    assert (called, shown) == ([], [refusal])


def test_callbacks_come_in_order_and_before_the_result(pool: Pool) -> None:
    seen: list[int] = []
    result = pool.apply_async(tasks.square, (3,), callback=seen.append)
    assert result.get(PATIENCE) == 9
    assert seen == [9]
    results = [pool.apply_async(tasks.identity, (n,), callback=seen.append) for n in range(20)]
    for n, result in enumerate(results):
        result.wait(PATIENCE)
        assert n in seen
    pool.map_async(tasks.square, [2], callback=seen.extend).wait(PATIENCE)
    assert sorted(seen) == sorted([9, *range(20), 4])


def test_error_callbacks_get_the_error(pool: Pool) -> None:
    seen: list[Any] = []
    result = pool.apply_async(
        tasks.raise_value_error, (5,), callback=seen.append, error_callback=seen.append
    )
    with pytest.raises(ValueError, match="5"):
        result.get(PATIENCE)
    assert [type(error) for error in seen] == [ValueError]


def test_a_callback_that_raises_is_reported_and_harms_no_result(
    pool: Pool, capsys: pytest.CaptureFixture[str]
) -> None:
    result = pool.apply_async(tasks.square, (3,), callback=tasks.raise_value_error)
    assert result.get(PATIENCE) == 9
    assert pool.apply_async(tasks.square, (4,), callback=print).get(PATIENCE) == 16
    assert "ValueError: 9" in capsys.readouterr().err


def test_a_callback_may_use_the_pool(pool: Pool) -> None:
    found: list[Any] = []
    result = pool.apply_async(
        tasks.square, (3,), callback=lambda nine: found.append(pool.apply(tasks.square, (nine,)))
    )
    assert result.get(PATIENCE) == 9
    assert found == [81]


# Input


def test_errors_of_the_input_surface(pool: Pool) -> None:
    def source(good: int) -> Iterator[int]:
        yield from range(good)
        raise LookupError("no more")

    with pytest.raises(LookupError):
        pool.map(tasks.square, source(100))
    with pytest.raises(LookupError):
        pool.map_async(tasks.square, source(3))
    iterator = pool.imap(tasks.square, source(3))
    assert [next(iterator) for _ in range(3)] == [0, 1, 4]
    with pytest.raises(LookupError):
        next(iterator)
    with pytest.raises(StopIteration):
        next(iterator)
    chunked = pool.imap(tasks.square, source(5), 2)
    assert [next(chunked) for _ in range(4)] == [0, 1, 4, 9]
    with pytest.raises(LookupError):
        next(chunked)


def test_input_is_read_little_faster_than_it_is_worked_off(pool: Pool, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    read: list[int] = []

    def source() -> Iterator[Path]:
        for n in range(10_000):
            read.append(n)
            yield gate

    iterator = pool.imap_unordered(tasks.wait_for, source())
    last = -1
    while len(read) != last:  # until the reader rests
        last = len(read)
        time.sleep(0.02)
    assert len(read) < 100
    gate.touch()
    assert sum(1 for _ in iterator) == 10_000


@pytest.mark.parametrize("unordered", [True, False])
def test_buffersize_bounds_unconsumed_input(pool: Pool, unordered: bool) -> None:
    read = 0

    def source() -> Iterator[int]:
        nonlocal read
        for n in itertools.count():
            read += 1
            yield n

    call = pool.imap_unordered if unordered else pool.imap
    iterator = call(tasks.square, source(), buffersize=7)
    for consumed in range(1, 300):
        next(iterator)
        assert read <= consumed + 7
    del iterator  # results are not consumed: no more input is read
    assert wait_until(
        lambda: all(thread.name != "fiber-pool-feeder" for thread in threading.enumerate()),
        PATIENCE,
    ), "the infinite input is still read"


def test_a_slow_input_delays_no_other_call(pool: Pool) -> None:
    given = threading.Semaphore(0)

    def source() -> Iterator[int]:
        for n in range(5):
            given.acquire()
            yield n

    iterator = pool.imap(tasks.square, source())
    for n in range(5):
        given.release()
        assert iterator.next(PATIENCE) == n * n


def test_two_slow_inputs_do_not_hold_each_other_up(pool: Pool) -> None:
    gate = threading.Event()

    def blocked() -> Iterator[int]:
        gate.wait(PATIENCE)
        yield 1

    first = pool.imap(tasks.square, blocked())
    assert list(pool.imap(tasks.square, iter(range(5)))) == [0, 1, 4, 9, 16]
    gate.set()
    assert list(first) == [1]


@pytest.mark.slow
def test_million_items_are_not_held_in_memory(pool: Pool) -> None:
    alive = 0
    most = 0

    class Item(int):
        def __new__(cls, n: int) -> Item:
            nonlocal alive, most
            alive += 1
            most = max(most, alive)
            return super().__new__(cls, n)

        def __del__(self) -> None:
            nonlocal alive
            alive -= 1

        def __reduce__(self) -> tuple[Any, ...]:
            return int, (int(self),)

    total = 200_000
    assert sum(pool.imap_unordered(tasks.identity, map(Item, range(total)))) == sum(range(total))
    assert most < total / 2
    most = 0
    assert len(pool.map(tasks.identity, map(Item, range(total)))) == total
    assert most < total / 2


# No task waits behind another, wherever it could run


def test_tasks_in_one_message_do_not_wait_for_each_other(pool: Pool, tmp_path: Path) -> None:
    pool.map(tasks.wait_if_first, [(1, tmp_path)] * 3000, 1)  # now it seems to be fast
    gate = tmp_path / "gate"
    for call in (pool.imap_unordered, pool.imap_unordered):
        found = []
        for index in call(tasks.wait_if_first, [(n, gate) for n in range(1000)]):
            found.append(index)
            if len(found) == 999:
                gate.touch()
        assert sorted(found) == list(range(1000))
        assert found[-1] == 0
        gate.unlink()


def test_tasks_may_wait_for_tasks_that_were_sent_behind_them(pool: Pool, tmp_path: Path) -> None:
    awaited = set(tasks.WAITING)
    stream = itertools.takewhile(lambda _: awaited, itertools.count())
    try:
        for index in pool.imap_unordered(tasks.wait_for_later, ((n, tmp_path) for n in stream)):
            awaited.discard(index)
    finally:
        awaited.clear()


@pytest.mark.parametrize("chunksize", [None, 1])
def test_as_many_tasks_as_workers_run_at_once(
    pool: Pool, tmp_path: Path, chunksize: int | None
) -> None:
    for attempt in range(3):
        path, gate = tmp_path / f"here{attempt}", tmp_path / f"gate{attempt}"
        result = pool.starmap_async(tasks.announce_and_wait, [(path, gate)] * 8, chunksize)
        assert len(set(tasks.wait_until_announced(path, 3))) == 3
        gate.touch()
        assert result.get(PATIENCE) == [gate.name] * 8


def test_short_calls_pass_a_long_map(pool: Pool, tmp_path: Path) -> None:
    begin, end = tmp_path / "begin", tmp_path / "end"
    # Its first tasks hold all three workers, and its later ones wait for the result of the call.
    gates = [begin] * 3 + [None] * 1000 + [end] * 1000
    long = pool.starmap_async(tasks.pass_gate, enumerate(gates), 1)
    short = pool.apply_async(tasks.square, (3,))
    begin.touch()
    assert short.get(PATIENCE) == 9
    end.touch()
    assert long.get(PATIENCE) == list(range(len(gates)))


# Beyond multiprocessing


def test_broadcast_runs_once_on_every_worker(pool: Pool) -> None:
    for _ in range(3):
        assert len(set(pool.broadcast(tasks.pid))) == 3
    pool.broadcast(tasks.remember, "x")
    assert pool.map(tasks.recall, range(10)) == ["x"] * 10
    with pytest.raises(ValueError, match="7"):
        pool.broadcast(tasks.raise_value_error, 7)


def test_broadcast_reaches_workers_that_are_still_starting(tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    with fiber.Pool(3, tasks.start_slowly, (gate,)) as pool:
        threading.Timer(0.05, gate.touch).start()
        assert len(set(pool.broadcast(tasks.pid))) == 3
    pool.join()


def test_workers_are_named_and_daemonic(pool: Pool) -> None:
    for name, daemon in pool.broadcast(tasks.current_name):
        assert "PoolWorker-" in name
        assert daemon


def test_pools_in_pools(pool: Pool) -> None:
    assert pool.map(tasks.nested_pools, [1, 2]) == [1, 2]


def test_several_pools_and_threads_at_once() -> None:
    pools = [fiber.Pool(2) for _ in range(3)]
    found: list[list[int]] = []

    def work(pool: Pool) -> None:
        for _ in range(5):
            found.append(pool.map(tasks.square, range(200)))
            found.append(list(pool.imap(tasks.square, iter(range(200)))))

    threads = [threading.Thread(target=work, args=(pool,)) for pool in pools * 2]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [[x * x for x in range(200)]] * 60
    for pool in pools:
        pool.terminate()
        pool.join()


def test_initializer_runs_in_each_worker() -> None:
    with fiber.Pool(2, tasks.remember, ("set",)) as pool:
        assert pool.broadcast(tasks.recall) == ["set", "set"]
    pool.join()
