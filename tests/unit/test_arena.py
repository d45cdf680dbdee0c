"""The arena: memory is used again only when its reader is done with it."""

from __future__ import annotations

import errno
import mmap
import os
import subprocess
import sys
import threading
import weakref
from collections.abc import Iterator

import pytest

from census import wait_until
from fiber._wire import memory_files
from fiber._wire.descriptor import own
from fiber._wire.memory_files import (
    BORROWED_BLOCKS,
    DATA_OFFSET,
    RETAINED_BLOCKS,
    RETAINED_LIMIT,
    Arena,
    MessageBlock,
    fill,
    in_place,
    mapping,
    release,
)
from patience import PATIENCE


@pytest.fixture
def blocks() -> Iterator[Arena]:
    made = Arena()
    yield made
    made._forget()


def read_in_place(fd: int, size: int) -> memoryview | None:
    return in_place(own(os.dup(fd)), size)


def test_a_block_is_used_again_once_its_reader_released_it(blocks: Arena) -> None:
    block = blocks.claim(1000)
    blocks.settle(block, sent=True)
    other = blocks.claim(1000)
    assert other is not block, "its reader still needs what is in it"
    blocks.settle(other, sent=True)
    release(block.fd)
    assert blocks.claim(1000) is block
    blocks.settle(block, sent=False)


def test_a_block_read_in_place_returns_to_its_sender_after_its_last_view(blocks: Arena) -> None:
    block = blocks.claim(1000)
    fill(block, [memoryview(b"content")], [DATA_OFFSET])
    blocks.settle(block, sent=True)
    memory = read_in_place(block.fd, 1000)
    assert memory is not None
    part = memory[DATA_OFFSET : DATA_OFFSET + 7]
    del memory
    if (child := os.fork()) == 0:
        del part
        os._exit(0)
    os.waitpid(child, 0)
    assert bytes(part) == b"content"
    other = blocks.claim(1000)
    assert other is not block, "its reader still looks at it"
    blocks.settle(other, sent=True)
    del part
    assert blocks.claim(1000) is block
    blocks.settle(block, sent=False)


def test_only_so_many_blocks_are_read_in_place(blocks: Arena) -> None:
    block = blocks.claim(1000)
    read = [read_in_place(block.fd, 1000) for _ in range(BORROWED_BLOCKS)]
    assert all(memory is not None for memory in read)
    assert read_in_place(block.fd, 1000) is None
    read.pop()
    with pytest.raises(ValueError, match="greater than file size"):
        read_in_place(block.fd, 1 << 20)
    read.append(read_in_place(block.fd, 1000))
    assert read[-1] is not None
    read.clear()
    blocks.settle(block, sent=False)


def test_where_no_descriptor_is_left_a_block_is_copied(
    blocks: Arena, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_fd: int, _size: int) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    block = blocks.claim(1000)
    with monkeypatch.context() as full:
        full.setattr(memory_files, "_BorrowedBlock", refuse)
        for _ in range(BORROWED_BLOCKS + 1):
            assert read_in_place(block.fd, 1000) is None
    assert read_in_place(block.fd, 1000) is not None, "none of those counts as read"
    blocks.settle(block, sent=False)


def test_only_blocks_that_cannot_be_truncated_are_read_in_place(blocks: Arena) -> None:
    block = blocks.claim(1000)
    with pytest.raises(PermissionError):
        os.ftruncate(block.fd, 0)
    blocks.settle(block, sent=False)
    fd = os.memfd_create("a sender's own")
    os.ftruncate(fd, 1000)
    assert read_in_place(fd, 1000) is None
    os.close(fd)
    with open(os.path.abspath(__file__), "rb") as file:
        assert read_in_place(file.fileno(), 1000) is None


def test_a_message_that_did_not_go_out_frees_its_block(blocks: Arena) -> None:
    block = blocks.claim(1000)
    blocks.settle(block, sent=False)
    assert blocks.claim(1000) is block
    blocks.settle(block, sent=False)


def test_a_block_that_is_far_too_large_is_not_spent_on_little(blocks: Arena) -> None:
    large = blocks.claim(10 << 20)
    blocks.settle(large, sent=False)
    little = blocks.claim(1000)
    assert little.capacity < large.capacity
    blocks.settle(little, sent=False)
    assert blocks.claim(9 << 20) is large
    blocks.settle(large, sent=False)


