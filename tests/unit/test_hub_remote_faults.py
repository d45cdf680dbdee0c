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
from fiber.connection import Connection
from hosts import Far, Hosts, Wire, background, objects_kept
from patience import PATIENCE

# Processes that die, links that break


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
    asked = lambda: any(session.waiting for session in list(hosts["a"]._handlers))  # noqa: E731
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


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_a_fork_of_the_hubs_process_reaches_the_hub_from_outside(hosts: Hosts) -> None:
    with hosts.at("a") as hub:
        address = hub.address
        pid = os.fork()
        if not pid:
            os._exit(0 if (client._local_hub, client._address) == (None, address) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


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
