"""Finalizers, signal handlers and Ctrl-C that strike in the middle of sharing something.

What is planted does what they could do, at the worst moment.  Each test runs on a thread, so that a
deadlock fails it.
"""

from __future__ import annotations

import os
import pickle
import threading
from collections.abc import Callable
from typing import Any

import pytest

import fiber
from fiber import queues, reduction
from fiber._hub import feeder, handles, hub
from fiber._hub.client import HubStream
from fiber._hub.local import LocalChannel
from fiber._hub.protocol import ObjectKind
from fiber._hub.registry import Registry
from fiber._transport import unix
from fiber._wire.arena import Arena, Block
from fiber.connection import Connection, wait
from hosts import PATIENCE, Hosts
from unit.interrupting import is_interrupted

MORE_THAN_FITS = 2000


def without_deadlock(function: Callable[[], Any]) -> Any:
    """Its result, or a failure if it does not come."""
    results: list[Any] = []
    thread = threading.Thread(target=lambda: results.append(function()), daemon=True)
    thread.start()
    thread.join(PATIENCE)
    assert not thread.is_alive(), "deadlock"
    assert results, "it raised"
    return results[0]


def once(interrupt: Callable[[], Any], function: Callable[..., Any]) -> Callable[..., Any]:
    """``function``, interrupted at its first call."""
    first = [True]

    def interrupted(*args: Any, **options: Any) -> Any:
        if first:
            first.pop()
            interrupt()
        return function(*args, **options)

    return interrupted


# Queues


def test_a_put_within_a_put_of_the_same_queue(monkeypatch: pytest.MonkeyPatch) -> None:
    queue: Any = fiber.Queue()
    send = once(lambda: queue.put("inner"), LocalChannel.try_send)
    monkeypatch.setattr(LocalChannel, "try_send", send)
    without_deadlock(lambda: queue.put("outer"))
    assert {queue.get(), queue.get()} == {"inner", "outer"}


@pytest.mark.parametrize("before", [0, MORE_THAN_FITS], ids=["direct", "fed"])
def test_ctrl_c_at_any_line_of_a_put_leaves_a_queue_that_works(before: int) -> None:
    files = {queues.__file__, feeder.__file__}

    def put_and_drain(stop: int) -> bool:
        """Whether the put was interrupted, at its step number ``stop``."""
        queue: Any = fiber.Queue()
        for number in range(before):
            queue.put(number)
        interrupted = is_interrupted(lambda: queue.put("interrupted"), stop, files)
        queue.put("after")
        items = list(iter(queue.get, "after"))
        assert items[:before] == list(range(before))
        assert items[before:] in ([], ["interrupted"])
        queue.close()
        queue.join_thread()
        return interrupted

    steps = 0
    while without_deadlock(lambda: put_and_drain(steps)):  # noqa: B023 - it ends before the next
        steps += 1
    assert steps > 10, "it was hardly interrupted"


