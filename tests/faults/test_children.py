"""Kill children in every way and at every stage: their end is reported, exactly, and at once."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from multiprocessing import connection
from typing import Any

import pytest

import fiber
from faults import targets
from faults.program import alive, stop_and_wait, wait_for
from patience import PATIENCE

pytestmark = pytest.mark.usefixtures("backend")

METHODS = ("fork", "spawn")


def started(target: Callable[..., Any], *args: Any, method: str = "fork") -> Any:
    child = fiber.get_context(method).Process(target=target, args=args)
    child.start()
    return child


def ended(child: Any) -> int:
    child.join(PATIENCE)
    assert child.exitcode is not None
    code: int = child.exitcode
    pid = child.pid
    child.close()
    wait_for(lambda: not alive(pid))
    return code


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("way", "code"),
    [
        ("return", 0),
        ("raise", 1),
        ("sys.exit", 7),
        ("sys.exit text", 1),
        ("os._exit", 9),
        ("abort", -signal.SIGABRT),
        ("segfault", -signal.SIGSEGV),
        ("SIGKILL", -signal.SIGKILL),
        ("SIGTERM", -signal.SIGTERM),
        ("SIGHUP", -signal.SIGHUP),
        ("SIGINT", 1),  # KeyboardInterrupt, which multiprocessing reports as any exception
    ],
)
def test_the_exit_code_of_a_child_says_how_it_ended(method: str, way: str, code: int) -> None:
    assert ended(started(targets.exit_by, way, method=method)) == code


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("stage", ["at birth", "in its boot", "at work"])
def test_killed_at_any_stage_it_is_reported_at_once(
    method: str, stage: str, pipe: tuple[Any, Any]
) -> None:
    child = started(targets.report_and_block, pipe[1], method=method)
    if stage == "at work":
        assert pipe[0].recv() > 0
    elif stage == "in its boot":
        stop_and_wait(child.pid)
    os.kill(child.pid, signal.SIGKILL)
    assert connection.wait([child.sentinel], PATIENCE) == [child.sentinel]
    assert ended(child) == -signal.SIGKILL


def test_killed_while_it_sends_something_large_it_leaves_no_half_message(
    pipe: tuple[Any, Any],
) -> None:
    ours, theirs = pipe
    for _ in range(3):
        child = started(targets.send_for_ever, theirs, 5 << 20)
        assert len(ours.recv_bytes()) == 5 << 20
        os.kill(child.pid, signal.SIGKILL)
        assert ended(child) == -signal.SIGKILL
        while ours.poll():
            assert len(ours.recv_bytes()) == 5 << 20


def test_a_stopped_child_can_be_killed_and_goes_on_when_continued(pipe: tuple[Any, Any]) -> None:
    child = started(targets.echo, pipe[1])
    pipe[0].send(1)
    assert pipe[0].recv() == 1
    stop_and_wait(child.pid)
    pipe[0].send(2)
    assert not pipe[0].poll(0.05)
    assert child.is_alive()
    os.kill(child.pid, signal.SIGCONT)
    assert pipe[0].recv() == 2
    stop_and_wait(child.pid)
    child.kill()
    assert ended(child) == -signal.SIGKILL


def test_a_child_that_ignores_sigterm_is_ended_by_kill(pipe: tuple[Any, Any]) -> None:
    child = started(targets.ignore_sigterm, pipe[1])
    assert pipe[0].recv() == "ready"
    child.terminate()
    assert pipe[0].recv() == "not me"
    child.join(0)
    assert child.is_alive()
    child.kill()
    assert ended(child) == -signal.SIGKILL


def test_a_child_that_handles_sigterm_chooses_its_exit_code(pipe: tuple[Any, Any]) -> None:
    child = started(targets.exit_on_sigterm, pipe[1])
    assert pipe[0].recv() == "ready"
    child.terminate()
    assert ended(child) == 42


def test_the_end_of_a_child_that_closed_all_its_descriptors_is_reported(
    pipe: tuple[Any, Any],
) -> None:
    child = started(targets.close_every_descriptor, pipe[1])
    assert pipe[0].recv() == "closing"
    assert ended(child) == 5


def test_terminating_an_ended_child_does_nothing() -> None:
    child = started(targets.nothing)
    child.join(PATIENCE)
    child.terminate()
    child.kill()
    assert ended(child) == 0


def test_many_that_die_at_the_same_moment_are_all_reported(pipe: tuple[Any, Any]) -> None:
    children = [started(targets.report_and_block, pipe[1]) for _ in range(8)]
    pids = {pipe[0].recv() for _ in children}
    assert pids == {child.pid for child in children}
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
    assert [ended(child) for child in children] == [-signal.SIGKILL] * 8
