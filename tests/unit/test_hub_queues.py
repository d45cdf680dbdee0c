"""Queues of another host: small items travel in bundles, in order, and bounded.

Host ``a`` has the queue; this process is on host ``b``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

import fiber
from census import wait_until
from fiber._wire import bundle
from hosts import Far, Hosts, Wire
from patience import PATIENCE

ITEMS = 5000


@contextmanager
def queue_and_remote(far: Far) -> Iterator[tuple[Any, Any]]:
    """Yield a queue of host a, and the same queue as a process of host b has it."""
    queue: Any = fiber.Queue()
    remote = far(queue)
    try:
        yield queue, remote
    finally:
        for each in (remote, queue):
            each.close()
            each.join_thread()


def test_small_items_share_requests(far: Far, wires: tuple[Wire, Wire]) -> None:
    with queue_and_remote(far) as (queue, remote):
        up, _ = wires
        remote.put("first")
        assert queue.get(timeout=PATIENCE) == "first"
        up.hold()
        for number in range(ITEMS):
            remote.put(number)
        before = up.frames
        up.let_go()
        assert [queue.get(timeout=PATIENCE) for _ in range(ITEMS)] == list(range(ITEMS))
        assert up.frames - before < ITEMS / 100
        assert wait_until(lambda: queue.qsize() == 0, PATIENCE)


def test_small_and_large_items_keep_their_order(far: Far) -> None:
    with queue_and_remote(far) as (queue, remote):
        large = np.arange(1 << 15)
        for number in range(30):
            remote.put(number)
            if number % 7 == 0:
                remote.put(large)
                remote.put(bytes(bundle.LIMIT + 1))
        for number in range(30):
            assert queue.get(timeout=PATIENCE) == number
            if number % 7 == 0:
                assert (queue.get(timeout=PATIENCE) == large).all()
                assert len(queue.get(timeout=PATIENCE)) == bundle.LIMIT + 1


def test_a_slow_reader_bounds_what_travels(
    hosts: Hosts, far: Far, wires: tuple[Wire, Wire]
) -> None:
    with queue_and_remote(far) as (queue, remote):
        payload = bytes(1000)
        for _ in range(ITEMS):
            remote.put(payload)
        up, _ = wires
        frames = 0

        def nothing_travels() -> bool:
            nonlocal frames
            before, frames = frames, up.frames
            waits = any(handler.waiting for handler in list(hosts["a"]._handlers))
            return waits and frames == before

        assert wait_until(nothing_travels, PATIENCE)
        assert 0 < remote.qsize() - len(remote._feeder._unsent) == queue.qsize() < 1000
        assert up.frames - frames < 10
        assert [queue.get(timeout=PATIENCE) for _ in range(ITEMS)] == [payload] * ITEMS


def test_items_of_a_lost_host_that_were_not_sent_do_not_count(hosts: Hosts, far: Far) -> None:
    with queue_and_remote(far) as (queue, remote):
        for number in range(ITEMS):
            remote.put(number)
        waiting = lambda: any(handler.waiting for handler in list(hosts["a"]._handlers))  # noqa: E731
        assert wait_until(waiting, PATIENCE)
        hosts.on_loop(hosts["a"].unlink, "b", "its agent is lost")
        assert wait_until(lambda: not hosts["a"]._handlers, PATIENCE)
        size = queue.qsize()
        assert 0 < size < ITEMS
        assert [queue.get(timeout=PATIENCE) for _ in range(size)] == list(range(size))
        assert queue.empty()
        assert queue.qsize() == 0
        hosts.on_loop(hosts["b"].unlink, "a", "its master is lost")


def test_a_reader_of_another_host_lowers_the_count(far: Far) -> None:
    with queue_and_remote(far) as (queue, remote):
        for number in range(3):
            queue.put(number)
        for number in range(3):
            assert remote.get(timeout=PATIENCE) == number
            assert remote.qsize() == queue.qsize() == 2 - number
        with pytest.raises(fiber.queues.Empty):
            remote.get_nowait()


@pytest.mark.parametrize("data", [b"", b"\x01\x00", struct.pack("<I", 5) + b"abc"])
def test_what_is_no_bundle_is_refused(data: bytes) -> None:
    with pytest.raises((ValueError, struct.error)):
        bundle.unpack(memoryview(data))
