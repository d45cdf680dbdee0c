"""Connections: multiprocessing's semantics, for all holders and all ways to end."""

from __future__ import annotations

import gc
import io
import os
import pickle
import signal
import threading
from array import array
from collections.abc import Callable
from contextlib import nullcontext
from multiprocessing.connection import wait
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import fiber
from census import wait_until
from fiber import connection
from fiber._agent.interface import ExitReport
from fiber._transport import channels
from fiber._transport.channels import UnixChannel
from fiber._wire.packet import Message
from fiber.connection import Connection, Pipe
from fiber.errors import ConnectionClosed, UnpicklableError
from leaks import HEAP, descriptors
from patience import PATIENCE
from processes.test_loopback import running


def start(target: Callable[..., Any], *args: Any) -> fiber.Process:
    process = fiber.Process(target=target, args=args, daemon=True)
    process.start()
    return process


# Objects and bytes


def test_an_object_without_a_pickle_is_an_error_and_not_sent() -> None:
    one, other = Pipe()
    with pytest.raises(TypeError, match="pickle"):
        one.send(threading.Lock())
    assert not other.poll()
    with pytest.raises(UnpicklableError, match=r"the object to send .*\(at \['a'\]\)"):
        one.send({"a": threading.Lock()})
    assert not other.poll()


def test_functions_without_a_name_travel_by_value() -> None:
    one, other = Pipe()
    one.send(lambda x: x + 1)
    assert other.recv()(1) == 2


@pytest.mark.parametrize(
    ("window", "expected"),
    [
        ((), b"0123456789"),
        ((3,), b"3456789"),
        ((3, 4), b"3456"),
        ((10,), b""),
        ((0, 0), b""),
    ],
)
def test_a_window_of_bytes(window: tuple[int, ...], expected: bytes) -> None:
    one, other = Pipe()
    one.send_bytes(b"0123456789", *window)
    assert other.recv_bytes() == expected


@pytest.mark.parametrize("window", [(-1,), (11,), (0, -1), (3, 8)])
def test_a_window_outside_is_refused(window: tuple[int, ...]) -> None:
    one, _other = Pipe()
    with pytest.raises(ValueError):
        one.send_bytes(b"0123456789", *window)


def test_anything_with_a_buffer_is_bytes() -> None:
    one, other = Pipe()
    things: list[Any] = [
        bytearray(b"abcd"),
        memoryview(b"abcd"),
        array("i", [1, 2]),
        np.ones((2, 3)),
    ]
    for thing in things:
        one.send_bytes(thing)
        assert other.recv_bytes() == bytes(memoryview(thing).cast("B"))


def test_a_message_that_is_too_long_closes_the_connection() -> None:
    one, other = Pipe()
    one.send_bytes(b"12345")
    assert other.recv_bytes(5) == b"12345"
    one.send_bytes(b"123456")
    with pytest.raises(OSError, match="bad message length"):
        other.recv_bytes(5)
    assert other.closed
    with pytest.raises(ValueError, match="negative"):
        one.recv_bytes(-1)


def test_receiving_into_a_buffer(
    pipe: tuple[Connection, Connection],
) -> None:
    one, other = pipe
    numbers = array("i", range(10))
    one.send_bytes(array("i", [7, 8, 9]))  # type: ignore[arg-type]
    assert other.recv_bytes_into(numbers, 4) == 12
    assert numbers.tolist() == [0, 7, 8, 9, 4, 5, 6, 7, 8, 9]
    one.send_bytes(b"longer than fits")
    with pytest.raises(fiber.BufferTooShort) as caught:
        other.recv_bytes_into(bytearray(4))
    assert caught.value.args == (b"longer than fits",)
    with pytest.raises(ValueError, match="negative offset"):
        other.recv_bytes_into(bytearray(4), -1)
    with pytest.raises(ValueError, match="offset too large"):
        other.recv_bytes_into(bytearray(4), 5)


