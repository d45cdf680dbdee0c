"""Arithmetic that keeps copies of shared memory on several hosts in step, without I/O.

Hosts that share a block form a tree, whose root is the block's home.  Each side of a link between
two of them has a *twin* of the block: what both sides agree on.  Before anything else is sent over
the link, what differs from the twin goes ahead of it as a *patch*, and links keep the order; so
whoever hears of a write through a message, however many hosts that passes, finds it in its memory.
That is lazy release consistency (Keleher, Cox and Zwaenepoel, 1992), with links for locks.

A patch names the very bytes that changed: those that hosts change at the same time, where no
message orders them, merge if they are different ones.  Of two that change the same byte the one
wins that the home sees last, and in the end all have that: the side that is farther from the home
holds on to what it has sent until that is acknowledged, and to what it has not sent yet.

A patch is a sequence of extents::

    offset:u64, length:u32, which of these bytes changed:1 bit each, the bytes
"""

from __future__ import annotations

import re
import struct
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

PATCH = 1 << 18
"""Bytes above which a patch is sent in pieces."""

_SPAN = 1 << 16  # what is compared first
_CHUNK = 1 << 12  # within such as differ; an extent is part of one
_HEAD = struct.Struct("<QI")
_CHANGED = bytes([ord("0")]) + bytes([ord("1")]) * 255
_RUN = re.compile(b"1+")

Memory = memoryview | bytearray


class Run(NamedTuple):
    """Bytes in a row that changed."""

    start: int
    data: bytes


class Twin:
    """State of one side of a link for a block that both sides share.  Both begin with zeros.

    ``follows``: whether the other side is nearer to the block's home.
    """

    def __init__(self, memory: memoryview, *, follows: bool) -> None:
        self._memory = memory
        self._agreed = bytearray(len(memory))
        self._follows = follows
        self._unacknowledged: deque[bytes] = deque()

    def collect(self) -> Iterator[bytes]:
        """Yield the patches to send, in order: changes that the other side does not know."""
        patch = b""
        for extent in _differences(self._agreed, self._memory):
            patch += extent
            if len(patch) >= PATCH:
                yield self._sent(patch)
                patch = b""
        if patch:
            yield self._sent(patch)

    def _sent(self, patch: bytes) -> bytes:
        if self._follows:
            self._unacknowledged.append(patch)
        return patch

    def acknowledged(self) -> None:
        """The other side has the first patch of those that it did not have."""
        self._unacknowledged.popleft()

    def merge(self, patch: memoryview) -> None:
        """Apply what the other side sent; ValueError if that is no patch of this block."""
        runs = list(_runs(patch, len(self._memory)))
        if self._follows:
            self._merge_newer(runs)
        else:
            for start, data in runs:
                self._memory[start : start + len(data)] = data
                self._agreed[start : start + len(data)] = data

    def _merge_newer(self, runs: list[Run]) -> None:
        before = [bytes(self._agreed[start : start + len(data)]) for start, data in runs]
        _write(self._agreed, runs)
        for patch in self._unacknowledged:
            _write(self._agreed, _runs(memoryview(patch), len(self._memory)))
        for (start, data), old in zip(runs, before, strict=True):
            end = start + len(data)
            new = bytes(self._agreed[start:end])
            here = bytes(self._memory[start:end])
            if here == old:
                self._memory[start:end] = new
                continue
            for index, (mine, was) in enumerate(zip(here, old, strict=True), start):
                if mine == was:  # otherwise it was changed here, and is yet to be sent
                    self._memory[index] = new[index - start]


def _differences(old: bytearray, memory: memoryview) -> Iterator[bytes]:
    """Bring ``old`` up to date with ``memory``; the extents that changed."""
    for start in range(0, len(old), _SPAN):
        # Others may write meanwhile: each byte is looked at once, and what comes later, later.
        now = bytes(memory[start : start + _SPAN])
        was = bytes(old[start : start + _SPAN])
        if now == was:
            continue
        old[start : start + _SPAN] = now
        for at in range(0, len(now), _CHUNK):
            new, before = now[at : at + _CHUNK], was[at : at + _CHUNK]
            if new != before:
                yield _extent(start + at, before, new)


def _extent(start: int, old: bytes, new: bytes) -> bytes:
    changed = int.from_bytes(old) ^ int.from_bytes(new)
    marks = changed.to_bytes(len(new)).translate(_CHANGED)
    first, end = marks.index(b"1"), marks.rindex(b"1") + 1
    bits = int(marks[first:end], 2).to_bytes(-(-(end - first) // 8))
    return b"".join((_HEAD.pack(start + first, end - first), bits, new[first:end]))


def _runs(patch: memoryview, size: int) -> Iterator[Run]:
    at = 0
    while at < len(patch):
        start, length = _HEAD.unpack_from(patch, at)
        bits = at + _HEAD.size
        data = bits + -(-length // 8)
        at = data + length
        if not 0 < length <= _CHUNK or start + length > size or at > len(patch):
            raise ValueError("malformed patch of shared memory")
        marks = format(int.from_bytes(patch[bits:data]), f"0{length}b").encode()
        if len(marks) != length:
            raise ValueError("malformed patch of shared memory")
        for run in _RUN.finditer(marks):
            first, end = run.span()
            yield Run(start + first, bytes(patch[data + first : data + end]))


def _write(memory: bytearray, runs: list[Run] | Iterator[Run]) -> None:
    for start, data in runs:
        memory[start : start + len(data)] = data
