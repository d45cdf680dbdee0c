"""Pipes whose holders die: EOF exactly when the last holder is gone, and never a hang."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from multiprocessing import connection
from typing import Any

import pytest

import fiber
from faults import targets
from faults.program import stop_and_wait
from patience import PATIENCE

pytestmark = pytest.mark.usefixtures("backend")


@pytest.fixture
def start() -> Iterator[Callable[..., Any]]:
    """Starts processes, and ends those that the test left."""
    children: list[Any] = []

    def begin(target: Callable[..., Any], *args: Any) -> Any:
        children.append(fiber.Process(target=target, args=args))
        children[-1].start()
        return children[-1]

    yield begin
    for child in children:
        child.kill()
    for child in children:
        child.join(PATIENCE)
        child.close()


def test_the_end_comes_when_the_holder_dies(
    pipe: tuple[Any, Any], start: Callable[..., Any]
) -> None:
    ours, theirs = pipe
    child = start(targets.hold, theirs)
    theirs.close()
    assert ours.recv() == "held"
    child.kill()
    with pytest.raises(EOFError):
        ours.recv()
    with pytest.raises(BrokenPipeError):
        ours.send("to nobody")


def test_the_end_comes_when_the_holder_closes_a_copy_that_was_pickled_twice(
    pipe: tuple[Any, Any], start: Callable[..., Any]
) -> None:
    ours, theirs = pipe
    # As Baselines does it.  What stands last does not pickle by reference: all is pickled anew.
    child = start(targets.echo_without, theirs, ours, lambda: None)
    theirs.close()
    ours.send("here")
    assert ours.recv() == "here"
    ours.close()
    child.join(PATIENCE)
    assert child.exitcode == 0


def test_a_waiting_receiver_is_woken_by_the_death(
    pipe: tuple[Any, Any], start: Callable[..., Any]
) -> None:
    ours, theirs = pipe
    child = start(targets.hold, theirs)
    theirs.close()
    assert ours.recv() == "held"
    killer = threading.Timer(0.1, child.kill)
    killer.start()
    assert connection.wait([ours], PATIENCE) == [ours]
    with pytest.raises(EOFError):
        ours.recv()
    killer.join()


def test_end_of_file_comes_when_the_last_holder_is_gone(
    pipe: tuple[Any, Any], start: Callable[..., Any]
) -> None:
    ours, theirs = pipe
    children = [start(targets.hold, theirs) for _ in range(4)]
    assert [ours.recv() for _ in children] == ["held"] * 4
    for child in children:
        assert not ours.poll(), "someone holds it still"
        child.kill()
        child.join(PATIENCE)
    assert not ours.poll(), "we do"
    theirs.close()
    with pytest.raises(EOFError):
        ours.recv()


def test_messages_that_were_sent_before_the_death_arrive(
    pipe: tuple[Any, Any], start: Callable[..., Any]
) -> None:
    ours, theirs = pipe
    child = start(targets.send_and_die, theirs, 50)
    theirs.close()
    child.join(PATIENCE)
    assert child.exitcode == -signal.SIGKILL
    assert [ours.recv() for _ in range(50)] == list(range(50))
    with pytest.raises(EOFError):
        ours.recv()


def test_a_reader_that_dies_takes_only_its_own_message(
    pipe: tuple[Any, Any], start: Callable[..., Any]
) -> None:
    ours, theirs = pipe
    first = start(targets.read_one_and_block, theirs)
    for number in range(10):
        ours.send(number)
    assert ours.recv() == ("read", 0)
    first.kill()
    first.join(PATIENCE)
    second = start(targets.read_all_and_report, theirs, 9)
    assert ours.recv() == ("read", list(range(1, 10)))
    second.join(PATIENCE)


def test_a_sender_blocked_on_a_full_pipe_learns_that_the_reader_died(
    pipe: tuple[Any, Any], start: Callable[..., Any]
) -> None:
    ours, theirs = pipe
    child = start(targets.hold, theirs)
    theirs.close()
    assert ours.recv() == "held"
    sent = threading.Event()
    errors: list[BaseException] = []

    def fill() -> None:
        try:
            while True:
                ours.send(bytes(100_000))
                sent.set()
        except OSError as error:
            errors.append(error)

    thread = threading.Thread(target=fill)
    thread.start()
    assert sent.wait(PATIENCE)
    child.kill()
    thread.join(PATIENCE)
    assert not thread.is_alive()
    assert isinstance(errors[0], BrokenPipeError)


def test_a_large_send_ends_when_its_reader_dies(
    pipe: tuple[Any, Any], start: Callable[..., Any]
) -> None:
    ours, theirs = pipe
    child = start(targets.hold, theirs)
    theirs.close()
    assert ours.recv() == "held"
    killer = threading.Timer(0.2, child.kill)
    killer.start()
    try:
        ours.send_bytes(bytes(8 << 20))
        ours.send_bytes(bytes(8 << 20))
    except (BrokenPipeError, EOFError):
        pass  # or it went into the pipe before its end was known
    killer.join()


def test_a_connection_sent_through_a_connection_outlives_its_sender(
    start: Callable[..., Any],
) -> None:
    outer, outer_theirs = fiber.Pipe()
    child = start(targets.make_and_send_a_pipe, outer_theirs)
    outer_theirs.close()
    inner = outer.recv()
    assert inner.recv() == "through the inner pipe"
    child.kill()
    with pytest.raises(EOFError):
        inner.recv()
    inner.close()
    outer.close()


def test_a_stopped_reader_holds_up_its_own_pipe_only(start: Callable[..., Any]) -> None:
    stopped, stopped_theirs = fiber.Pipe()
    lively, lively_theirs = fiber.Pipe()
    sleeper = start(targets.echo, stopped_theirs)
    start(targets.echo, lively_theirs)
    stopped.send(1)
    assert stopped.recv() == 1
    stop_and_wait(sleeper.pid)
    stopped.send(2)
    for number in range(100):
        lively.send(number)
        assert lively.recv() == number
    assert not stopped.poll()
    os.kill(sleeper.pid, signal.SIGCONT)
    assert stopped.recv() == 2
    for end in (stopped, stopped_theirs, lively, lively_theirs):
        end.close()


def test_wait_mixes_connections_and_sentinels(start: Callable[..., Any]) -> None:
    pipes = [fiber.Pipe() for _ in range(3)]
    children = [start(targets.hold, theirs) for _, theirs in pipes]
    ours = [one for one, _ in pipes]
    for end in ours:
        assert end.recv() == "held"
    watched = [*ours, *(child.sentinel for child in children)]
    assert connection.wait(watched, 0) == []
    children[1].kill()
    assert connection.wait(watched, PATIENCE) == [children[1].sentinel]
    for end in (end for pair in pipes for end in pair):
        end.close()
