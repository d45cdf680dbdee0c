"""Workers that die, tasks that take too long, workers that cannot start."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import fiber
from census import wait_until
from fiber._engine import start_failures
from fiber.errors import StartError, WorkerDied
from fiber.pool import Pool
from patience import PATIENCE
from processes import pool_tasks as tasks
from processes.pool_programs import run_program

pytestmark = pytest.mark.usefixtures("backend")


@pytest.fixture
def pool() -> Iterator[Pool]:
    pool = fiber.Pool(2, retries=3)
    yield pool
    assert pool.map(tasks.square, range(10)) == [x * x for x in range(10)]
    assert wait_until(lambda: len(pool._pool) >= 2, PATIENCE), "a worker is not replaced"
    pool.close()
    pool.join()


@pytest.mark.parametrize(
    ("how", "exitcode", "reason"),
    [
        ("exit", 3, "exit status 3"),
        ("kill", -signal.SIGKILL, "SIGKILL"),
        ("segfault", -signal.SIGSEGV, "SIGSEGV"),
    ],
)
def test_a_task_that_kills_its_worker_fails_with_the_reason(
    pool: Pool, how: str, exitcode: int, reason: str
) -> None:
    with pytest.raises(WorkerDied, match=reason) as caught:
        pool.apply(tasks.die, (how,))
    error = caught.value
    assert "die" in error.task
    assert "PoolWorker-" in error.worker
    for words in ("die", "PoolWorker-", error.host, "tried 4 times"):
        assert words in str(error), words
    assert (error.exitcode, error.attempts) == (exitcode, 4)
    assert error.pid is not None


@pytest.mark.parametrize("chunksize", [None, 1, 10])
def test_sys_exit_ends_the_worker_and_is_not_tried_again(
    pool: Pool, tmp_path: Path, chunksize: int | None
) -> None:
    before = {process.pid for process in pool._pool}
    items = [(tmp_path / str(n), n == 3) for n in range(20)]
    iterator = pool.imap(tasks.count_and_exit, items, chunksize or 1)
    found = tasks.gather(iterator)
    assert [type(value) for value in found] == [int] * 3 + [SystemExit] + [int] * 16
    assert all(tasks.runs(path) == 1 for path, _ in items)
    with pytest.raises(SystemExit):
        pool.map(tasks.count_and_exit, [(tmp_path / "again", True)], chunksize)
    assert tasks.runs(tmp_path / "again") == 1
    assert wait_until(lambda: not before <= {process.pid for process in pool._pool}, PATIENCE), (
        "its worker goes on"
    )


def test_the_last_lines_of_a_dead_worker_are_in_the_error(backend: str) -> None:
    with fiber.Pool(1, retries=0) as pool, pytest.raises(WorkerDied) as caught:
        pool.apply(tasks.speak_and_die)
    if backend == "loopback":  # local children write to the program's own stderr
        assert caught.value.log == ("about to die",)
        assert "  | about to die" in str(caught.value)
    pool.join()


@pytest.mark.slow
@pytest.mark.parametrize("call", ["pool.apply(leave, (7,))", "executor.submit(leave, 7).result()"])
def test_a_program_that_a_tasks_sys_exit_ends_says_which_task(backend: str, call: str) -> None:
    done = run_program(
        f"""
        import fiber
        import sys

        def leave(status):
            sys.exit(status)

        with fiber.Pool(1) as pool, fiber.Executor(1) as executor:
            {call}
        """,
        {"FIBER_BACKEND": backend},
    )
    assert done.returncode == 7
    assert "the task leave() (" in done.stderr
    assert "called sys.exit(7)" in done.stderr


@pytest.mark.parametrize("chunksize", [None, 1, 2])
@pytest.mark.parametrize("kind", [KeyboardInterrupt, GeneratorExit])
def test_a_base_exception_is_still_the_tasks_error(
    pool: Pool, kind: type[BaseException], chunksize: int | None
) -> None:
    before = {process.pid for process in pool._pool}
    with pytest.raises(kind) as caught:
        pool.map(tasks.raise_it, [kind("on purpose")] * 4, chunksize)
    assert caught.value.args == ("on purpose",)
    assert "in raise_it" in str(caught.value.__cause__), "the remote traceback"
    with pytest.raises(kind):
        pool.apply(tasks.raise_it, (kind(),))
    assert {process.pid for process in pool._pool} == before


def test_sigint_ends_the_task_that_runs_and_not_its_worker(pool: Pool, tmp_path: Path) -> None:
    result = pool.apply_async(tasks.announce_and_wait_for_interrupt, (tmp_path / "runs",))
    (worker,) = tasks.wait_until_announced(tmp_path / "runs")
    os.kill(worker, signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        result.get(PATIENCE)
    assert len(tasks.announced(tmp_path / "runs")) == 1, "it was not tried again"
    assert worker in {process.pid for process in pool._pool}


def test_sigint_does_not_end_an_idle_worker(pool: Pool) -> None:
    workers = {pool.apply(tasks.pid)}
    for process in pool._pool:
        os.kill(process.pid, signal.SIGINT)
    assert set(pool.broadcast(tasks.pid)) == {process.pid for process in pool._pool} >= workers


def test_a_handler_of_the_initializers_own_stays(tmp_path: Path) -> None:
    ignore = (signal.SIGINT, signal.SIG_IGN)
    with fiber.Pool(1, initializer=signal.signal, initargs=ignore) as pool:
        assert pool.apply(signal.getsignal, (signal.SIGINT,)) is signal.SIG_IGN


def test_a_task_runs_again_when_its_worker_died(pool: Pool, tmp_path: Path) -> None:
    assert pool.apply(tasks.die_at_first, (tmp_path / "a",)) == "lived"
    assert pool.map(tasks.die_at_first, [tmp_path / "b"], 1) == ["lived"]


def test_a_worker_killed_from_outside_loses_no_task(pool: Pool, tmp_path: Path) -> None:
    path, gate = tmp_path / "here", tmp_path / "gate"
    result = pool.apply_async(tasks.announce_and_wait, (path, gate))
    (victim,) = tasks.wait_until_announced(path)
    os.kill(victim, signal.SIGKILL)
    tasks.wait_until_announced(path, 2)
    gate.touch()
    assert result.get(PATIENCE) == "gate"


@pytest.mark.parametrize("chunksize", [None, 1, 10])
def test_only_the_culprit_fails(pool: Pool, chunksize: int | None) -> None:
    pool.map(tasks.die_if, [(n, -1) for n in range(3000)], chunksize)  # batches become large
    pairs = [(n, 250) for n in range(500)]
    iterator = pool.imap(tasks.die_if, pairs, chunksize or 1)
    assert [next(iterator) for _ in range(250)] == list(range(250))
    with pytest.raises(WorkerDied, match="task 250 of die_if"):
        next(iterator)
    assert list(iterator) == list(range(251, 500))
    with pytest.raises(WorkerDied, match="task 250 of die_if") as caught:
        pool.map(tasks.die_if, pairs, chunksize)
    assert caught.value.attempts == 4


@pytest.mark.parametrize("retries", [0, 1])
def test_a_task_has_as_many_tries_as_were_asked_for(tmp_path: Path, retries: int) -> None:
    with fiber.Pool(2, retries=retries) as pool:
        with pytest.raises(WorkerDied) as caught:
            pool.apply(tasks.die_when_counted, (tmp_path / "runs",))
        assert tasks.runs(tmp_path / "runs") == caught.value.attempts == retries + 1
        # With tasks around it that are worth sending together.
        pairs = [(n, 250) for n in range(500)]
        with pytest.raises(WorkerDied, match="task 250"):
            pool.map(tasks.die_if, pairs)
    pool.join()


def test_broadcast_reaches_the_replacement_of_a_worker(pool: Pool, tmp_path: Path) -> None:
    assert sorted(pool.broadcast(tasks.die_at_first, tmp_path / "a")) == ["lived", "lived"]
    with pytest.raises(WorkerDied):
        pool.broadcast(tasks.die, "exit")


def test_results_around_a_death_are_kept(pool: Pool) -> None:
    iterator = pool.imap_unordered(tasks.die_if, [(n, 99) for n in range(100)])
    found = []
    while True:
        try:
            found.append(next(iterator))
        except WorkerDied:
            break
    assert sorted([*found, *iterator]) == list(range(99))


# Time

LIMIT = 3.0
"""Seconds for a task that ends, or announces itself, at once: much for a busy machine."""


@pytest.mark.slow
@pytest.mark.parametrize("call", ["apply", "map", "starmap", "imap"])
def test_a_task_over_its_timeout_is_killed(pool: Pool, tmp_path: Path, call: str) -> None:
    path = tmp_path / "here"
    inputs = {"apply": (path,), "map": [path], "starmap": [(path,)], "imap": [path]}

    busy = tasks.announce_and_spin if call == "map" else tasks.announce_and_sleep

    def run() -> None:
        found = getattr(pool, call)(busy, inputs[call], timeout=LIMIT)
        next(found)

    pool.broadcast(tasks.pid)  # the workers have the functions
    with pytest.raises(fiber.TimeoutError, match=r"announce_and_.* longer than its timeout of 3 s"):
        run()
    assert len(tasks.announced(path)) == 1, "it ran again"


@pytest.mark.slow
def test_other_tasks_of_the_call_have_their_own_time(pool: Pool) -> None:
    found = pool.imap(tasks.sleep, [0.001, 600, 0.002, 0.003], timeout=LIMIT)
    assert next(found) == 0.001
    with pytest.raises(fiber.TimeoutError):
        next(found)
    assert [next(found), next(found)] == [0.002, 0.003]


@pytest.mark.slow
def test_waiting_is_not_counted_as_running(pool: Pool, tmp_path: Path) -> None:
    path, gate = tmp_path / "here", tmp_path / "gate"
    busy = pool.starmap_async(tasks.announce_and_wait, [(path, gate)] * 2, 1)
    tasks.wait_until_announced(path, 2)
    late = pool.map_async(tasks.square, range(6), timeout=LIMIT)
    late.wait(1.2 * LIMIT)
    gate.touch()
    assert late.get(PATIENCE) == [0, 1, 4, 9, 16, 25]
    busy.get(PATIENCE)


def test_a_timeout_for_all_tasks(tmp_path: Path) -> None:
    with fiber.Pool(1, task_timeout=0.2) as pool:
        with pytest.raises(fiber.TimeoutError):
            pool.apply(tasks.sleep, (600,))
        assert pool.map(tasks.square, range(5), timeout=PATIENCE) == [0, 1, 4, 9, 16]
        assert pool.apply(tasks.sleep, (0.25,), timeout=PATIENCE) == 0.25
    pool.join()


# Birth


@pytest.fixture
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give up early on workers that fail to start."""
    monkeypatch.setattr(start_failures, "RAISED_PATIENCE", 0.0)
    monkeypatch.setattr(start_failures, "KILLED_PATIENCE", 0.0)


