"""Monitor of a program: what it says of its children, and their stacks, on each backend."""

from __future__ import annotations

import contextlib
import os
import queue
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest

import fiber
from census import wait_until
from faults import pool_targets as tasks
from fiber._monitor import client
from fiber._runtime import state as state_module
from fiber.pool import Pool
from patience import PATIENCE

pytestmark = pytest.mark.usefixtures("backend")


def ask(**request: Any) -> list[dict[str, Any]]:
    """Return the answer of this program, without the facts of the program."""
    (path,) = [path for path in client.sockets() if client.pid_of(path) == os.getpid()]
    program, *rest = client.ask(path, request)
    assert program["program"]["pid"] == os.getpid()
    return rest


def stack_of(worker: str) -> str:
    (line,) = ask(ask="stacks", worker=worker)
    return str(line["stack"]["text"])


@pytest.fixture
def pool() -> Iterator[Pool]:
    with fiber.Pool(1) as pool:
        yield pool


def test_a_worker_that_hangs_in_native_code_shows_its_stack_and_goes_on(pool: Pool) -> None:
    pool.apply_async(tasks.hang_in_native_code)
    assert wait_until(lambda: pool.workers()[0].state == "busy", PATIENCE)
    (worker,) = pool.workers()
    assert wait_until(lambda: " in hang_in_native_code" in stack_of(worker.name), PATIENCE)
    text = stack_of(str(worker.pid))
    assert text.startswith("Main thread, in native code (most recent call first):")
    assert "worker.py" not in text
    assert [info.pid for info in pool.workers()] == [worker.pid]


def test_a_worker_whose_threads_run_goes_on(pool: Pool) -> None:
    # faulthandler crashes on the frames of threads that run.
    assert pool.apply(tasks.run_threads_while_shown, (100,)) == 100


@pytest.fixture
def begin() -> Iterator[Callable[..., fiber.Process]]:
    """Starts a process that is killed at the end."""
    started = []

    def begin(target: Callable[..., Any], *args: Any) -> fiber.Process:
        process = fiber.Process(target=target, args=args, name="target")
        process.start()
        started.append(process)
        return process

    yield begin
    for process in started:
        process.kill()
        process.join()
        process.close()


def test_a_child_that_runs_another_program_goes_on(begin: Callable[..., fiber.Process]) -> None:
    process = begin(tasks.run_another_program)

    def runs_it() -> bool:
        with open(f"/proc/{process.pid}/comm") as file:
            return file.read() == "sleep\n"

    assert wait_until(lambda: process.pid is not None and runs_it(), PATIENCE)
    assert "runs another program" in stack_of("target")
    assert process.is_alive()


def test_no_stack_is_written_into_a_file_of_the_user(
    begin: Callable[..., fiber.Process], tmp_path: Path
) -> None:
    path = tmp_path / "data"
    process = begin(tasks.close_all_and_open, str(path))
    assert wait_until((tmp_path / "data.ready").exists, PATIENCE)
    assert "has closed the file for its stacks" in stack_of("target")
    assert path.read_bytes() == b""
    assert process.is_alive()


def test_an_idle_worker_shows_that_it_waits(pool: Pool) -> None:
    assert pool.apply(abs, (-1,)) == 1
    (worker,) = pool.workers()
    assert wait_until(lambda: "waits for work" in stack_of(worker.name), PATIENCE)
    assert pool.apply(abs, (-2,)) == 2


def test_a_stopped_worker_is_said_to_be_stopped(pool: Pool) -> None:
    pool.apply(abs, (-1,))
    (worker,) = pool.workers()
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGSTOP)
    try:
        assert "is stopped by a signal" in stack_of(worker.name)
    finally:
        os.kill(worker.pid, signal.SIGCONT)
    assert pool.apply(abs, (-2,)) == 2


def test_all_children_and_the_program_show_their_stacks(pool: Pool) -> None:
    pool.apply(abs, (-1,))
    assert wait_until(lambda: pool.workers()[0].state == "idle", PATIENCE)
    process = fiber.Process(target=tasks.hang_in_python, name="hangs")
    process.start()
    try:
        assert wait_until(lambda: " in hang_in_python" in stack_of("hangs"), PATIENCE)
        first, *others = [line["stack"] for line in ask(ask="stacks")]
        assert first["name"] == "program"
        assert " in test_all_children_and_the_program_show_their_stacks" in first["text"]
        assert "fiber-io" not in first["text"]
        assert {stack["state"] for stack in others} == {"idle", "running"}
    finally:
        process.kill()
        process.join()
    assert [facts["state"] for facts in state()["child"]] == ["idle"]


def test_an_unknown_worker_is_said_to_be_unknown(pool: Pool) -> None:
    pool.apply(abs, (-1,))
    (line,) = ask(ask="stacks", worker="nobody")
    assert line["unknown"] == "nobody"
    assert line["names"] == [pool.workers()[0].name]


def test_a_request_with_a_bad_value_is_an_error(pool: Pool) -> None:
    pool.apply(abs, (-1,))
    (line,) = ask(ask="activity", since="yesterday")
    assert line["error"].startswith("TypeError")


def test_a_number_of_thousands_of_digits_is_no_fault(pool: Pool) -> None:
    pool.map_async(tasks.hang_with, [10**5000], chunksize=1)
    assert wait_until(lambda: bool(state()["pool"][0]["slowest"]), PATIENCE)
    (task,) = state()["pool"][0]["slowest"]
    assert task["task"] == "task 0 of hang_with()"
    assert task["argument"] == "<int of 16,610 bits>"


