"""Finalizers, signal handlers and Ctrl-C that strike in the middle of sharing something.

What is planted does what they could do, at the worst moment.  Each test runs on a thread, so that a
deadlock fails it.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import pickle
import socket
import sys
import tempfile
import threading
from collections.abc import Callable
from functools import partial
from types import FrameType, SimpleNamespace
from typing import Any

import pytest

import fiber
from fiber import queues, reduction
from fiber._agent.agent import Agent
from fiber._hub import handles, hub, queue_delivery, registry, remote
from fiber._hub.client import HubStream, ObjectUnreachable
from fiber._hub.handles import GrantSet
from fiber._hub.local import QuietSocket
from fiber._hub.one_way import SendingEnd
from fiber._hub.protocol import NO_SECRET, ONE, SECRET, Op
from fiber._runtime import state
from fiber._sync import semaphore as shared_semaphore
from fiber._transport import channels
from fiber._transport.loop import Wakeup
from fiber._wire import memory_files, packet
from fiber._wire.memory_files import Arena, MessageBlock
from fiber.connection import Connection, wait
from fiber.results import IMapIterator
from hosts import Hosts, objects_kept
from patience import PATIENCE
from unit.interrupting import CALLS, INSTRUCTIONS, is_interrupted

MORE_THAN_FITS = 2000


def without_deadlock(function: Callable[[], Any]) -> Any:
    """Return its result, or fail if it does not come."""
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
    send = once(lambda: queue.put("inner"), SendingEnd.try_send_directly)
    monkeypatch.setattr(SendingEnd, "try_send_directly", send)
    without_deadlock(lambda: queue.put("outer"))
    assert {queue.get(), queue.get()} == {"inner", "outer"}


@pytest.mark.slow
@pytest.mark.parametrize("before", [0, MORE_THAN_FITS], ids=["direct", "fed"])
def test_ctrl_c_at_any_line_of_a_put_leaves_a_working_queue(before: int) -> None:
    files = {queues.__file__, queue_delivery.__file__}

    def put_and_drain(stop: int) -> bool:
        """Return whether the put was interrupted, at its step number ``stop``."""
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
        monkeypatch.setattr(SendingEnd, "can_try_send", False)
        monkeypatch.setattr(queue_delivery.Feeder, "_start_thread", lambda _: None)
    files = {queues.__file__, queue_delivery.__file__, channels.__file__}

    def put(stop: int) -> bool:
        """Return whether the put was interrupted, at its step number ``stop``."""
        queue = make(1)
        interrupted = is_interrupted(lambda: queue.put("interrupted"), stop, files)
        there = len(queue._feeder._unsent) + queue._inbox.poll(0)
        unfinished = queue._unfinished.value() if make is fiber.JoinableQueue else there
        assert there or not queue.full(), f"its place is lost at step {stop}"
        assert unfinished <= there, f"nobody can join after step {stop}"
        queue._feeder._unsent.clear()
        return interrupted

    steps = 0
    while without_deadlock(lambda: (put(steps),))[0]:  # noqa: B023 - it ends before the next
        steps += 1
    assert steps > 10, "it was hardly interrupted"


def acquired_again() -> Any:
    lock = fiber.RLock()
    lock.acquire()
    return lock


@pytest.mark.parametrize("make", [fiber.Lock, fiber.RLock, fiber.Semaphore, acquired_again])
def test_ctrl_c_in_acquire_leaves_the_lock_to_others(make: Callable[[], Any]) -> None:
    steps = 0
    while True:
        lock = make()
        files = {shared_semaphore.__file__}
        if not is_interrupted(lock.acquire, steps, files, steps=CALLS):
            break
        if make is acquired_again:
            lock.release()
        taken = without_deadlock(lambda: [lock.acquire(timeout=PATIENCE)])  # noqa: B023
        assert taken == [True], f"interrupted at step {steps}"
        steps += 1
    assert steps > 3, "it was hardly interrupted"


# The runtime


# Handles

SHARING = {registry.__file__, hub.__file__, handles.__file__}


def test_sharing_at_any_line_of_sharing(hosts: Hosts) -> None:
    with hosts.at("a") as hub:
        here, there = fiber.Pipe()
        inner: list[bytes] = []

        def share() -> bytes:
            return pickle.dumps(there)

        outer = at_each_line(lambda: inner.append(share()), share, SHARING)
        assert objects_kept(hub) == 1
        for data in (outer, *inner):
            pickle.loads(data).close()
        assert objects_kept(hub) == 0
        here.close()


def test_a_handler_at_any_line_of_sharing_may_wait_for_the_hub(hosts: Hosts) -> None:
    with hosts.at("a") as hub:
        here, there = fiber.Pipe()
        stream = HubStream(hub.address)

        def ask() -> None:
            stream.say(Op.RELEASE, NO_SECRET, form=SECRET)
            stream.ask(Op.SYNC, 0, form=ONE)

        def share() -> None:
            with handles.collecting_grants() as grants:
                data = pickle.dumps(there)
            pickle.loads(data).close()
            grants.release()

        without_deadlock(lambda: at_each_line(ask, share, SHARING) or True)
        assert objects_kept(hub) == 0
        for end in (stream, here, there):
            end.close()


def test_a_finalizer_at_any_line_of_the_hub_may_share(hosts: Hosts) -> None:
    with hosts.at("a") as hub:
        here, there = fiber.Pipe()
        first = pickle.dumps(there)
        inner: list[bytes] = []
        loop_trace = striking(lambda: inner.append(pickle.dumps(there)), SHARING)
        hosts.on_loop(sys.settrace, loop_trace)
        pickle.loads(first).close()
        hosts.on_loop(sys.settrace, None)
        assert objects_kept(hub) == 1
        assert len(inner) > 10
        for data in inner:
            pickle.loads(data).close()
        assert objects_kept(hub) == 0
        here.close()


def test_waits_for_a_hub_that_ends_get_the_error(
    hosts: Hosts, monkeypatch: pytest.MonkeyPatch
) -> None:
    with hosts.at("a") as hub_a:
        here, there = fiber.Pipe()
        data = pickle.dumps(there)
        call_soon = hosts.loop.call_soon

        def ends_first(*_: Any) -> None:
            monkeypatch.undo()
            call_soon(hub_a.close)

        monkeypatch.setattr(hosts.loop, "call_soon", ends_first)
        with pytest.raises(ObjectUnreachable, match="has ended"):
            pickle.loads(data)
        here.close()


def striking(action: Callable[[], Any], files: set[str]) -> Callable[..., Any]:
    """Return a trace function that calls an action once at each line of the code in ``files``."""
    struck: set[tuple[Any, int]] = set()

    def trace(frame: FrameType, event: str, _arg: Any) -> Any:
        line = (frame.f_code, frame.f_lineno)
        if event == "line" and frame.f_code.co_filename in files and line not in struck:
            struck.add(line)
            action()
        return trace

    return trace


def at_each_line(action: Callable[[], Any], function: Callable[[], Any], files: set[str]) -> Any:
    """Call ``function``, and ``action`` at its lines in ``files``."""
    lines: list[None] = []

    def strike() -> None:
        lines.append(None)
        action()

    before = sys.gettrace()
    sys.settrace(striking(strike, files))
    try:
        result = function()
    finally:
        sys.settrace(before)
    assert len(lines) > 10, "it was hardly interrupted"
    return result


def test_opening_the_hub_within_opening_it(hosts: Hosts, monkeypatch: pytest.MonkeyPatch) -> None:
    inner: list[Any] = []
    made: list[str] = []

    def make(*args: Any, **options: Any) -> str:
        made.append(mkdtemp(*args, **options))
        return made[-1]

    mkdtemp = tempfile.mkdtemp
    open_again: Any = once(lambda: inner.append(hosts["a"].address), make)
    monkeypatch.setattr(tempfile, "mkdtemp", open_again)
    assert without_deadlock(lambda: hosts["a"].address) == inner[0]
    assert [path for path in made if os.path.exists(path)] == [hosts["a"].directory]


def test_a_handler_at_any_line_of_opening_the_hub_may_wait_for_the_loop(hosts: Hosts) -> None:
    def opened_twice(line: int) -> bool:
        """Return whether opening a hub was interrupted, at its line number ``line``."""
        opening, lines = hosts[f"host {line}"], itertools.count()
        seen: list[Any] = []
        known = threading.Event()

        def see() -> None:
            seen.append(opening.address)
            known.set()

        def ask() -> None:
            if next(lines) == line:
                hosts.on_loop(see)
                assert known.wait(PATIENCE)

        sys.settrace(striking(ask, {hub.__file__}))
        address = opening.address
        sys.settrace(None)
        assert seen in ([], [address])
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as caller:
            caller.connect(address.path)
        return bool(seen)

    line = 0
    while without_deadlock(lambda: [opened_twice(line)])[0]:  # noqa: B023 - it ends before the next
        line += 1
    assert line > 10, "it was hardly interrupted"


def test_sharing_within_sharing_in_a_child(hosts: Hosts, monkeypatch: pytest.MonkeyPatch) -> None:
    with hosts.child_at("a"):
        ends = fiber.Pipe()
        inner: list[bytes] = []
        register = once(lambda: inner.append(pickle.dumps(ends[0])), handles._register)
        monkeypatch.setattr(handles, "_register", register)
        outer = without_deadlock(lambda: pickle.dumps(ends[1]))
        pickle.loads(inner[0]).send("through")
        assert pickle.loads(outer).recv() == "through"


def test_messages_sent_within_a_failed_pickling_stay_sent(hosts: Hosts) -> None:
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


def test_a_task_is_reusable_after_messages_sent_during_its_pickling(hosts: Hosts) -> None:
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
    far_pipe: tuple[Connection, Connection], monkeypatch: pytest.MonkeyPatch
) -> None:
    here, far = far_pipe
    monkeypatch.setattr(HubStream, "ask", once(far.fileno, HubStream.ask))
    without_deadlock(far.fileno)
    assert wait([far], 0) == []
    here.send(1)
    assert wait([far], PATIENCE) == [far]
    assert far.recv() == 1
    assert wait([far], 0) == []


def test_receiving_within_receiving_from_a_far_pipe(
    far_pipe: tuple[Connection, Connection], monkeypatch: pytest.MonkeyPatch
) -> None:
    here, far = far_pipe
    here.send(1)
    here.send(2)
    got: list[int] = []
    monkeypatch.setattr(HubStream, "ask", once(lambda: got.append(far.recv()), HubStream.ask))
    got.append(without_deadlock(far.recv))
    assert sorted(got) == [1, 2]


def test_a_remote_pipe_survives_interruptions(
    far_pipe: tuple[Connection, Connection],
) -> None:
    here, far = far_pipe
    step = 0
    files = {remote.__file__}

    def poll() -> list[bool]:
        return [is_interrupted(far.poll, step, files, steps=INSTRUCTIONS)]

    while without_deadlock(poll)[0]:
        here.send(step)
        assert far.recv() == step
        step += 1
    assert step > 10, "it was hardly interrupted"


# Descriptors


@pytest.mark.parametrize("kind", [QuietSocket, GrantSet, Wakeup, IMapIterator])
def test_an_object_whose_construction_was_interrupted_ends_silently(
    kind: type[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", told.append)
    kind.__new__(kind)
    assert told == []


def test_an_interrupted_start_leaves_no_passed_descriptor(
    pipe: tuple[Connection, Connection], monkeypatch: pytest.MonkeyPatch
) -> None:
    site = state.runtime()
    monkeypatch.setattr(Agent, "child", lambda _agent, spec, _observer: spec)
    events = ("started", "received", "recalled", "draining")
    owner: Any = SimpleNamespace(begin=lambda _: forget(), **dict.fromkeys(events))
    process = fiber.Process(target=print, args=pipe)

    def forget() -> None:
        for child in site.children:
            site.children.remove(child)

    def begin() -> None:
        site.start(process, owner)

    def settled() -> list[str]:
        done = threading.Event()
        site.loop.call_soon(done.set)
        assert done.wait(PATIENCE)
        return os.listdir("/proc/self/fd")

    begin()
    before = settled()
    step = 0
    files = {state.__file__, reduction.__file__}
    while is_interrupted(begin, step, files):
        assert settled() == before, f"left at step {step}"
        step += 1
    assert step > 10, "it was hardly interrupted"


@pytest.mark.parametrize("side", ["send", "receive"])
def test_an_interrupted_large_message_is_undamaged(
    side: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = {packet.__file__, memory_files.__file__}
    first, second = b"1" * packet.INLINE_LIMIT * 2, b"2" * packet.INLINE_LIMIT * 2
    before = set(os.listdir("/proc/self/fd"))

    def strike(step: int) -> bool:
        """Return whether the exchange was interrupted, at this step."""
        monkeypatch.setattr(packet, "_arena", Arena())
        pair = channels.socketpair("testing")
        with pair[0] as here, pair[1] as there:
            send, receive = partial(packet.send, here), partial(packet.receive_object, there)
            one, two = pickle.dumps(first), pickle.dumps(second)
            if side == "send":
                interrupted = is_interrupted(lambda: send(one), step, files, steps=INSTRUCTIONS)
                send(two)
            else:
                send(one)
                send(two)
                interrupted = is_interrupted(receive, step, files, steps=INSTRUCTIONS)
            here.close()
            came = []
            with contextlib.suppress(EOFError):
                while True:
                    came.append(receive())
            assert came in ([first, second], [second]), f"damaged at step {step}"
        free = packet._buffers.free
        assert len(set(map(id, free))) == len(free), f"one is free twice after step {step}"
        packet._arena._forget()
        return interrupted

    step = 0
    while strike(step):
        # An interrupt just after the system call may leave the descriptor of its memory open.
        for left in set(os.listdir("/proc/self/fd")) - before:
            with contextlib.suppress(OSError):  # that of the listing itself
                os.close(int(left))
        step += 1
    assert step > 10, "it was hardly interrupted"


# Memory for large messages


def test_a_large_message_within_a_large_message() -> None:
    arena = Arena()
    blocks: list[MessageBlock] = []

    class Interrupting(MessageBlock):
        @property
        def capacity(self) -> int:
            if not blocks:
                blocks.append(arena.claim(1000))
            return 1 << 16

        @capacity.setter
        def capacity(self, _value: int) -> None:
            pass

    planted = Interrupting(1 << 16)
    blocks.clear()

    def settle() -> None:
        arena.settle(planted, sent=False)
        arena.claim(1000)

    without_deadlock(settle)
    arena._forget()
    for block in {planted, *blocks}:
        if not block.flag.closed:
            block.close()
