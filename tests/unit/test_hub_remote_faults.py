"""Objects of another host: what happens when someone is gone.

Host ``a`` has the objects; this process is on host ``b``.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import fiber
from census import wait_until
from fiber._hub import client
from fiber._hub.client import ObjectUnreachable
from fiber._hub.local import LocalCounter
from fiber._hub.protocol import HubAddress
from fiber.connection import Connection
from hosts import Far, Hosts, Wire, background, objects_kept
from patience import PATIENCE

# Processes that die, links that break


def receive_from_afar(own: HubAddress, data: bytes, report: Connection, times: int) -> None:
    client.set_hub_address(own)
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
        arguments = (hosts["b"].address, data, theirs, times)
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


def use_queue_from_afar(own: HubAddress, data: bytes, put: bool, report: Connection) -> None:
    client.set_hub_address(own)
    queue = pickle.loads(data)
    report.send("ready")
    queue.put("lost") if put else queue.get()


@pytest.mark.parametrize("put", [True, False])
def test_a_receiver_that_dies_before_its_answer_takes_no_place(
    put: bool, hosts: Hosts, far: Far, wires: tuple[Wire, Wire]
) -> None:
    queue: Any = fiber.Queue(1)
    free = queue._slots._free
    if put:
        queue.put("first")
    with hosts.at("a"):
        data = pickle.dumps(queue)
    ours, theirs = fiber.Pipe()
    arguments = (hosts["b"].address, data, put, theirs)
    process = fiber.Process(target=use_queue_from_afar, args=arguments, daemon=True)
    process.start()
    assert ours.recv() == "ready"

    def asks() -> bool:
        kept = hosts["a"].registry._users.values()
        served = [users[0].hosted for users in list(kept)]
        return any(getattr(each, "_takers" if put else "_receivers", ()) for each in served)

    assert wait_until(asks, PATIENCE)
    _, down = wires
    done = threading.Event()
    hosts.on_loop(lambda: (down.hold(), done.set()))
    assert done.wait(PATIENCE)
    if put:
        assert queue.get() == "first"
    else:
        queue.put("lost")
    assert wait_until(lambda: bool(down.held), PATIENCE)  # the answer is on its way
    process.kill()
    process.join(PATIENCE)
    hosts.on_loop(down.let_go)
    assert wait_until(lambda: free.value() == 1, PATIENCE)
    assert queue.empty()
    ours.close()
    theirs.close()


def test_an_interrupted_take_gives_back_only_its_tokens(
    far: Far, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*arguments: Any) -> None:
        raise KeyboardInterrupt

    remote = far(LocalCounter.create())
    with monkeypatch.context() as ctrl_c:
        ctrl_c.setattr(client.HubStream, "_reply", interrupted)
        with pytest.raises(KeyboardInterrupt):
            remote.take(None)
    assert remote.value() == 0
    remote.close()


def test_a_remote_receiver_killed_while_waiting_takes_no_message(
    hosts: Hosts, lost_soul: Callable[..., Any]
) -> None:
    here, there = fiber.Pipe()
    process, _ = lost_soul(there)
    os.kill(process.pid, signal.SIGKILL)
    process.join(PATIENCE)
    assert wait_until(lambda: objects_kept(hosts["a"]) == 0, PATIENCE)
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
        except ObjectUnreachable as error:
            errors.append(str(error))

    remote.poll(0)
    waiting = [
        background(fails, remote._channel.recv),
        background(fails, remote.poll, None),
        background(fails, far_counter.take, None),
        background(fails, far_counter.take, PATIENCE),
    ]
    assert wait_until(lambda: len(hosts["a"]._handlers) >= 4, PATIENCE)
    hosts.on_loop(hosts["b"].unlink, "a", "agent a was lost: no heartbeat")
    hosts.on_loop(hosts["a"].unlink, "b", "agent b was lost: no heartbeat")
    for thread in waiting:
        thread.join(PATIENCE)
    assert len(errors) == 4
    assert all("no heartbeat" in error for error in errors)
    with pytest.raises(BrokenPipeError, match=r"no heartbeat|cannot be reached"):
        remote.send(1)
    assert wait_until(lambda: objects_kept(hosts["a"]) == 0, PATIENCE)
    remote.close()


def test_an_unknown_host_is_named(hosts: Hosts) -> None:
    here, there = fiber.Pipe()
    with hosts.at("elsewhere"):
        data = pickle.dumps(there)
    with hosts.at("b"):
        remote = pickle.loads(data)
        with pytest.raises(ObjectUnreachable, match="'elsewhere' cannot be reached"):
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
def test_an_interrupted_receive_loses_no_message(
    hosts: Hosts, far_pipe: tuple[Connection, Connection]
) -> None:
    here, there = far_pipe
    there.poll(0)
    asked = lambda: any(session.waiting for session in hosts["a"]._handlers)  # noqa: E731
    interrupter = background(interrupt_main_thread, asked)
    with pytest.raises(Interrupted):
        there.recv()
    interrupter.join()
    here.send("first")
    assert there.poll(PATIENCE)
    assert there.recv() == "first"


@pytest.mark.usefixtures("interruptible")
def test_a_message_on_its_way_to_an_interrupted_receive_is_kept(
    far_pipe: tuple[Connection, Connection], wires: tuple[Wire, Wire]
) -> None:
    here, there = far_pipe
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
def test_an_interrupted_acquire_takes_no_token(far: Far, wires: tuple[Wire, Wire]) -> None:
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
def test_a_process_forked_by_multiprocessing_has_separate_streams(
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


def test_a_queue_whose_host_is_gone_blocks_no_caller(hosts: Hosts, far: Far) -> None:
    queue: Any = fiber.Queue()
    remote: Any = far(queue)
    remote.put(1)
    assert queue.get(timeout=PATIENCE) == 1
    hosts.on_loop(hosts["b"].unlink, "a", "agent a was lost")
    remote.put(2)
    with pytest.raises(ObjectUnreachable, match="agent a was lost"):
        remote.get()
    remote.close()
    remote.join_thread()


def test_the_thread_that_carries_the_answers_does_not_wait_for_one(hosts: Hosts, far: Far) -> None:
    here, there = fiber.Pipe()
    outcome: list[Any] = []

    def on_the_loop(data: bytes) -> None:
        remote = pickle.loads(data)  # fine: no one waits
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