def test_the_arguments_of_a_call_are_shown(pool: Pool) -> None:
    pool.apply_async(tasks.hang_with, ("a",))
    assert wait_until(lambda: bool(state()["pool"][0]["slowest"]), PATIENCE)
    (task,) = state()["pool"][0]["slowest"]
    assert (task["task"], task["argument"]) == ("the call of hang_with()", "'a'")


def test_two_monitors_may_measure_at_once(pool: Pool) -> None:
    pool.apply(abs, (-1,))
    (child,) = state_module.runtime().children
    answers: queue.SimpleQueue[str] = queue.SimpleQueue()
    state_module.runtime().loop.call_soon(child.measure, lambda: answers.put("one"))
    state_module.runtime().loop.call_soon(child.measure, lambda: answers.put("two"))
    assert {answers.get(timeout=PATIENCE) for _ in range(2)} == {"one", "two"}


def test_an_unknown_question_is_an_error(pool: Pool) -> None:
    (line,) = ask(ask="weather")
    assert "no answer to 'weather'" in line["error"]


def state() -> dict[str, list[dict[str, Any]]]:
    found: dict[str, list[dict[str, Any]]] = {"totals": [], "pool": [], "child": [], "death": []}
    for line in ask(ask="state"):
        for kind, facts in line.items():
            found[kind].append(facts)
    return found


def test_the_state_of_a_pool_counts_its_tasks(pool: Pool) -> None:
    assert pool.map(abs, range(10)) == list(range(10))
    assert pool.apply(abs, (-1,)) == 1
    pool.map_async(tasks.hang_with, range(100), chunksize=1)
    assert wait_until(lambda: bool(state()["pool"][0]["slowest"]), PATIENCE)
    (facts,) = state()["pool"]
    (worker,) = pool.workers()
    assert facts["workers"] == {"busy": 1}
    assert facts["done"] == 11
    assert facts["held"] + facts["waiting"] == 100
    (task,) = facts["slowest"]
    assert task["task"] == "task 0 of hang_with()"
    assert (task["worker"], task["host"]) == (worker.name, worker.host)
    assert task["seconds"] >= 0


def test_the_state_has_the_memory_and_processor_time_of_children(pool: Pool) -> None:
    pool.apply(tasks.keep_memory, (64 << 20,))

    def grown() -> bool:
        (child,) = state()["child"]
        return (child["memory"] or 0) > 64 << 20 and child["cpu"] > 0

    assert wait_until(grown, PATIENCE)


def activity(since: int = 0) -> dict[str, Any]:
    (line,) = ask(ask="activity", since=since)
    found: dict[str, Any] = line["activity"]
    return found


def test_the_activity_agrees_with_what_ran(pool: Pool) -> None:
    before = activity()
    assert pool.map(abs, range(1000), chunksize=1) == list(range(1000))
    calls = [pool.apply_async(tasks.divide, (1, number)) for number in range(5)]
    with pytest.raises(ZeroDivisionError):
        calls[0].get()
    assert [call.get() for call in calls[1:]] == [1, 1 / 2, 1 / 3, 1 / 4]
    for number in range(20):
        pool.apply(round, (number,))

    def counts() -> dict[str, tuple[int, int]]:
        known = {one["name"]: one for one in before["functions"]}
        zero = {"tasks": 0, "failed": 0}
        return {
            one["name"]: tuple(one[key] - known.get(one["name"], zero)[key] for key in zero)
            for one in activity()["functions"]
        }

    expected = {"abs": (1000, 0), "divide": (5, 1), "round": (20, 0)}
    assert wait_until(lambda: counts().items() >= expected.items(), PATIENCE)
    now = activity()
    (child,) = [child for child in now["children"] if child["ended"] is None]
    assert (child["tasks"], child["failed"]) == (1025, 1)
    assert sum(span[4] for span in child["spans"]) == 1025
    assert 0 < child["work"] <= now["now"]
    assert now["bytes_sent"] > before["bytes_sent"]
    assert now["bytes_received"] > before["bytes_received"]


def test_lost_runs_are_counted(pool: Pool) -> None:
    before = activity()["lost"]
    with pytest.raises(fiber.WorkerDied):
        pool.apply(tasks.die)
    assert activity()["lost"] == before + 4


def test_tasks_of_workers_that_are_gone_still_count(pool: Pool) -> None:
    for number in range(3):
        pool.apply(abs, (number,))
    (worker,) = pool.workers()
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGKILL)
    assert wait_until(lambda: pool.apply(os.getpid) != worker.pid, PATIENCE)
    assert state()["pool"][0]["done"] >= 4
    death = state()["death"][-1]
    assert (death["name"], death["pid"]) == (worker.name, worker.pid)
    assert "SIGKILL" in death["reason"]


def test_a_pool_that_has_ended_is_no_longer_seen(pool: Pool) -> None:
    pool.apply(abs, (-1,))
    deaths = len(state()["death"])
    pool.close()
    pool.join()
    assert (state()["pool"], state()["child"], len(state()["death"])) == ([], [], deaths)


def test_a_start_after_the_end_leaves_no_directory() -> None:
    ended = state_module.Runtime()
    ended.close()
    process = fiber.Process(target=print)
    with contextlib.suppress(RuntimeError):  # the local backend refuses
        ended.start(process, cast("Any", _Owner()))
    assert ended.hub is not None
    assert ended.hub.directory is None or not os.path.exists(ended.hub.directory)


class _Owner:
    """Owner of a child that never starts."""

    started = received = recalled = draining = begin = exited = print
    state = "starting"
