"""Messages of many megabytes between hosts: they arrive, and cost no agent."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from glob import glob
from pathlib import Path
from typing import Any

import pytest

import fiber
from faults import targets
from faults.program import wait_for
from faults.runtime import running
from faults.wire import Wire
from fiber._wire.memory_files import RETAINED_LIMIT
from patience import PATIENCE

MEGABYTES = [64, *(pytest.param(size, marks=pytest.mark.long) for size in (256, 2048, 4100))]
"""The largest is above 4 GiB."""

pytestmark = pytest.mark.timeout(900)


@pytest.fixture
def one_agent() -> Iterator[None]:
    """The test must not cost the only agent."""
    with running(backend="loopback", agents=1), fiber.Pool(1) as pool:
        before = pool.apply(os.getppid)
        yield
        assert pool.apply(os.getppid) == before


def small_tasks(pool: Any, until: Any) -> None:
    """Run some at least, and go on for as long as the large message travels."""
    done = 0
    while not until.ready() or done < 100:
        assert pool.apply(abs, (-done,)) == done
        done += 1


@pytest.mark.usefixtures("one_agent")
@pytest.mark.parametrize("megabytes", MEGABYTES)
def test_arguments_and_results(megabytes: int) -> None:
    data = targets.content(megabytes << 20)
    expected = targets.checksum(data)
    with fiber.Pool(1) as pool, fiber.Pool(1) as other:
        argument = pool.apply_async(targets.checksum, (data,))
        del data
        small_tasks(other, argument)
        assert argument.get() == expected
        result = pool.apply_async(targets.content, (megabytes << 20,))
        small_tasks(other, result)
        assert targets.checksum(result.get()) == expected


@pytest.mark.usefixtures("one_agent")
@pytest.mark.parametrize("megabytes", MEGABYTES)
def test_pipes_and_queues(megabytes: int) -> None:
    data = targets.content(megabytes << 20)
    expected = targets.checksum(data)
    ours, theirs = fiber.Pipe()
    requests: Any = fiber.Queue()
    replies: Any = fiber.Queue()
    child = fiber.Process(target=targets.echo_large, args=(theirs, requests, replies))
    child.start()
    theirs.close()
    ours.send_bytes(data)
    del data
    assert ours.recv() == expected
    received = ours.recv_bytes()
    assert targets.checksum(received) == expected
    requests.put(received)
    del received
    assert replies.get() == expected
    assert targets.checksum(replies.get()) == expected
    child.join()
    assert child.exitcode == 0


@pytest.mark.usefixtures("one_agent")
@pytest.mark.parametrize("megabytes", [1, *MEGABYTES[:-1]])
def test_arguments_of_a_process(megabytes: int) -> None:
    ours, theirs = fiber.Pipe()
    data = targets.content(megabytes << 20)
    child = fiber.Process(target=targets.send_checksum, args=(theirs, data))
    child.start()
    theirs.close()
    assert ours.recv() == targets.checksum(data)
    child.join()
    assert child.exitcode == 0


@pytest.mark.parametrize("way", ["argument", "result"])
def test_a_large_message_is_in_no_process_more_than_twice(wire: Wire, way: str) -> None:
    size, constant = 1 << 27, 48 << 20
    data = targets.content(size if way == "argument" else 0)
    with fiber.Pool(1) as pool:
        pids = [os.getpid(), wire.agent_pid(), pool.apply(os.getpid)]
        before = [forget_peak(pid) for pid in pids]
        if way == "argument":
            pool.apply(len, (data,))
        else:
            assert len(pool.apply(targets.content, (size,))) >= size
        grown = [resident(pid, "VmHWM") - was for pid, was in zip(pids, before, strict=True)]
    grown[0] += len(data)
    assert max(grown) < 2 * size + constant


def resident(pid: int, what: str) -> int:
    """Return the bytes of memory that a process has now (VmRSS), or had at most (VmHWM)."""
    status = Path(f"/proc/{pid}/status").read_text()
    (line,) = [line for line in status.splitlines() if line.startswith(what)]
    return int(line.split()[1]) << 10


def forget_peak(pid: int) -> int:
    """Have the system count a process's peak memory anew; return its current memory."""
    Path(f"/proc/{pid}/clear_refs").write_text("5")
    return resident(pid, "VmRSS")


# Links that break, processes that are killed

LARGE = 1 << 26
"""Bytes of a message in whose middle a process is killed."""


@contextmanager
def broken_halfway(wire: Wire, size: int) -> Iterator[None]:
    """Let the connection break once, in the middle of a message."""
    wire.proxy.break_after = size // 2
    yield
    assert wire.proxy.break_after is None