def test_an_object_can_be_received_as_bytes_and_bytes_as_an_object() -> None:
    one, other = Pipe()
    items: list[Any] = [{"a": 1}, np.arange(5), np.arange(100_000)]
    for item in items:
        sender = threading.Thread(target=one.send, args=(item,))
        sender.start()
        assert np.array_equal(pickle.loads(other.recv_bytes()), item)
        sender.join()
        sender = threading.Thread(target=one.send_bytes, args=(pickle.dumps(item),))
        sender.start()
        assert np.array_equal(other.recv(), item)
        sender.join()


def test_a_message_of_a_hundred_megabytes() -> None:
    one, other = Pipe()
    item = np.arange(100_000_000 // 8)
    sender = threading.Thread(target=one.send, args=(item,))
    sender.start()
    assert np.array_equal(other.recv(), item)
    sender.join()


def test_a_bulky_message_waits_for_its_reader() -> None:
    one, other = Pipe()
    sent = threading.Event()

    def send() -> None:
        one.send_bytes(bytes(2_000_000))
        sent.set()

    sender = threading.Thread(target=send)
    sender.start()
    assert other.poll(PATIENCE)
    assert not sent.wait(0.05)
    assert len(other.recv_bytes()) == 2_000_000
    assert sent.wait(PATIENCE)
    sender.join()


def test_a_thousand_pipes() -> None:
    pipes: list[tuple[Any, Any]] = [Pipe() for _ in range(200)]
    for number, (one, _) in enumerate(pipes):
        one.send(number)
    assert len(wait([other for _, other in pipes], PATIENCE)) == 200
    assert [other.recv() for _, other in pipes] == list(range(200))


# The end


def test_a_closed_end_refuses_everything() -> None:
    one, _other = Pipe()
    with one:
        pass
    one.close()
    assert one.closed
    uses: list[Callable[[], Any]] = [
        lambda: one.send(1),
        lambda: one.send_bytes(b""),
        one.recv,
        one.recv_bytes,
        one.poll,
        one.fileno,
        lambda: pickle.dumps(one),
    ]
    for use in uses:
        with pytest.raises(OSError, match="handle is closed"):
            use()


def test_a_forgotten_end_is_closed() -> None:
    one, other = Pipe()
    del one
    with pytest.raises(EOFError):
        other.recv()


def hold(connection: Connection, ready: Any) -> None:
    ready.set()
    connection.recv()


def test_the_end_comes_only_when_the_last_holder_has_gone() -> None:
    one, other = Pipe()
    ready = [fiber.Event(), fiber.Event()]
    processes = [start(hold, other, event) for event in ready]
    other.close()
    assert all(event.wait(PATIENCE) for event in ready)
    processes[0].kill()
    processes[0].join(PATIENCE)
    assert not one.poll(0.05)
    processes[1].kill()
    with pytest.raises(EOFError):
        one.recv()
    processes[1].join(PATIENCE)


def test_the_end_says_how_the_other_process_died(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "_NEWS", PATIENCE)
    one, other = Pipe()
    ready = fiber.Event()
    process = start(hold, other, ready)
    other.close()
    assert ready.wait(PATIENCE)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    with pytest.raises(ConnectionClosed, match=f"{process.name}.*SIGKILL"):
        one.recv()
    process.join(PATIENCE)


def close_and_stay(connection: Connection) -> None:
    connection.close()
    signal.pause()


def test_the_end_says_how_a_process_died_that_is_still_exiting(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    one, other = Pipe()
    process = start(close_and_stay, other)
    other.close()

    def stat_of_an_exiting_process(path: str, mode: str) -> io.BytesIO:
        process.kill()
        return io.BytesIO(b"7 (a name) R 1) R 1 7 7 0 -1 4194628 0 0 0 0 0 0 0 0 20 0 1 0 5")

    monkeypatch.setattr(connection, "open", stat_of_an_exiting_process, raising=False)
    monkeypatch.setattr(connection, "_NEWS", PATIENCE)
    with pytest.raises(ConnectionClosed, match=f"{process.name}.*SIGKILL"):
        one.recv()
    process.join(PATIENCE)


# Waiting


def test_wait_mixes_connections_and_sentinels() -> None:
    one, other = Pipe()
    ready = fiber.Event()
    process = start(hold, other, ready)
    assert ready.wait(PATIENCE)
    objects: list[Any] = [one, process.sentinel]
    assert wait(objects, 0) == []
    process.kill()
    assert wait(objects, PATIENCE) == [process.sentinel]
    other.close()
    assert set(wait(objects, PATIENCE)) == {one, process.sentinel}
    process.join(PATIENCE)


# Travelling


def use(carrier: Connection) -> None:
    borrowed = carrier.recv()
    borrowed.send(borrowed.recv() + 1)
    borrowed.close()
    carrier.recv()


def test_connections_travel_through_connections() -> None:
    here, there = Pipe()
    one, other = Pipe()
    process = start(use, there)
    here.send(other)
    other.close()
    one.send(1)
    assert one.recv() == 2
    with pytest.raises(EOFError):
        one.recv()
    here.send("done")
    process.join(PATIENCE)
    assert process.exitcode == 0


def give_away(carrier: Connection) -> None:
    one, other = Pipe()
    carrier.send(other)
    other.close()
    one.send("from a process that has ended")
    carrier.recv()


def test_an_end_outlives_the_process_that_made_it() -> None:
    here, there = Pipe()
    process = start(give_away, there)
    there.close()
    end = here.recv()
    here.send("end")
    process.join(PATIENCE)
    assert end.recv() == "from a process that has ended"
    with pytest.raises(EOFError):
        end.recv()


def open_descriptors() -> int:
    """Count what this process has open, without the memory of shared objects: some of it is kept.

    Another segment of that memory comes whenever the places in the last one are taken.
    """
    return sum(target != HEAP for _, target in descriptors())


def test_sending_connections_leaves_no_descriptor_behind() -> None:
    here, there = Pipe()
    process = start(use, there)
    one, other = Pipe()
    here.send(other)
    one.send(1)
    assert one.recv() == 2
    gc.collect()  # what earlier tests left to the collector must not go while we count
    before = open_descriptors()
    for _ in range(10):
        end, far_end = Pipe()
        queue: Any = fiber.Queue()
        queue.put(far_end)
        queue.get().send(1)
        assert end.recv() == 1
        del end, far_end, queue
    assert wait_until(lambda: open_descriptors() <= before, PATIENCE)
    here.send("done")
    process.join(PATIENCE)


def test_a_failed_send_keeps_no_end_of_another_pipe_open() -> None:
    one, _other = Pipe()
    inner, inner_other = Pipe()
    with pytest.raises(UnpicklableError, match=r"\(at \[1\]\)"):
        one.send([inner_other, threading.Lock()])
    inner_other.close()
    assert inner.poll(PATIENCE), "the hub keeps it"


# Looking for an answer before sleeping


class Clock:
    """Goes on by a microsecond at each look at it."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        self.now += 1e-6
        return self.now


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return the times at which the socket was read, by a simulated clock."""
    clock, times = Clock(), list[float]()
    try_recv = UnixChannel.try_recv

    def look(channel: UnixChannel) -> Message | None:
        times.append(clock.now)
        return try_recv(channel)

    monkeypatch.setattr(channels, "time", clock)
    monkeypatch.setattr(UnixChannel, "try_recv", look)
    return times


def answer_late(here: Connection, there: Connection, looks: list[float]) -> threading.Thread:
    """Answer once the receiver has stopped looking."""

    def answer() -> None:
        assert wait_until(
            lambda: bool(looks) and looks[-1] > looks[0] + channels._LOOK - 2e-6, PATIENCE
        )
        there.send("late")

    thread = threading.Thread(target=answer)
    here.send("question")
    thread.start()
    return thread


def test_a_process_that_has_asked_no_question_does_not_poll(
    pipe: tuple[Connection, Connection], looks: list[float]
) -> None:
    here, there = pipe
    here.send(1)
    assert there.recv() == 1  # what this process sent last went out on the other end
    assert looks == []


def test_a_process_that_asked_another_one_since_does_not_poll(
    pipe: tuple[Connection, Connection], looks: list[float]
) -> None:
    here, there = pipe
    other, its_end = Pipe()
    there.send("answer")
    here.send("question")
    other.send("question")
    assert here.recv() == "answer"
    assert looks == []
    other.close()
    its_end.close()


def test_a_process_that_waits_for_an_answer_polls_and_then_sleeps(
    pipe: tuple[Connection, Connection], looks: list[float]
) -> None:
    here, there = pipe
    thread = answer_late(here, there, looks)
    assert here.recv() == "late"
    thread.join()
    assert 10 < len(looks) < 1.1 * channels._LOOK / 1e-6
    looks.clear()
    for _ in range(255):
        there.send("answer")
        here.send("question")
        assert here.recv() == "answer"
    assert looks == []
    there.send("answer")
    here.send("question")
    assert here.recv() == "answer"
    assert len(looks) == 1


@pytest.mark.parametrize("keys", [(b"one", b"another"), (b"one", b"")])
def test_listener_and_client_prove_to_each_other_that_they_know_the_key(
    keys: tuple[bytes, bytes],
) -> None:
    """Also the client gives nothing to a listener that does not."""
    errors: list[str] = []
    with connection.Listener(("127.0.0.1", 0), authkey=keys[0]) as listener:

        def accept() -> None:
            try:
                listener.accept()
            except connection.AuthenticationError as error:
                errors.append(str(error))

        accepting = threading.Thread(target=accept)
        accepting.start()
        with pytest.raises(connection.AuthenticationError):
            connection.Client(listener.address, authkey=keys[1])
        accepting.join(PATIENCE)
    assert len(errors) == 1


def test_a_client_refuses_a_listener_that_accepts_any_key() -> None:
    with connection.Listener(("127.0.0.1", 0)) as listener:

        def welcome() -> None:
            with listener.accept() as accepted:
                accepted.send_bytes(b"#CHALLENGE#" + b"x" * 20)
                accepted.recv_bytes()
                accepted.send_bytes(b"#WELCOME#")
                accepted.recv_bytes()  # the client's own challenge
                accepted.send_bytes(b"no idea")
                accepted.recv_bytes()  # it says that it does not believe that

        welcoming = threading.Thread(target=welcome)
        welcoming.start()
        with pytest.raises(connection.AuthenticationError):
            connection.Client(listener.address, authkey=b"one")
        welcoming.join(PATIENCE)


class Elsewhere:
    """A process that has ended, whose news comes while it is waited for."""

    def __init__(self, pid: int, *, same_pids: bool) -> None:
        self.pid = pid
        self.same_pids = same_pids
        self.report: ExitReport | None = None
        self._waits = 0

    def wait(self, timeout: float) -> int | None:
        self._waits += 1
        if self._waits == 1:
            return None
        self.report = ExitReport(-signal.SIGKILL, "killed by SIGKILL", pod="es-1")
        return self.report.exitcode


@pytest.mark.parametrize(
    ("same_pids", "told"), [(True, None), (False, "killed by SIGKILL, in pod es-1")]
)
def test_a_pid_of_another_host_is_not_looked_up_on_this_one(
    same_pids: bool, told: str | None
) -> None:
    """The pid is that of a process here that lives: this one."""
    process = SimpleNamespace(_popen=Elsewhere(os.getpid(), same_pids=same_pids))
    assert connection.how_it_ended(process) == told


# A sender's end


def _send_and_die(conn: Any, numbers: int) -> None:
    for number in range(numbers):
        conn.send(number)
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("backend", [nullcontext, running], ids=["local", "loopback"])
def test_what_a_killed_process_has_sent_comes_before_its_end(backend: Any) -> None:
    with backend():
        for numbers in (1, 50):
            here, there = Pipe()
            process = start(_send_and_die, there, numbers)
            there.close()
            process.join()
            assert process.exitcode == -signal.SIGKILL
            assert [here.recv() for _ in range(numbers) if here.poll()] == list(range(numbers))
            with pytest.raises(EOFError):
                here.recv()
