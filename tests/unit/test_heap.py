"""Shared memory: what is shared, what is used again, and what is left."""

from __future__ import annotations

import gc
import os
import pickle
from queue import Queue
from typing import Any

import pytest

from fiber._hub import handles, heap
from fiber._hub.handles import BlockHandle
from fiber._hub.heap import ALIGNMENT, LARGE, SEGMENT, Block, allocate
from fiber._hub.protocol import ObjectKind
from hosts import Hosts
from patience import PATIENCE
from unit.interrupting import is_interrupted


class SharedBytes:
    """The simplest thing in shared memory."""

    def __init__(self, block: Block) -> None:
        self.block = block

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (handles.handle_for_block(ObjectKind.MEMORY, self.block),)


def _rebuild(handle: BlockHandle) -> Any:
    return handle.remote_handle() or SharedBytes(handle.block())


@pytest.mark.parametrize("size", [0, 1, 63, 64, 65, LARGE - 1, LARGE, SEGMENT + 1])
def test_a_block_is_zero_aligned_and_its_own(size: int) -> None:
    one, other = allocate(size), allocate(size)
    assert one.view == other.view == bytes(size)
    assert one.address % ALIGNMENT == 0
    one.view[:] = b"1" * size
    assert other.view == bytes(size)
    assert one.identity != other.identity


def test_small_blocks_share_segments() -> None:
    blocks = [allocate(64) for _ in range(100)]
    assert len({block.segment for block in blocks}) <= 2


def test_a_full_segment_is_followed_by_another() -> None:
    blocks = [allocate(LARGE // 2) for _ in range(2 * SEGMENT // (LARGE // 2))]
    assert len({block.identity for block in blocks}) == len(blocks)


def test_a_forgotten_block_is_used_again_and_is_zero() -> None:
    block = allocate(1000)
    block.view[:] = b"1" * 1000
    identity = block.identity
    del block
    again = allocate(1000)
    assert again.identity == identity
    assert again.view == bytes(1000)


def test_a_block_that_was_pickled_is_not_reused() -> None:
    hosts = Hosts()
    try:
        with hosts.at("one"):
            shared = SharedBytes(allocate(1000))
            identity = shared.block.identity
            data = pickle.dumps(shared)
            del shared
            assert allocate(1000).identity != identity
            assert pickle.loads(data).block.identity == identity
    finally:
        hosts.close()


def test_a_block_from_before_a_fork_is_not_reused() -> None:
    block = allocate(1000)
    identity = block.identity
    pid = os.fork()
    if not pid:
        mine = allocate(1000)
        os._exit(mine.segment.inode == block.segment.inode)
    assert os.waitpid(pid, 0)[1] == 0, "parent and child would both use what is left of a segment"
    del block
    assert allocate(1000).identity != identity


def test_a_finalizer_may_allocate_within_allocate(monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = [allocate(3000)]
    new_segment = heap._new_segment

    def interrupted(name: str, size: int) -> heap.Segment:
        monkeypatch.setattr(heap, "_new_segment", new_segment)
        blocks.append(allocate(3000))
        return new_segment(name, size)

    monkeypatch.setattr(heap, "_new_segment", interrupted)
    blocks += [allocate(3000) for _ in range(SEGMENT // 4096)]
    assert len({block.identity for block in blocks}) == len(blocks)


def test_ctrl_c_at_any_step_leaves_no_descriptor() -> None:
    gc.collect()
    before = len(os.listdir("/proc/self/fd"))
    steps = 0
    while is_interrupted(lambda: allocate(LARGE), steps, {heap.__file__}):
        steps += 1
    assert steps > 10, "it was hardly interrupted"
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_hub_hands_the_memory_to_processes_of_its_host_and_not_to_others() -> None:
    hosts = Hosts()
    try:
        hosts.link("there", "here")
        with hosts.at("here"):
            shared = SharedBytes(allocate(8))
            same, other = pickle.dumps(shared), pickle.dumps(shared)
            assert pickle.loads(same).block.segment is shared.block.segment
        with hosts.at("there"):
            assert pickle.loads(other).home.host == "here"
    finally:
        hosts.close()


def test_the_hub_gets_the_doorbell() -> None:
    hosts = Hosts()
    heard: Queue[None] = Queue()
    try:
        with hosts.at("here") as hub:
            hosts.on_loop(hub.doorbell.listen, lambda: heard.put(None))
            handles.ring_doorbell()
            heard.get(timeout=PATIENCE)
        with hosts.child_at("here"):
            handles.ring_doorbell()
            heard.get(timeout=PATIENCE)
    finally:
        hosts.close()