@pytest.mark.usefixtures("_impatient")
def test_an_initializer_that_raises_ends_the_pool_after_few_tries(tmp_path: Path) -> None:
    path = tmp_path / "runs"
    pool = fiber.Pool(2, tasks.refuse_counted, (path,))
    with pytest.raises(StartError, match="no such device") as caught:
        pool.map(tasks.square, range(10))
    assert "refuse_counted" in str(caught.value)
    with pytest.raises(StartError):
        pool.apply(tasks.square, (1,))
    with pytest.raises(StartError):
        pool.imap(tasks.square, iter(range(3)))
    pool.close()
    pool.join()
    assert tasks.runs(path) <= 5


@pytest.mark.usefixtures("_impatient")
def test_outstanding_calls_fail_when_no_worker_starts() -> None:
    pool = fiber.Pool(2, tasks.start_slowly, (Path("/nowhere"),))
    results = [pool.apply_async(tasks.square, (n,)) for n in range(3)]
    iterator = pool.imap(tasks.square, iter(range(10)))
    deadline = time.monotonic() + PATIENCE
    while not results[0].ready():
        assert time.monotonic() < deadline, "the pool does not give up"
        for process in pool._pool:
            process.kill()
        time.sleep(0.001)
    for result in results:
        with pytest.raises(StartError, match="SIGKILL"):
            result.get(PATIENCE)
    with pytest.raises(StartError):
        iterator.next(PATIENCE)
    pool.terminate()
    pool.join()