@pytest.mark.parametrize("fed", [False, True], ids=["direct", "fed"])
@pytest.mark.parametrize("make", [fiber.Queue, fiber.JoinableQueue])
def test_ctrl_c_at_any_step_of_a_put_costs_no_place_and_no_join(
    make: Callable[[int], Any], fed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if fed:
        monkeypatch.setattr(LocalChannel, "can_try_send", False)
        monkeypatch.setattr(feeder.Feeder, "_start_thread", lambda _: None)
    files = {queues.__file__, feeder.__file__, unix.__file__}

    def put(stop: int) -> bool:
        """Whether the put was interrupted, at its step number ``stop``."""
        queue = make(1)
        interrupted = is_interrupted(lambda: queue.put("interrupted"), stop, files)
        there = len(queue._feeder._unsent) + queue._inbox.poll(0)
        unfinished = queue._unfinished.value() if make is fiber.JoinableQueue else there
        assert there or not queue.full(), f"its place is lost at step {stop}"
        assert unfinished <= there, f"nobody can join after step {stop}"
        if fed:
            assert (unfinished, queue.full()) == (there, bool(there)), f"at step {stop}"
        queue._feeder._unsent.clear()
        return interrupted

    steps = 0
    while without_deadlock(lambda: (put(steps),))[0]:  # noqa: B023 - it ends before the next
        steps += 1
    assert steps > 10, "it was hardly interrupted"


def test_ctrl_c_at_any_step_of_acquire_costs_nobody_a_semaphore() -> None:
    steps = 0
    while True:
        semaphore = fiber.Semaphore(1)
        if not is_interrupted(semaphore.acquire, steps, {unix.__file__}):
            break
        assert semaphore.get_value() == 1, f"interrupted at step {steps}"
        steps += 1
    assert steps > 3, "it was hardly interrupted"


# Handles


def test_sharing_within_sharing_in_the_hubs_own_process() -> None:
    fds = [os.eventfd(0), os.eventfd(0)]
    closed: list[Any] = []

    class Hosted:
        def __init__(self, fd: int) -> None:
            self.fd = fd

        def fileno(self) -> int:
            return self.fd

    inner: list[tuple[int, int]] = []

    def share_again() -> None:
        inner.extend(registry.register(ObjectKind.COUNTER, fd, reusable=True) for fd in fds)

    make: Any = once(share_again, lambda _kind, fd: Hosted(fd))
    registry = Registry(make, closed.append, lambda function, *args: function(*args))
    outer = without_deadlock(lambda: registry.register(ObjectKind.COUNTER, fds[0], reusable=True))
    for number, grant in [outer, *inner]:
        os.close(registry.fetch(number, grant))
        registry.release(grant)
    assert len(registry) == 0
    assert len(closed) == 3
    for fd in [*fds, *(hosted.fd for hosted in closed)]:
        os.close(fd)


def test_the_last_holder_lets_go_while_another_takes_hold() -> None:
    fd = os.eventfd(0)
    registry = Registry(lambda _kind, fd: fd, os.close, lambda function, *args: function(*args))  # type: ignore[arg-type,return-value]
    number, grant = registry.register(ObjectKind.COUNTER, fd, reusable=True)
    hold: Any = once(lambda: registry.release(grant), registry._hold)
    registry._hold = hold  # type: ignore[method-assign]
    again, other = without_deadlock(
        lambda: registry.register(ObjectKind.COUNTER, fd, reusable=True)
    )
    assert again != number
    registry.release(other)
    assert len(registry) == 0
    os.close(fd)


def test_opening_the_hub_within_opening_it(hosts: Hosts, monkeypatch: pytest.MonkeyPatch) -> None:
    inner: list[Any] = []
    made: list[str] = []

    def make(*args: Any, **options: Any) -> str:
        made.append(mkdtemp(*args, **options))
        return made[-1]

    mkdtemp = hub.tempfile.mkdtemp
    open_again: Any = once(lambda: inner.append(hosts["a"].address), make)
    monkeypatch.setattr(hub.tempfile, "mkdtemp", open_again)
    assert without_deadlock(lambda: hosts["a"].address) == inner[0]
    assert [path for path in made if os.path.exists(path)] == [hosts["a"].directory]


def test_sharing_within_sharing_in_a_child(hosts: Hosts, monkeypatch: pytest.MonkeyPatch) -> None:
    with hosts.child_at("a"):
        ends = fiber.Pipe()
        inner: list[bytes] = []
        register = once(lambda: inner.append(pickle.dumps(ends[0])), handles._register)
        monkeypatch.setattr(handles, "_register", register)
        outer = without_deadlock(lambda: pickle.dumps(ends[1]))
        pickle.loads(inner[0]).send("through")
        assert pickle.loads(outer).recv() == "through"


def test_what_was_sent_within_a_pickling_that_failed_stays_sent(hosts: Hosts) -> None:
    with hosts.at("a"):
        carrier, reader = fiber.Pipe()
        here, there = fiber.Pipe()
        other, unused = fiber.Pipe()
        unused.close()

        class Interrupted:
            def __reduce__(self) -> Any:
                carrier.send(there)
                raise TypeError("it does not pickle")

        with pytest.raises(TypeError):
            reduction.encode([other, Interrupted()])
        here.send("hello")
        received = reader.recv()
        assert received.recv() == "hello"
        for end in (carrier, reader, here, there, other, received):
            end.close()


def test_a_task_is_reusable_whatever_was_sent_while_it_was_pickled(hosts: Hosts) -> None:
    with hosts.at("a"):
        carrier, reader = fiber.Pipe()
        unused, there = fiber.Pipe()
        unused.close()

        class Interrupted:
            def __reduce__(self) -> Any:
                carrier.send(there)
                return int, ()

        data, _, grants = reduction.encode_reusable([there, Interrupted()])
        assert grants is not None
        received = [pickle.loads(data)[0], pickle.loads(data)[0], reader.recv()]
        grants.release()
        for end in (carrier, reader, there, *received):
            end.close()


# Objects of other hosts


def test_asking_within_asking_for_the_descriptor_of_a_far_pipe(
    pipe: tuple[Connection, Connection], monkeypatch: pytest.MonkeyPatch
) -> None:
    here, far = pipe
    monkeypatch.setattr(HubStream, "ask", once(far.fileno, HubStream.ask))
    without_deadlock(far.fileno)
    assert wait([far], 0) == []
    here.send(1)
    assert wait([far], PATIENCE) == [far]
    assert far.recv() == 1
    assert wait([far], 0) == []


def test_receiving_within_receiving_from_a_far_pipe(
    pipe: tuple[Connection, Connection], monkeypatch: pytest.MonkeyPatch
) -> None:
    here, far = pipe
    here.send(1)
    here.send(2)
    got: list[int] = []
    monkeypatch.setattr(HubStream, "ask", once(lambda: got.append(far.recv()), HubStream.ask))
    got.append(without_deadlock(far.recv))
    assert sorted(got) == [1, 2]


# Memory for large messages


def test_a_large_message_within_a_large_message() -> None:
    arena = Arena()
    blocks: list[Block] = []

    class Interrupting(Block):
        @property
        def capacity(self) -> int:  # type: ignore[override]
            if not blocks:
                blocks.append(arena.claim(1000))
            return 1 << 16

        @capacity.setter
        def capacity(self, _value: int) -> None:
            pass

    planted = Interrupting(1 << 16)
    blocks.clear()
    without_deadlock(lambda: (arena.settle(planted, sent=False), arena.claim(1000)))
    arena._forget()
    for block in {planted, *blocks}:
        if not block.flag.closed:
            block.close()
