"""Monitor of a program: what it says of its children, and their stacks, on each backend."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest

import fiber
from census import wait_until
from faults import pool_targets as tasks
from fiber._monitor import client
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
def pool() -> Iterator[fiber.Pool]:
    with fiber.Pool(1) as pool:
        yield pool


def test_a_worker_that_hangs_in_native_code_shows_its_stack_and_goes_on(pool: fiber.Pool) -> None:
    pool.apply_async(tasks.hang_in_native_code)
    assert wait_until(lambda: pool.workers()[0].state == "busy", PATIENCE)
    (worker,) = pool.workers()
    assert wait_until(lambda: " in hang_in_native_code" in stack_of(worker.name), PATIENCE)
    text = stack_of(str(worker.pid))
    assert " in wait_beside" in text
    assert "worker.py" not in text
    assert [info.pid for info in pool.workers()] == [worker.pid]


def test_an_idle_worker_shows_that_it_waits(pool: fiber.Pool) -> None:
    assert pool.apply(abs, (-1,)) == 1
    (worker,) = pool.workers()
    assert wait_until(lambda: "waits for work" in stack_of(worker.name), PATIENCE)
    assert pool.apply(abs, (-2,)) == 2


def test_a_stopped_worker_is_said_to_be_stopped(pool: fiber.Pool) -> None:
    pool.apply(abs, (-1,))
    (worker,) = pool.workers()
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGSTOP)
    try:
        assert "is stopped by a signal" in stack_of(worker.name)
    finally:
        os.kill(worker.pid, signal.SIGCONT)
    assert pool.apply(abs, (-2,)) == 2


def test_all_children_and_the_program_show_their_stacks(pool: fiber.Pool) -> None:
    pool.apply(abs, (-1,))
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
    assert [line["child"]["state"] for line in ask(ask="children")] == ["idle"]


def test_an_unknown_worker_is_said_to_be_unknown(pool: fiber.Pool) -> None:
    pool.apply(abs, (-1,))
    (line,) = ask(ask="stacks", worker="nobody")
    assert line["unknown"] == "nobody"
    assert line["names"] == [pool.workers()[0].name]


def test_an_unknown_question_is_an_error(pool: fiber.Pool) -> None:
    (line,) = ask(ask="weather")
    assert "no answer to 'weather'" in line["error"]
