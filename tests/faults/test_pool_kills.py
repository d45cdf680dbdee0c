"""Workers killed or stopped at every stage: each result arrives once, and the pool goes on."""

from __future__ import annotations

import functools
import os
import random
import signal
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import fiber
from faults import pool_targets as tasks
from faults.program import alive, stop_and_wait, wait_for
from fiber.pool import ApplyResult, Pool
from patience import PATIENCE

pytestmark = pytest.mark.usefixtures("backend")


def pids(pool: Pool) -> list[int]:
    return [process.pid for process in pool._pool if process.pid is not None]


def kill(pid: int) -> None:
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        pass  # it was replaced meanwhile


def kill_one(pool: Pool, choose: Callable[[list[int]], int] = random.choice) -> None:
    """Kill any of its workers, unless all were killed and no replacement has come yet."""
    if living := pids(pool):
        kill(choose(living))


def works(pool: Pool) -> None:
    assert pool.map(abs, range(-5, 0)) == [5, 4, 3, 2, 1]


def blocked(folder: Path, count: int) -> list[int]:
    """The workers that are in a task that blocks."""
    wait_for(lambda: len(list(folder.iterdir())) >= count)
    return [int(path.name) for path in folder.iterdir()]


def test_killed_before_it_is_ready() -> None:
    with fiber.Pool(2) as pool:
        for pid in pids(pool):
            kill(pid)
        works(pool)


def test_killed_while_idle() -> None:
    with fiber.Pool(3) as pool:
        works(pool)
        for _ in range(3):
            old = pids(pool)
            for pid in old:
                kill(pid)
            works(pool)
            assert not set(old) & set(pool.map(tasks.pid, range(10), chunksize=1))


def test_killed_in_a_task_it_was_the_only_one_to_run(tmp_path: Path) -> None:
    with fiber.Pool(1, retries=0) as pool:
        result = pool.apply_async(tasks.report_pid_and_block, (str(tmp_path),))
        after = pool.apply_async(abs, (-1,))
        (pid,) = blocked(tmp_path, 1)
        kill(pid)
        with pytest.raises(fiber.WorkerDied):
            result.get(PATIENCE)
        assert after.get(PATIENCE) == 1


@pytest.mark.parametrize("size", [1 << 20, 20 << 20])
def test_killed_while_it_sends_large_results(size: int) -> None:
    with fiber.Pool(2, retries=50) as pool:
        works(pool)
        results = pool.imap_unordered(tasks.large, [size] * 12, chunksize=1)
        for number, data in enumerate(results):
            assert len(data) == size
            if number % 4 == 0:
                kill_one(pool)


def test_killed_while_it_gets_large_arguments() -> None:
    data = bytes(8 << 20)
    with fiber.Pool(2, retries=50) as pool:
        works(pool)
        results = [pool.apply_async(len, (data,)) for _ in range(12)]
        for number, result in enumerate(results):
            assert result.get(PATIENCE) == len(data)
            if number % 4 == 0:
                kill_one(pool)


def test_ten_thousand_queued_and_workers_dying_all_the_time() -> None:
    """Each map that ends kills a worker: where starts take long, kills are rare, too."""
    rng, count = random.Random(1), 50
    with fiber.Pool(3, retries=1000) as pool:
        works(pool)
        maps: list[ApplyResult[list[int]]] = []
        calls: list[ApplyResult[int]] = []
        for n in range(0, 5000, count):
            numbers = range(-n - count, -n)
            maps += [pool.map_async(abs, numbers, 7, callback=lambda _: kill_one(pool, rng.choice))]
            calls += [pool.apply_async(abs, (-m,)) for m in range(n, n + count)]
        assert [result.get(PATIENCE) for result in calls] == list(range(5000))
        mapped = [result.get(PATIENCE) for result in maps]
    assert mapped == [list(range(n + count, n, -1)) for n in range(0, 5000, count)]


def test_callbacks_come_once_however_workers_die() -> None:
    calls: Counter[int] = Counter()
    with fiber.Pool(2, retries=100) as pool:
        works(pool)
        results = [
            pool.apply_async(abs, (-n,), callback=lambda value: calls.update([value]))
            for n in range(300)
        ]
        for _ in range(3):
            kill_one(pool)
        assert [result.get(PATIENCE) for result in results] == list(range(300))
        wait_for(lambda: calls.total() >= 300)
    assert set(calls.values()) == {1}


def test_without_retries_each_task_runs_at_most_once_and_gets_a_result(tmp_path: Path) -> None:
    work = functools.partial(tasks.note_and_return, str(tmp_path))
    with fiber.Pool(2, retries=0) as pool:
        works(pool)
        results = [pool.apply_async(work, (n,)) for n in range(120)]
        for _ in range(3):
            wait_for(lambda: sum(r.ready() for r in results) > 20)
            kill_one(pool)
        outcomes = [outcome(result) for result in results]
    runs = Counter(path.name.split("-")[0] for path in tmp_path.iterdir())
    assert max(runs.values()) == 1
    for number, value in enumerate(outcomes):
        assert value in (number, "died")
    assert outcomes.count("died") <= 3


def test_without_retries_no_task_of_a_batch_runs_twice(tmp_path: Path) -> None:
    work = functools.partial(tasks.note_and_return, str(tmp_path))
    with fiber.Pool(2, retries=0) as pool:
        works(pool)
        result = pool.map_async(work, range(1000))
        wait_for(lambda: any(tmp_path.iterdir()))
        for pid in pids(pool):
            kill(pid)
        assert outcome(result) == "died"
    runs = Counter(path.name.split("-")[0] for path in tmp_path.iterdir())
    assert max(runs.values()) == 1


def outcome(result: Any) -> Any:
    try:
        return result.get(PATIENCE)
    except fiber.WorkerDied:
        return "died"


def test_a_stopped_worker_holds_up_only_its_own_task(tmp_path: Path) -> None:
    with fiber.Pool(2, retries=0) as pool:  # so that each task travels alone
        works(pool)
        stopped, *_ = pids(pool)
        stop_and_wait(stopped)
        results = [pool.apply_async(abs, (-n,)) for n in range(50)]
        wait_for(lambda: sum(result.ready() for result in results) == 49)
        os.kill(stopped, signal.SIGCONT)
        assert [result.get(PATIENCE) for result in results] == list(range(50))


def test_a_stopped_worker_is_ended_by_terminate(tmp_path: Path) -> None:
    pool = fiber.Pool(2)
    works(pool)
    stopped = pids(pool)
    for pid in stopped:
        stop_and_wait(pid)
    results = pool.map_async(abs, range(100))
    pool.terminate()
    pool.join()
    assert not results.ready() or not results.successful()
    wait_for(lambda: not any(map(alive, stopped)))


def test_all_workers_killed_while_many_threads_use_the_pool() -> None:
    sums: list[int] = []
    with fiber.Pool(3, retries=100) as pool:
        works(pool)

        def use() -> None:
            for _ in range(5):
                sums.append(sum(pool.map(abs, range(-100, 0))))

        threads = [threading.Thread(target=use) for _ in range(4)]
        for thread in threads:
            thread.start()
        for _ in range(3):
            for pid in pids(pool):
                kill(pid)
        for thread in threads:
            thread.join(PATIENCE)
    assert sums == [5050] * 20