@pytest.mark.parametrize("megabytes", [32, pytest.param(256, marks=pytest.mark.long)])
def test_a_large_message_survives_the_end_of_its_connection(wire: Wire, megabytes: int) -> None:
    size = megabytes << 20
    data = targets.content(size)
    expected, half = targets.checksum(data), partial(broken_halfway, wire, size)
    ours, theirs = fiber.Pipe()
    queues: list[Any] = [fiber.Queue(), fiber.Queue()]
    with fiber.Pool(1) as pool:
        pid = pool.apply(os.getpid)
        with half():
            assert pool.apply(targets.checksum, (data,)) == expected
        with half():
            assert targets.checksum(pool.apply(targets.content, (size,))) == expected
        assert pool.apply(os.getpid) == pid, "the worker was started again"
    child = wire.start(targets.exchange_large, theirs, *queues)
    theirs.close()
    for send, receive in ((ours.send, ours.recv), (queues[0].put, queues[1].get)):
        with half():
            send(data)
            assert ours.recv() == expected
        with half():
            ours.send("back")
            assert targets.checksum(receive()) == expected
    child.join(PATIENCE)
    assert child.exitcode == 0
    assert wire.agents() == ["loopback-0"]


@contextmanager
def killed_halfway(wire: Wire, victim: Callable[[], int]) -> Iterator[None]:
    """Kill a process when half of a large message has passed."""
    wire.proxy.silent_after = LARGE // 2
    yield
    wait_for(lambda: wire.proxy.silent_after is None)
    assert large_memory(wire.agent_pid())
    os.kill(victim(), signal.SIGKILL)
    wire.proxy.heal()


def large_memory(pid: int) -> list[int]:
    """Return the sizes of the large memory files that a process has open or mapped."""
    sizes = []
    for fd in glob(f"/proc/{pid}/fd/*"):
        with contextlib.suppress(FileNotFoundError):
            if os.readlink(fd).startswith("/memfd:fiber-"):
                sizes.append(os.stat(fd).st_size)
    for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
        if "/memfd:fiber-" in line:
            begin, end = line.split()[0].split("-")
            sizes.append(int(end, 16) - int(begin, 16))
    return [size for size in sizes if size > RETAINED_LIMIT]


def nothing_is_left(wire: Wire) -> None:
    """Wait until the master and the agent have freed all large messages."""
    wait_for(lambda: large_memory(os.getpid()) == large_memory(wire.agent_pid()) == [])
    (agent,) = wire.backend.agents.agents.values()
    wait_for(lambda: agent._link.statistics().queued_bytes == 0)
    assert agent._link.statistics().partial_bytes == 0


@pytest.mark.parametrize("victim", ["worker", "agent"])
@pytest.mark.parametrize("way", ["argument", "result"])
def test_a_task_runs_again_if_its_process_is_killed_in_the_middle_of_its_message(
    wire: Wire, way: str, victim: str
) -> None:
    data = targets.content(LARGE)
    task: tuple[Any, Any] = (targets.checksum, (data,))
    if way == "result":
        task = (targets.content, (LARGE,))
    expected = targets.checksum(data) if way == "argument" else data
    with fiber.Pool(1) as pool:
        pid = pool.apply(os.getpid) if victim == "worker" else wire.agent_pid()
        with killed_halfway(wire, lambda: pid):
            result = pool.apply_async(*task)
        assert result.get(PATIENCE) == expected
        assert pool.apply(abs, (-1,)) == 1
        nothing_is_left(wire)


@pytest.mark.parametrize("kind", ["pipe", "queue"])
def test_a_receiver_that_is_killed_in_the_middle_of_a_message(wire: Wire, kind: str) -> None:
    data = targets.content(LARGE)
    ours, theirs = fiber.Pipe()
    queue: Any = fiber.Queue()
    child = wire.start(targets.receive_and_block, theirs.recv if kind == "pipe" else queue.get)
    wait_for(lambda: child.pid is not None)
    theirs.close()
    with killed_halfway(wire, lambda: child.pid):
        sender = threading.Thread(
            target=send, args=(ours.send if kind == "pipe" else queue.put, data)
        )
        sender.start()
    child.join(PATIENCE)
    sender.join(PATIENCE)
    assert child.exitcode == -signal.SIGKILL
    if kind == "pipe":
        with pytest.raises(EOFError):
            ours.recv()
    nothing_is_left(wire)


@pytest.mark.parametrize("kind", ["pipe", "queue"])
def test_a_sender_that_is_killed_in_the_middle_of_a_message(wire: Wire, kind: str) -> None:
    ours, theirs = fiber.Pipe()
    queue: Any = fiber.Queue()
    put = theirs.send if kind == "pipe" else queue.put
    with killed_halfway(wire, lambda: child.pid):
        child = wire.start(targets.send_and_block, put, LARGE)
        theirs.close()
    child.join(PATIENCE)
    assert child.exitcode == -signal.SIGKILL
    assert (ours.recv() if kind == "pipe" else queue.get()) == targets.content(LARGE)
    if kind == "pipe":
        with pytest.raises(EOFError):
            ours.recv()
    nothing_is_left(wire)


def send(put: Callable[[bytes], None], data: bytes) -> None:
    """Send it to a process that may be killed."""
    with contextlib.suppress(BrokenPipeError):
        put(data)