def test_blocks_of_readers_that_died_are_forgotten_in_their_turn(blocks: Arena) -> None:
    size = RETAINED_LIMIT // 8
    for _ in range(100):
        blocks.settle(blocks.claim(size), sent=True)  # these are never released
    assert sum(block.capacity for block in blocks._blocks) <= RETAINED_LIMIT


def test_many_unread_small_messages_do_not_exhaust_the_descriptors(blocks: Arena) -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(300):
        blocks.settle(blocks.claim(70_000), sent=True)
    assert len(os.listdir("/proc/self/fd")) <= before + 2 * RETAINED_BLOCKS


def test_memory_beyond_the_limit_is_not_kept(blocks: Arena) -> None:
    block = blocks.claim(RETAINED_LIMIT + 1)
    fd = block.fd
    blocks.settle(block, sent=True)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(fd)


def test_no_two_senders_get_one_block(blocks: Arena) -> None:
    inside: set[int] = set()
    shared: list[int] = []

    def send() -> None:
        for _ in range(200):
            block = blocks.claim(100)
            if block.fd in inside:
                shared.append(block.fd)
            inside.add(block.fd)
            inside.discard(block.fd)
            blocks.settle(block, sent=False)

    threads = [threading.Thread(target=send) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert shared == []


def test_a_forked_child_starts_with_no_blocks(blocks: Arena) -> None:
    block = blocks.claim(1000)
    blocks.settle(block, sent=False)
    pid = os.fork()
    if pid == 0:
        os._exit(0 if blocks.claim(1000) is not block and not blocks._blocks else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert blocks.claim(1000) is block, "the parent's are untouched"
    blocks.settle(block, sent=False)


def test_the_parts_lie_where_they_were_put(blocks: Arena) -> None:
    block = blocks.claim(1000)
    fill(block, [memoryview(b"one"), memoryview(b"two")], [DATA_OFFSET, DATA_OFFSET + 100])
    assert os.pread(block.fd, 3, DATA_OFFSET) == b"one"
    assert os.pread(block.fd, 3, DATA_OFFSET + 100) == b"two"
    assert block.flag[0] == memory_files._BUSY
    blocks.settle(block, sent=False)


def test_a_block_without_memory_leaves_no_descriptor(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError("no memory")

    before = os.listdir("/proc/self/fd")
    with monkeypatch.context() as short:
        short.setattr(mmap, "mmap", refuse)
        with pytest.raises(OSError, match="no memory"):
            MessageBlock(1 << 16)
    assert os.listdir("/proc/self/fd") == before


def test_much_memory_is_given_back_by_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_files, "SLOWLY", 1 << 16)
    owner = own(os.memfd_create("message"))
    os.ftruncate(owner.fileno(), 1 << 16)
    part = memoryview(mapping(owner, 1 << 16))[10:20]
    part[:] = b"0123456789"
    if (child := os.fork()) == 0:
        del part
        os._exit(0 if threading.active_count() == 1 else 1)
    assert os.waitpid(child, 0)[1] == 0, "it belongs to the process that made it"
    assert bytes(part) == b"0123456789"
    del part
    assert wait_until(lambda: owner.closed, PATIENCE)


def test_where_no_thread_can_be_started_memory_is_given_back_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(_thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(memory_files, "SLOWLY", 1 << 16)
    monkeypatch.setattr(threading.Thread, "start", refuse)
    owner = own(os.memfd_create("message"))
    os.ftruncate(owner.fileno(), 1 << 16)
    kept = weakref.ref(mapping(owner, 1 << 16))
    assert kept() is None


KEPT_TO_THE_END = """
import os
from fiber._wire import memory_files
from fiber._wire.descriptor import own

memory_files.SLOWLY = 1 << 16
owner = own(os.memfd_create("message"))
os.ftruncate(owner.fileno(), 1 << 16)
kept = memory_files.mapping(owner, 1 << 16)
"""


def test_a_program_that_keeps_a_large_message_to_its_end_ends() -> None:
    ended = subprocess.run(
        [sys.executable, "-c", KEPT_TO_THE_END], capture_output=True, timeout=PATIENCE, check=True
    )
    assert ended.stderr == b""
