"""The faults of the original Fiber, one test each: none of them may come back.

Left out are those of its managers and of its Kubernetes backend, which are not here yet, and that
of resources that leaked from one pool to the next, since no backend here asks for any.  The one of
jobs that end in error is in test_agents.py, the one of colliding pids in test_scale.py.
"""

from __future__ import annotations

import os
import pickle
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import fiber
from faults import pool_targets as tasks
from faults import targets
from faults.program import wait_for
from fiber._backends import loopback
from fiber._runtime import state
from fiber.errors import StartError, WorkerDied
from fiber.pool import Pool
from patience import PATIENCE

pytestmark = pytest.mark.usefixtures("backend")


@pytest.fixture
def pool() -> Iterator[Pool]:
    with fiber.Pool(4) as made:
        yield made


def test_an_exception_in_a_task_hangs_the_default_pool(pool: Pool) -> None:
    with pytest.raises(LookupError):
        pool.map_async(tasks.fail_if_odd, range(100)).get(PATIENCE)
    assert pool.map_async(abs, [-1]).get(PATIENCE) == [1]


def test_one_killed_worker_hangs_it(pool: Pool, tmp_path: Path) -> None:
    work = [(str(tmp_path), number) for number in range(40)]
    result = pool.starmap_async(tasks.note_and_nap, work, chunksize=1)
    wait_for(lambda: any(tmp_path.iterdir()))
    victim = next(tmp_path.iterdir()).name.split("-")[-1]
    os.kill(int(victim), signal.SIGKILL)
    assert result.get(PATIENCE) == list(range(40))


def test_with_error_handling_a_deterministic_exception_respawns_for_ever(tmp_path: Path) -> None:
    with fiber.Pool(2, error_handling=True, retries=2) as pool:
        with pytest.raises(ConnectionError):
            pool.apply_async(tasks.count_calls, (str(tmp_path), 1, 1000)).get(PATIENCE)
        assert len(list(tmp_path.iterdir())) == 3


def test_a_crash_in_a_chunk_is_never_a_silent_none(pool: Pool) -> None:
    with pytest.raises(WorkerDied, match="die_if"):
        pool.starmap_async(tasks.die_if, [(n, 5) for n in range(10)], chunksize=10).get(PATIENCE)


def test_a_worker_that_dies_at_birth_ends_supervision(pool: Pool) -> None:
    for _ in range(3):
        for process in pool._pool:
            os.kill(process.pid, signal.SIGKILL)
        assert pool.map_async(abs, [-1, -2]).get(PATIENCE) == [1, 2]
    with fiber.Pool(2, initializer=os._exit, initargs=(1,)) as doomed, pytest.raises(StartError):
        doomed.apply_async(abs, (-1,)).get(PATIENCE)


def test_map_of_up_to_32_items_runs_on_one_worker(pool: Pool, tmp_path: Path) -> None:
    work = [(str(tmp_path), n, 4) for n in range(8)]
    assert len(set(pool.starmap(tasks.wait_for_company, work))) == 4


@pytest.mark.parametrize("size", [1 << 20, (1 << 20) + 1, 5 << 20])
def test_messages_over_one_megabyte_hang(pool: Pool, size: int) -> None:
    assert pool.map_async(len, [bytes(size)] * 3).get(PATIENCE) == [size] * 3
    assert len(pool.apply_async(tasks.large, (size,)).get(PATIENCE)) == size
    ours, theirs = fiber.Pipe()
    child = fiber.Process(target=targets.echo, args=(theirs,))
    child.start()
    ours.send(bytes(size))
    assert len(ours.recv()) == size
    ours.close()
    theirs.close()
    child.join(PATIENCE)


def test_imap_hangs_on_an_out_of_order_none(pool: Pool) -> None:
    naps = [0.05, 0, 0, 0.02, 0, 0]
    results = pool.imap(time.sleep, naps)
    assert [results.next(PATIENCE) for _ in naps] == [None] * len(naps)
    unordered = pool.imap_unordered(time.sleep, naps)
    assert [unordered.next(PATIENCE) for _ in naps] == [None] * len(naps)


def test_terminate_on_an_unused_pool_raises() -> None:
    unused = fiber.Pool(2)
    unused.terminate()
    unused.terminate()
    unused.join()
    another = fiber.Pool(2)
    another.close()
    another.join()


def test_a_reader_that_dies_swallows_queued_items() -> None:
    queue: fiber.Queue[Any] = fiber.Queue()
    ours, theirs = fiber.Pipe()
    for number in range(20):
        queue.put(number)
    reader = fiber.Process(target=targets.get_one_and_block, args=(queue, theirs))
    reader.start()
    assert ours.recv() == 0
    reader.kill()
    reader.join(PATIENCE)
    assert [queue.get(timeout=PATIENCE) for _ in range(19)] == list(range(1, 20))
    for end in (ours, theirs, queue):
        end.close()
    queue.join_thread()
    reader.close()


def test_a_stranger_stops_every_later_start(backend: str) -> None:
    running = state.runtime().backend
    if isinstance(running, loopback.LoopbackBackend):
        host, _, port = running._listener.address.rpartition(":")
        door: Any = (host, int(port))
        family, kind = socket.AF_INET, socket.SOCK_STREAM
    else:
        hub = state.runtime().hub
        assert hub is not None
        door, family, kind = hub.address.path, socket.AF_UNIX, socket.SOCK_SEQPACKET
    strangers = [socket.socket(family, kind) for _ in range(3)]
    for stranger in strangers:
        stranger.connect(door)
        stranger.send(pickle.dumps("let me in"))
    child = fiber.Process(target=targets.exit_by, args=("os._exit",))
    child.start()
    child.join(PATIENCE)
    assert child.exitcode == 9
    for stranger in strangers:
        stranger.settimeout(0.2)
        try:
            heard = stranger.recv(1 << 16)
        except OSError:
            heard = b""
        assert bytes(fiber.current_process().authkey) not in heard
        stranger.close()


def test_callbacks_are_ignored(pool: Pool) -> None:
    heard: list[Any] = []
    pool.apply_async(abs, (-1,), callback=heard.append).get(PATIENCE)
    pool.map_async(abs, [-2, -3], callback=heard.append).get(PATIENCE)
    failed = pool.apply_async(tasks.fail, (4,), error_callback=heard.append)
    failed.wait(PATIENCE)
    wait_for(lambda: len(heard) == 3)
    assert heard[:2] == [1, [2, 3]]
    assert isinstance(heard[2], LookupError)


def test_results_have_no_timeout(pool: Pool, tmp_path: Path) -> None:
    result = pool.apply_async(tasks.report_pid_and_block, (str(tmp_path),))
    with pytest.raises(fiber.TimeoutError):
        result.get(0.05)
    result.wait(0.05)
    assert not result.ready()
    iterator = pool.imap(tasks.report_pid_and_block, [str(tmp_path)])
    with pytest.raises(fiber.TimeoutError):
        iterator.next(0.05)