@pytest.mark.usefixtures("_impatient")
def test_a_pool_gives_up_after_three_workers_that_die_at_their_start(tmp_path: Path) -> None:
    path = tmp_path / "runs"
    pool = fiber.Pool(1, tasks.vanish, (path,))
    with pytest.raises(StartError, match="exit status 9"):
        pool.apply(tasks.square, (1,))
    pool.terminate()
    pool.join()
    assert tasks.runs(path) == 3


@pytest.mark.slow
def test_workers_are_tried_for_a_time_and_not_a_number_of_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(start_failures, "RAISED_PATIENCE", PATIENCE)
    with fiber.Pool(1, tasks.fail_until, (tmp_path / "runs", 4)) as pool:
        assert pool.apply(tasks.square, (3,)) == 9
    pool.join()
    assert tasks.runs(tmp_path / "runs") == 5


@pytest.mark.slow
def test_a_wave_of_kills_is_outlived(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(start_failures, "KILLED_PATIENCE", PATIENCE)
    with fiber.Pool(4, tasks.killed_until, (tmp_path / "runs", 7)) as pool:
        assert pool.map(tasks.square, range(10)) == [x * x for x in range(10)]
    pool.join()
    assert tasks.runs(tmp_path / "runs") >= 8


@pytest.mark.slow
def test_a_long_wait_for_workers_reports_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(start_failures, "RAISED_PATIENCE", PATIENCE)
    monkeypatch.setattr(start_failures, "SAID_AFTER", 0.0)
    with fiber.Pool(1, tasks.fail_until, (tmp_path / "runs", 4)) as pool:
        assert pool.apply(tasks.square, (3,)) == 9
    pool.join()
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("fiber: no worker has started")
    assert "it raised an error" in line


def test_an_initializer_that_does_not_pickle() -> None:
    with pytest.raises((RuntimeError, TypeError), match="cannot be pickled"):
        fiber.Pool(2, tasks.remember, (tasks.Unpicklable(),))


# Lifetime


@pytest.mark.parametrize("chunksize", [None, 1, 5])
def test_maxtasksperchild_limits_the_chunks_of_a_worker(chunksize: int | None) -> None:
    with fiber.Pool(2, maxtasksperchild=2) as pool:
        pids = pool.map(tasks.pid, range(20), chunksize)
    pool.join()
    chunk = chunksize or 3
    per_worker = [pids.count(pid) for pid in set(pids)]
    assert max(per_worker) <= 2 * chunk
    assert len(per_worker) >= 20 // (2 * chunk)


def test_maxtasksperchild_counts_calls() -> None:
    with fiber.Pool(1, maxtasksperchild=1) as pool:
        results = [pool.apply_async(tasks.pid) for _ in range(6)]
        assert len({result.get(PATIENCE) for result in results}) == 6
    pool.join()
