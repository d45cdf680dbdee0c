"""Objects of another host: what can be done with them, and what happens when someone is gone.

Host ``a`` has the objects; this process is on host ``b``.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import select
import signal
import threading
from collections.abc import Callable, Iterator
from multiprocessing.connection import wait
from queue import Empty, Full
from typing import Any

import numpy as np
import pytest

import fiber
from census import wait_until
from fiber._hub import access
from fiber._hub.access import Access
from fiber._hub.client import Unreachable
from fiber._hub.handles import collecting_grants
from fiber._hub.local import LocalChannel, LocalCounter
from fiber._hub.remote import RemoteChannel, RemoteCounter
from fiber.connection import Connection
from fiber.errors import ConnectionClosed
from hosts import Hosts, Wire

PATIENCE = 15.0


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    hosts = Hosts()
    yield hosts
    hosts.close()


@pytest.fixture
def wires(hosts: Hosts) -> tuple[Wire, Wire]:
    return hosts.link("b", "a")


class Far:
    """Brings what lives on host a to this process on host b."""

    def __init__(self, hosts: Hosts) -> None:
        self._hosts = hosts

    def __call__(self, thing: Any) -> Any:
        with self._hosts.at("a"):
            data = pickle.dumps(thing)
        return pickle.loads(data)


@pytest.fixture
def far(hosts: Hosts, wires: tuple[Wire, Wire]) -> Iterator[Far]:
    with hosts.at("b"):
        yield Far(hosts)


@pytest.fixture
def pipe(far: Far) -> Iterator[tuple[Connection, Connection]]:
    """An end of a pipe on its host, and the other end on another."""
    here, there = fiber.Pipe()
    remote = far(there)
    there.close()
    yield here, remote
    here.close()
    remote.close()


def background(function: Callable[..., Any], *args: Any) -> threading.Thread:
    thread = threading.Thread(target=function, args=args)
    thread.start()
    return thread


# Channels


def test_messages_go_both_ways(pipe: tuple[Connection, Connection]) -> None:
    here, there = pipe
    assert isinstance(there._channel, RemoteChannel)
    there.send({"to": ["home"]})
    assert here.recv() == {"to": ["home"]}
    here.send("away")
    assert there.recv() == "away"
    there.send_bytes(b"")
    assert here.recv_bytes() == b""
    here.send_bytes(b"")
    assert there.recv_bytes() == b""


def test_boundaries_are_kept(pipe: tuple[Connection, Connection]) -> None:
    here, there = pipe
    sizes = [0, 1, 70_000, 5, 131_071, 131_072, 131_073, 3]
    for size in sizes:
        there.send_bytes(bytes(size))
        assert here.recv_bytes() == bytes(size)
    sender = background(lambda: [here.send_bytes(bytes(size)) for size in sizes])
    assert [len(there.recv_bytes()) for _ in sizes] == sizes
    sender.join()


def test_large_messages_and_arrays_pass(pipe: tuple[Connection, Connection]) -> None:
    here, there = pipe
    item = {"text": "x" * 5_000_000, "arrays": [np.arange(500_000), np.zeros(0), np.ones(9_000)]}
    for source, sink in ((here, there), (there, here)):
        sender = background(source.send, item)
        got = sink.recv()
        sender.join()
        assert got["text"] == item["text"]
        for array, copy in zip(item["arrays"], got["arrays"], strict=True):
            assert (array == copy).all()
            assert copy.flags.writeable


def test_poll(pipe: tuple[Connection, Connection]) -> None:
    here, there = pipe
    assert not there.poll()
    assert not there.poll(0.01)
    assert not there.poll(-1)
    here.send(1)
    assert there.poll()
    assert there.poll(None)
    assert there.recv() == 1
    assert not there.poll()
    here.close()
    assert there.poll()
    with pytest.raises(EOFError):
        there.recv()


def test_one_ended_pipes_stay_so(far: Far) -> None:
    reader, writer = fiber.Pipe(duplex=False)
    far_writer = far(writer)
    with pytest.raises(OSError, match="write-only"):
        far_writer.recv()
    far_writer.send(1)
    assert reader.recv() == 1


def test_the_end_comes_when_the_far_holder_closes(pipe: tuple[Connection, Connection]) -> None:
    here, there = pipe
    there.send("last words")
    there.close()
    assert here.recv() == "last words"
    with pytest.raises(EOFError):
        here.recv()
    with pytest.raises(OSError, match="handle is closed"):
        there.recv()


def test_sending_to_nobody_fails(pipe: tuple[Connection, Connection]) -> None:
    here, there = pipe
    here.close()
    with pytest.raises(BrokenPipeError):
        there.send(1)


def test_a_blocked_receiver_hears_of_the_end(pipe: tuple[Connection, Connection]) -> None:
    here, there = pipe
    ends: list[type[BaseException]] = []

    def receive() -> None:
        try:
            there.recv()
        except EOFError as error:
            ends.append(type(error))

    thread = background(receive)
    here.close()
    thread.join(PATIENCE)
    assert ends == [ConnectionClosed]


def test_a_full_pipe_makes_the_sender_wait(pipe: tuple[Connection, Connection]) -> None:
    here, there = pipe
    sent: list[int] = []

    def send_all() -> None:
        for number in range(2000):
            there.send(number)
            sent.append(number)

    thread = background(send_all)
    # The pipe's buffer takes some hundreds.
    assert wait_until(lambda: bool(sent), PATIENCE)
    assert [here.recv() for _ in range(2000)] == list(range(2000))
    thread.join(PATIENCE)
    assert len(sent) == 2000


def test_threads_that_wait_do_not_wait_for_each_other(far: Far) -> None:
    here, there = fiber.Pipe()
    remote = far(there)
    got: list[Any] = []
    threads = [background(lambda: got.append(remote.recv())) for _ in range(3)]
    remote.send("sent while three receive")
    assert here.recv() == "sent while three receive"
    for number in range(3):
        here.send(number)
    for thread in threads:
        thread.join(PATIENCE)
    assert sorted(got) == [0, 1, 2]
    remote.close()


def test_it_comes_home_as_what_it_was(hosts: Hosts, far: Far) -> None:
    _, there = fiber.Pipe()
    remote = far(there)
    data = pickle.dumps(remote)
    remote.close()
    with hosts.at("a"):
        home = pickle.loads(data)
    assert isinstance(home._channel, LocalChannel)
    assert os.fstat(home.fileno()).st_ino == os.fstat(there.fileno()).st_ino
    assert wait_until(lambda: len(hosts["a"].registry) == 0, PATIENCE)


def test_collected_handles_of_far_objects_outlive_them(hosts: Hosts, far: Far) -> None:
    here, there = fiber.Pipe()
    remote = far(there)
    there.close()
    with collecting_grants() as collected:
        data = pickle.dumps(remote)
    remote.close()
    for _ in range(2):
        again = pickle.loads(data)
        again.send(1)
        assert here.recv() == 1
        again.close()
    assert not here.poll()
    collected.release()
    assert here.poll(PATIENCE)
    with pytest.raises(EOFError):
        here.recv()


def test_an_unused_handle_that_is_forgotten_holds_nothing(hosts: Hosts, far: Far) -> None:
    _, there = fiber.Pipe()
    remote = far(there)
    del remote
    assert wait_until(lambda: len(hosts["a"].registry) == 0, PATIENCE)


def test_a_handle_used_twice_says_so(hosts: Hosts, far: Far) -> None:
    here, there = fiber.Pipe()
    with hosts.at("a"):
        data = pickle.dumps(there)
    pickle.loads(data).close()
    assert wait_until(lambda: len(hosts["a"].registry) == 0, PATIENCE)
    late = pickle.loads(data)
    with pytest.raises(Unreachable, match="used once already"):
        late.poll()
    with pytest.raises(BrokenPipeError, match="used once already"):
        late.send(1)
    late.close()
    here.close()


# Waiting for several


def test_wait_is_right_before_and_after_receiving(pipe: tuple[Connection, Connection]) -> None:
    here, there = pipe
    for _ in range(3):
        assert wait([there], 0) == []
        here.send(1)
        here.send(2)
        assert wait([there], 0) == [there]
        assert there.recv() == 1
        assert wait([there], 0) == [there]
        assert there.recv() == 2
    assert wait([there, here], 0) == []
    here.close()
    assert wait([there], PATIENCE) == [there]


def test_wait_mixes_near_and_far(far: Far) -> None:
    pipes = [fiber.Pipe() for _ in range(4)]
    readers = [far(reader) if n % 2 else reader for n, (reader, _) in enumerate(pipes)]
    for number, (_, writer) in enumerate(pipes):
        writer.send(number)
    got = set()
    while len(got) < 4:
        got |= {reader.recv() for reader in wait(readers, PATIENCE)}
    assert got == {0, 1, 2, 3}
    for reader in readers:
        reader.close()


def test_a_kept_descriptor_stays_right(pipe: tuple[Connection, Connection]) -> None:
    here, there = pipe
    poller = select.poll()
    poller.register(there.fileno(), select.POLLIN)
    for number in range(20):
        assert poller.poll(0) == []
        here.send(number)
        if number % 2:
            here.send(number)
            assert poller.poll(PATIENCE * 1000)
            assert there.recv() == number
        assert poller.poll(PATIENCE * 1000)
        assert there.recv() == number


def test_what_another_receives_is_not_announced(far: Far) -> None:
    here, there = fiber.Pipe()
    remote = far(there)
    assert wait([remote], 0) == []
    here.send(1)
    assert wait([remote], PATIENCE) == [remote]
    assert there.recv() == 1
    assert wait([remote], 0) == []
    here.send(2)
    assert wait([remote], PATIENCE) == [remote]
    remote.close()


# Counters


def test_a_counter_from_afar(far: Far) -> None:
    counter = LocalCounter.create(2)
    remote = far(counter)
    assert isinstance(remote, RemoteCounter)
    assert remote.value() == 2
    assert remote.take(None)
    assert remote.take(0)
    assert not remote.take(0)
    assert not remote.take(0.01)
    assert not remote.wait(0)
    remote.add(5)
    assert counter.value() == 5
    assert remote.wait(None)
    assert remote.clear() == 5
    assert remote.value() == 0
    waiting = background(remote.take, None)
    counter.add(1)
    waiting.join(PATIENCE)
    assert counter.value() == 0
    remote.close()


def test_changes_are_seen_from_afar_by_all(far: Far) -> None:
    counter = LocalCounter.create(7)
    remote = far(counter)
    assert not remote.changed(7, 0.01)
    assert remote.changed(6, 0.01)
    waiting = [background(remote.changed, 7, None) for _ in range(3)]
    counter.add(1)
    for thread in waiting:
        thread.join(PATIENCE)
        assert not thread.is_alive()
    remote.close()


def test_an_event_and_a_semaphore_from_afar(far: Far) -> None:
    event, semaphore = fiber.Event(), fiber.BoundedSemaphore(1)
    far_event, far_semaphore = far([event, semaphore])
    assert not far_event.wait(0.01)
    waiting = background(far_event.wait, PATIENCE)
    event.set()
    waiting.join(PATIENCE)
    assert far_event.is_set()
    far_event.clear()
    assert not event.is_set()
    with far_semaphore:
        assert not semaphore.acquire(False)
    with pytest.raises(ValueError, match="too many times"):
        far_semaphore.release()


# Queues


def test_a_queue_from_afar(far: Far) -> None:
    queue: Any = fiber.Queue(3)
    remote: Any = far(queue)
    for number in range(3):
        remote.put(number)
    assert remote.full()
    assert remote.qsize() == queue.qsize() == 3
    with pytest.raises(Full):
        remote.put(3, timeout=0.01)
    with pytest.raises(Full):
        remote.put_nowait(3)
    assert queue.get(timeout=PATIENCE) == 0
    assert [remote.get(), remote.get(timeout=PATIENCE)] == [1, 2]
    assert remote.empty()
    with pytest.raises(Empty):
        remote.get(timeout=0.01)
    with pytest.raises(Empty):
        remote.get_nowait()
    queue.put("home")
    assert wait([remote._reader], PATIENCE) == [remote._reader]
    assert remote.get_nowait() == "home"
    remote.put("away")
    remote.close()
    remote.join_thread()
    assert queue.get(timeout=PATIENCE) == "away"


def test_a_joinable_queue_from_afar(far: Far) -> None:
    queue: Any = fiber.JoinableQueue()
    remote: Any = far(queue)
    queue.put(1)
    joiners = [background(queue.join), background(remote.join)]
    assert remote.get() == 1
    assert all(joiner.is_alive() for joiner in joiners)
    remote.task_done()
    for joiner in joiners:
        joiner.join(PATIENCE)
    with pytest.raises(ValueError, match="too many times"):
        remote.task_done()
    remote.close()


# Processes that die, links that break


def receive_from_afar(own: Access, data: bytes, report: Connection, times: int) -> None:
    access.install(own)
    remote = pickle.loads(data)
    remote.poll(0)
    report.send("ready")
    for _ in range(times):
        report.send(remote.recv())
    report.recv()


@pytest.fixture
def lost_soul(hosts: Hosts, far: Far) -> Iterator[Callable[..., Any]]:
    """Starts a child on host b that receives from afar."""
    started: list[tuple[fiber.Process, Connection]] = []

    def begin(end: Connection, times: int = 1) -> tuple[fiber.Process, Connection]:
        with hosts.at("a"):
            data = pickle.dumps(end)
        ours, theirs = fiber.Pipe()
        arguments = (hosts["b"].access, data, theirs, times)
        process = fiber.Process(target=receive_from_afar, args=arguments, daemon=True)
        process.start()
        theirs.close()
        started.append((process, ours))
        assert ours.recv() == "ready"
        return process, ours

    yield begin
    for process, ours in started:
        ours.close()
        process.kill()
        process.join()
        process.close()


def test_a_far_receiver_killed_while_waiting_takes_nothing(
    hosts: Hosts, lost_soul: Callable[..., Any]
) -> None:
    here, there = fiber.Pipe()
    process, _ = lost_soul(there)
    os.kill(process.pid, signal.SIGKILL)
    process.join(PATIENCE)
    assert wait_until(lambda: len(hosts["a"].registry) == 0, PATIENCE)
    here.send("still here")
    assert there.recv() == "still here"


def test_a_far_receiver_takes_no_more_than_it_asked_for(
    lost_soul: Callable[..., Any],
) -> None:
    here, there = fiber.Pipe()
    process, report = lost_soul(there, 2)
    for number in range(5):
        here.send(number)
    assert [report.recv(), report.recv()] == [0, 1]
    os.kill(process.pid, signal.SIGKILL)
    process.join(PATIENCE)
    assert [there.recv() for _ in range(3)] == [2, 3, 4]


def test_the_end_comes_when_the_last_far_holder_is_killed(lost_soul: Callable[..., Any]) -> None:
    here, there = fiber.Pipe()
    process, _ = lost_soul(there)
    there.close()
    assert not here.poll(0)
    os.kill(process.pid, signal.SIGKILL)
    with pytest.raises(EOFError):
        here.recv()
    process.join(PATIENCE)


def test_a_lost_link_ends_every_wait_with_its_reason(hosts: Hosts, far: Far) -> None:
    _, there = fiber.Pipe()
    counter = LocalCounter.create()
    remote, far_counter = far([there, counter])
    errors: list[str] = []

    def fails(wait_for_it: Callable[..., Any], *args: Any) -> None:
        try:
            wait_for_it(*args)
        except Unreachable as error:
            errors.append(str(error))

    remote.poll(0)
    waiting = [
        background(fails, remote._channel.recv),
        background(fails, remote.poll, None),
        background(fails, far_counter.take, None),
        background(fails, far_counter.take, PATIENCE),
    ]
    assert wait_until(lambda: len(hosts["a"]._sessions) >= 4, PATIENCE)
    hosts.on_loop(hosts["b"].unlink, "a", "agent a was lost: no heartbeat")
    hosts.on_loop(hosts["a"].unlink, "b", "agent b was lost: no heartbeat")
    for thread in waiting:
        thread.join(PATIENCE)
    assert len(errors) == 4
    assert all("no heartbeat" in error for error in errors)
    with pytest.raises(BrokenPipeError, match=r"no heartbeat|cannot be reached"):
        remote.send(1)
    assert wait_until(lambda: len(hosts["a"].registry) == 0, PATIENCE)
    remote.close()


def test_a_host_that_nobody_knows_is_named(hosts: Hosts) -> None:
    here, there = fiber.Pipe()
    with hosts.at("elsewhere"):
        data = pickle.dumps(there)
    with hosts.at("b"):
        remote = pickle.loads(data)
        with pytest.raises(Unreachable, match="'elsewhere' cannot be reached"):
            remote.poll()
        remote.close()
    here.close()


class Interrupted(Exception):
    pass


def interrupt(signum: int, frame: Any) -> None:
    raise Interrupted


def interrupt_main_thread(when: Callable[[], bool]) -> None:
    assert wait_until(when, PATIENCE)
    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGUSR1)


@pytest.fixture
def interruptible() -> Iterator[None]:
    before = signal.signal(signal.SIGUSR1, interrupt)
    yield
    signal.signal(signal.SIGUSR1, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupted_receive_loses_nothing(
    hosts: Hosts, pipe: tuple[Connection, Connection]
) -> None:
    here, there = pipe
    there.poll(0)
    asked = lambda: any(session.waiting for session in hosts["a"]._sessions)  # noqa: E731
    interrupter = background(interrupt_main_thread, asked)
    with pytest.raises(Interrupted):
        there.recv()
    interrupter.join()
    here.send("first")
    assert there.poll(PATIENCE)
    assert there.recv() == "first"


@pytest.mark.usefixtures("interruptible")
def test_what_was_on_its_way_to_an_interrupted_receive_is_kept(
    pipe: tuple[Connection, Connection], wires: tuple[Wire, Wire]
) -> None:
    here, there = pipe
    _, down = wires
    there.poll(0)
    down.hold()
    here.send("first")
    interrupter = background(interrupt_main_thread, lambda: bool(down.held))
    with pytest.raises(Interrupted):
        there.recv()
    interrupter.join()
    here.send("second")
    down.let_go()
    assert there.poll(PATIENCE)
    assert there.recv() == "first"
    assert there.recv() == "second"


@pytest.mark.usefixtures("interruptible")
def test_an_interrupted_acquire_takes_nothing(far: Far, wires: tuple[Wire, Wire]) -> None:
    semaphore = fiber.Semaphore(0)
    remote = far(semaphore)
    _, down = wires
    remote.get_value()
    down.hold()
    semaphore.release()
    interrupter = background(interrupt_main_thread, lambda: bool(down.held))
    with pytest.raises(Interrupted):
        remote.acquire()
    interrupter.join()
    down.let_go()
    assert remote.acquire(timeout=PATIENCE)
    assert semaphore.get_value() == 0


def send_from_a_fork(remote: Connection) -> None:
    remote.send("from the fork")
    assert remote.recv() == "to the fork"


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_a_process_forked_by_multiprocessing_has_streams_of_its_own(
    hosts: Hosts, wires: tuple[Wire, Wire]
) -> None:
    here, there = fiber.Pipe()
    with hosts.at("a"):
        data = pickle.dumps(there)
    with hosts.child_at("b"):
        remote = pickle.loads(data)
        assert not remote.poll()
        context = multiprocessing.get_context("fork")
        process = context.Process(target=send_from_a_fork, args=(remote,))
        process.start()
        assert here.recv() == "from the fork"
        here.send("to the fork")
        process.join(PATIENCE)
        assert process.exitcode == 0
        here.send("to the parent")
        assert remote.recv() == "to the parent"
        remote.close()


def test_a_queue_whose_host_is_gone_holds_nobody(hosts: Hosts, far: Far) -> None:
    queue: Any = fiber.Queue()
    remote: Any = far(queue)
    remote.put(1)
    assert queue.get(timeout=PATIENCE) == 1
    hosts.on_loop(hosts["b"].unlink, "a", "agent a was lost")
    remote.put(2)
    with pytest.raises(Unreachable, match="agent a was lost"):
        remote.get()
    remote.close()
    remote.join_thread()


def test_the_thread_that_carries_the_answers_does_not_wait_for_one(hosts: Hosts, far: Far) -> None:
    here, there = fiber.Pipe()
    outcome: list[Any] = []

    def on_the_loop(data: bytes) -> None:
        remote = pickle.loads(data)  # fine: nothing is waited for
        outcome.append(remote)
        try:
            remote.recv()
        except RuntimeError as error:
            outcome.append(error)

    with hosts.at("a"):
        data = pickle.dumps(there)
    hosts.on_loop(on_the_loop, data)
    assert wait_until(lambda: len(outcome) == 2, PATIENCE)
    remote, error = outcome
    assert "wait for itself" in str(error)
    here.send("on another thread")
    assert remote.recv() == "on another thread"
    remote.close()
