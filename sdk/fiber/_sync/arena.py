"""A piece of shared memory for locks: a table of those who are at them, and the records.

::

    mutex │ slot │ slot │ …  │ record │ record │ …

A *slot* belongs to a process that is at some record just now: it says which process that is, and at
which record.  A process has as many as threads of it ever were at one at the same time.
"""

from __future__ import annotations

import ctypes
import itertools
import os
import time
import weakref
from collections.abc import Callable, Iterator
from multiprocessing import current_process
from typing import Protocol, TypeVar

from _multiprocessing import SemLock

from fiber._sync import identity
from fiber._sync.robust_mutex import RobustMutex

SIZE = 1 << 20
"""Bytes of an arena.  The kernel gives memory for those that are used."""

SLOTS = 1024
RECORDS = (SLOTS + 1) * 128
"""Where the records begin, in bytes."""

# The words of a slot, from the one by which it is known.
AT = 0
"""The record that its thread is at, or 0."""
WHO = 1
"""The process, or 0: the slot is free."""
STATE = 2
NEXT = 3
"""Those two are for who waits at a condition."""
BELL = 32
"""Bytes from there to a semaphore on which its thread can sleep."""
_NAME = 64
_SLOT = 128
_TABLE = range(_SLOT // 8, RECORDS // 8, _SLOT // 8)

_libc = ctypes.PyDLL(None, use_errno=True)

_Result = TypeVar("_Result")


class Block(Protocol):
    """Memory that processes of this host share."""

    @property
    def view(self) -> memoryview:
        """All of it, to be written to."""

    @property
    def address(self) -> int:
        """Where it is in this process."""


class Arena:
    """One block, as this process sees it.

    Words of 8 bytes are read and written in one piece.  No method waits for another thread of this
    process but for the mutex, so a finalizer or signal handler may come anywhere.
    """

    def __init__(self, block: Block, *, new: bool = False) -> None:
        self.block = block
        self.bytes = block.view
        self.words = block.view.cast("Q")
        self.me = identity.own()
        self.free: list[int] = []
        """Slots of this process that no thread of it uses now."""
        self._mutex = RobustMutex(block.address)
        # One for all threads: whoever interrupts a search gets other slots than that.
        self._candidates = itertools.cycle(_TABLE)
        _arenas.add(self)
        if new:
            self._mutex.create()

    def exclusively(self, action: Callable[[], _Result]) -> _Result:
        """Call it while no other process does such a thing with this arena."""
        return self._mutex.run(action)

    def semaphore(self, offset: int, kind: int, maximum: int) -> SemLock:
        """The semaphore at ``offset``."""
        # Without a name it takes the handle, an address here, as it is.  What it does at its end,
        # ``sem_close``, is refused for an address that ``sem_open`` never gave.
        return SemLock._rebuild(self.block.address + offset, kind, maximum, None)

    def make_semaphore(self, offset: int, value: int) -> None:
        """Begin its life."""
        if _libc.sem_init(ctypes.c_void_p(self.block.address + offset), 1, value):
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code))

    def is_alive(self, who: int) -> bool:
        """Whether that process still runs."""
        return who == self.me or identity.is_alive(who)

    def sleep(self, seconds: float) -> None:
        """Wait for others to get on."""
        time.sleep(seconds)

    # Slots

    def claim(self) -> int:
        """One more slot for this process."""
        return self.exclusively(self._claim)

    def slots(self) -> Iterator[int]:
        """All slots that belong to somebody."""
        owners = self.words[_SLOT // 8 + WHO : RECORDS // 8 : _SLOT // 8].tolist()
        return (slot for slot, who in zip(_TABLE, owners, strict=True) if who)

    def name(self, who: int) -> str:
        """How to call a process in a message."""
        for slot in self.slots():
            if self.words[slot + WHO] == who:
                start = slot * 8 + _NAME
                name = bytes(self.bytes[start : start + _SLOT - _NAME]).rstrip(b"\0")
                return f"process {name.decode(errors='replace')!r} (pid {identity.pid(who)})"
        return f"a process (pid {identity.pid(who)})" if who else "a process"

    def _claim(self) -> int:
        for is_free in (self._is_unused, self._is_left):
            for slot in itertools.islice(self._candidates, SLOTS):
                if is_free(slot):
                    self._settle(slot)
                    return slot
        raise OSError(
            f"more than {SLOTS} threads of this host use locks that were made together: make some "
            "of the locks in another process"
        )

    def _is_unused(self, slot: int) -> bool:
        return not self.words[slot + WHO]

    def _is_left(self, slot: int) -> bool:
        words = self.words
        return not words[slot] and not words[slot + STATE] and not self.is_alive(words[slot + WHO])

    def _settle(self, slot: int) -> None:
        words, start = self.words, slot * 8
        words[slot + STATE] = words[slot + NEXT] = words[slot] = 0
        self.make_semaphore(start + BELL, 0)
        name = current_process().name.encode()[: _SLOT - _NAME]
        self.bytes[start + _NAME : start + _SLOT] = name.ljust(_SLOT - _NAME, b"\0")
        words[slot + WHO] = self.me  # last: from here on it is ours


_arenas: weakref.WeakSet[Arena] = weakref.WeakSet()


def _after_fork() -> None:
    """In a process that somebody else forked: the slots are our parent's."""
    for arena in _arenas:
        arena.free.clear()
        arena.me = identity.own()


os.register_at_fork(after_in_child=_after_fork)
