"""Actions that other processes notice after a message to another host."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest

import fiber
from fiber import queues, synchronize
from fiber._hub.pipelined import PipelinedSender
from fiber._unconfirmed import unconfirmed
from fiber.connection import Connection
from hosts import Far, Hosts, Wire
from patience import PATIENCE


@pytest.fixture(autouse=True)
def child(hosts: Hosts, far: Far) -> Iterator[None]:
    """Make this process a child of host b, which sends without waiting."""
    with hosts.child_at("b"):
        yield


class Watched:
    """Sender that notes whether somebody has waited for its messages."""

    def __init__(self) -> None:
        self.was_waited_for = False

    def flush(self) -> None:
        self.was_waited_for = True


@pytest.fixture
def watched() -> Iterator[Watched]:
    sender = Watched()
    yield sender
    unconfirmed.pop((sender, 1), None)


Act = Callable[[], object]


def send(far: Far) -> Act:
    pipe = fiber.Pipe()
    return lambda: pipe[0].send(1)


def send_elsewhere(far: Far) -> Act:
    _, there = fiber.Pipe()
    remote_end: Connection = far(there)
    remote_end.send("first")
    return partial(remote_end.send, 1)


def put(far: Far) -> Act:
    queue: queues.Queue[int] = fiber.Queue()
    return partial(queue.put, 1)


def put_simply(far: Far) -> Act:
    queue: queues.SimpleQueue[int] = fiber.SimpleQueue()
    return partial(queue.put, 1)


def set_event(far: Far) -> Act:
    return fiber.Event().set


def set_event_elsewhere(far: Far) -> Act:
    event: synchronize.Event = far(fiber.Event())
    return event.set


def release(far: Far) -> Act:
    lock = fiber.Lock()
    lock.acquire()
    return lock.release


def release_recursive(far: Far) -> Act:
    lock = fiber.RLock()
    lock.acquire()
    return lock.release


def release_elsewhere(far: Far) -> Act:
    lock: synchronize.Lock = far(fiber.Lock())
    lock.acquire()
    return lock.release


def close(far: Far) -> Act:
    return fiber.Pipe()[0].close


def close_elsewhere(far: Far) -> Act:
    remote_end: Connection = far(fiber.Pipe()[0])
    return remote_end.close


def make_room(far: Far) -> Act:
    queue: queues.Queue[int] = fiber.Queue(maxsize=1)
    queue.put(1)
    return queue.get


def make_room_elsewhere(far: Far) -> Act:
    queue: queues.Queue[int] = fiber.Queue(maxsize=1)
    remote_end: queues.Queue[int] = far(queue)
    queue.put(1)
    return remote_end.get


def finish(far: Far) -> Act:
    queue: queues.JoinableQueue[int] = fiber.JoinableQueue()
    queue.put(1)
    queue.get()
    return queue.task_done


def pass_barrier(far: Far) -> Act:
    barrier: synchronize.Barrier = far(fiber.Barrier(1))
    return barrier.wait


NOTICED = [
    send, send_elsewhere, put, put_simply, set_event, set_event_elsewhere, release,
    release_recursive, release_elsewhere, close, close_elsewhere, make_room, make_room_elsewhere,
    finish, pass_barrier,
]  # fmt: skip


@pytest.mark.parametrize("make", NOTICED)
def test_what_others_notice_waits_for_earlier_messages(
    make: Callable[[Far], Act], far: Far, watched: Watched
) -> None:
    act = make(far)
    unconfirmed[watched, 1] = None
    act()
    assert watched.was_waited_for


class Interrupted(Watched):
    def flush(self) -> None:
        if threading.current_thread() is threading.main_thread():  # not on that of the hubs
            raise KeyboardInterrupt


@pytest.mark.parametrize("make", [release, release_recursive, release_elsewhere, set_event])
def test_an_interrupt_while_others_messages_are_confirmed_stops_no_release(
    make: Callable[[Far], Act], far: Far
) -> None:
    act: Any = make(far)
    sender = Interrupted()
    unconfirmed[sender, 1] = None
    with pytest.raises(KeyboardInterrupt):
        act()
    unconfirmed.pop((sender, 1), None)
    done = act.__self__
    assert done.is_set() if isinstance(done, synchronize.Event) else done.acquire(False)


def test_an_interrupted_close_ends_the_connection(
    far_pipe: tuple[Connection, Connection],
    wires: tuple[Wire, Wire],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(_: PipelinedSender) -> None:
        raise KeyboardInterrupt

    here, there = far_pipe
    there.send("first")
    up, _ = wires
    up.hold()
    there.send("second")
    monkeypatch.setattr(PipelinedSender, "flush", interrupted)
    with pytest.raises(KeyboardInterrupt):
        there.close()
    monkeypatch.undo()
    up.let_go()
    assert [here.recv() for _ in range(2)] == ["first", "second"]
    assert here.poll(PATIENCE)
    with pytest.raises(EOFError):
        here.recv()


def test_receiving_does_not_wait_for_earlier_messages(
    far_pipe: tuple[Connection, Connection], watched: Watched
) -> None:
    here, there = far_pipe
    here.send(1)
    unconfirmed[watched, 1] = None
    assert there.poll(PATIENCE)
    assert there.recv() == 1
    assert not watched.was_waited_for


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_a_fork_does_not_wait_for_messages_of_its_parent(watched: Watched) -> None:
    unconfirmed[watched, 1] = None
    pid = os.fork()
    if not pid:
        os._exit(len(unconfirmed))
    assert os.waitpid(pid, 0)[1] == 0
    assert watched.was_waited_for  # before the fork, so that the fork's messages come later
