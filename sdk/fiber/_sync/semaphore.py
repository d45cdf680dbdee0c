"""Semaphores in shared memory: the tokens of a process that dies come back.

A token is one unit of a POSIX semaphore.  To take or to return it is one step in C, for which the
kernel can wait.  The POSIX semaphore does not record which process holds a token.  So the memory
also has *slots*.  A process has a slot for each token that it holds or is about to take::

    semaphore │ mutex │ attention, … │ slot │ slot │ …          slot: state, process, its name

``attention`` has three flags: stop, abandoned, and listens.  A thread that finds ``stop`` set puts
its slot's state back, and waits until the revival is over.  Only the thread that has removed a slot
from its process's lists writes the slot's state::

    acquire                               release
      state = BUSY                          state = BUSY
      stop set?  then step back             stop set?  then step back
      take a token                          return the token
      state = HELD                          state = IDLE

A *revival* returns the tokens that no living process has noted.  One process at a time does it,
under a robust mutex:

1. It sets ``stop``, and waits for longer than any processor delays a store.  From then on each
   process that reads ``stop`` sees it set.  A process that read it before has marked its slot as
   BUSY, and the revival sees that mark.
2. It waits until no living process is busy.  Then all living processes have noted their tokens, and
   none takes or returns a token.  (A process that is stopped in the middle postpones the revival,
   as it may hold the token.)
3. Tokens that are neither available nor noted by a living process are lost.  The revival returns
   them.
4. It frees the slots of dead processes and clears ``stop``.

So no token exists twice.  Only lost tokens are made again, and a lost token stays lost: its holder
is dead, and all living processes have noted their tokens.  If the process dies during a revival, it
leaves ``stop`` and the mutex to the next one, which finds the same tokens lost, or fewer.

A thread that is interrupted between two steps cannot know how far it got.  It leaves the slot as if
its process had died: state = LEFT.  So others get a token that an interrupted ``acquire`` took.  A
semaphore whose tokens are not revived may lose that token, as multiprocessing's may.

A process that returns a token that it has not acquired returns the token of another process, or
adds one.  From then on the holders are unknown, and tokens are not revived.

No Python lock is taken: a finalizer, a signal's handler or a thread may run between any two steps.
"""

from __future__ import annotations

import ctypes
import os
import time
import warnings
import weakref
from _multiprocessing import SemLock  # type: ignore[import-not-found]  # it has no stub
from collections.abc import Callable, Iterable, Iterator
from itertools import compress
from multiprocessing import current_process
from typing import TYPE_CHECKING, Any, Protocol, Self, cast

from fiber._sync import liveness
from fiber._sync.liveness import RobustMutex
from fiber._unconfirmed import flush_all, unconfirmed

RECURSIVE, COUNTING = 0, 1  # SemLock's kinds, in its own numbers
SEM_VALUE_MAX: int = SemLock.SEM_VALUE_MAX

SEMAPHORE_SIZE = 1 << 15
"""Bytes of a semaphore.  The kernel provides memory only for pages that are used."""

SLICE = 0.2
"""Seconds that one wait in the kernel lasts.

It bounds the delay of a signal handler.  After each wait the waiter may look for lost tokens.
"""

_MOMENT = 0.002  # seconds until all processors see a store
_QUIET = 1.0  # seconds that a revival waits for busy processes before it is postponed
_NAP = 0.001

# Words of 8 bytes, each read and written in one step.  The first four are the POSIX semaphore.
_MUTEX = 8
_ATTENTION = 16
_IS_UNTRACKED = 17
_TOTAL = 18
_MAXIMUM = 19
_DEAD = range(20, 30)  # name of the process whose token was returned last
_IS_SILENT = 30  # whether nobody is told of lost tokens
_SLOTS = range(32, SEMAPHORE_SIZE // 8, 8)
_NO_SLOT = 31
"""Number in place of a slot when no slot is left."""

# Words of a slot, after its state
_WHO = 1  # identity of the process; 0 if the slot is free
_NAME = 2
_NAME_BYTES = 48
_IDLE, _BUSY, _HELD, _LEFT = range(4)  # states

# Bytes of the word ``attention``, which is read as a whole.
_STOP = 8 * _ATTENTION
_ABANDONED = 8 * _ATTENTION + 1
_LISTENS = 8 * _ATTENTION + 2
_IS_STOPPED = 0xFF
_IS_LISTENED_TO = 0xFF0000

_libc = ctypes.PyDLL(None, use_errno=True)


if TYPE_CHECKING:
    # No class can inherit from bool, and for most callers `acquire` returns a bool.
    _Bool = bool
else:
    _Bool = int


class Abandoned(_Bool):  # type: ignore[misc]  # bool is final
    """Result of an ``acquire`` that got a lock which another process held when it ended.

    It is true and equal to True, so most callers can ignore it.  The data that the lock guards may
    be half changed.  A caller that has to know checks
    ``isinstance(lock.acquire(), Abandoned)``.
    """

    holder: str
    """Name of the process that ended."""

    def __new__(cls, holder: str) -> Self:
        self: Any = super().__new__(cls, 1)
        self.holder = holder
        return cast(Self, self)

    def __repr__(self) -> str:
        return f"Abandoned(holder={self.holder!r})"

    def __reduce__(self) -> tuple[type[Self], tuple[str]]:
        return type(self), (self.holder,)


class SharedBlock(Protocol):
    """Block of memory that processes of this host share.

    ``fiber._hub.heap.Block`` implements it, in a layer above this one.
    """

    @property
    def view(self) -> memoryview:
        """Writable view of the whole block."""

    @property
    def address(self) -> int:
        """Address of the block in this process."""


class SharedSemaphore:
    """Semaphore in shared memory, with the methods of multiprocessing's ``SemLock``."""

    __slots__ = (
        "__weakref__", "_bytes", "_candidates", "_count", "_get_value", "_give", "_held", "_idle",
        "_is_mine", "_is_recursive", "_is_zero", "_me", "_mutex", "_next_look",
        "_revivals", "_ring", "_sem", "_take", "_words", "block", "kind", "maximum",
    )  # fmt: skip

    def __init__(
        self, block: SharedBlock, kind: int, ring: Callable[[], None] = lambda: None
    ) -> None:
        self.block = block
        self.kind = kind
        self._ring = ring
        self._bytes = block.view
        self._words = block.view.cast("q")
        self.maximum = self._words[_MAXIMUM]
        self._is_recursive = kind == RECURSIVE
        self._mutex = RobustMutex(block.address + 8 * _MUTEX)
        self._sem = self._semlock(kind)
        self._take = self._sem.acquire
        self._give = self._sem.release
        self._is_mine = self._sem._is_mine
        self._count = self._sem._count
        self._get_value: Callable[[], int] = self._sem._get_value
        self._is_zero = self._sem._is_zero
        self._revivals = 0
        self._next_look = 0.0
        self._begin()
        _all.add(self)

    @classmethod
    def create(
        cls,
        block: SharedBlock,
        kind: int,
        value: int,
        maximum: int,
        ring: Callable[[], None],
        *,
        silent: bool = False,
    ) -> SharedSemaphore:
        """Make a semaphore in zeroed memory.

        ``ring`` is called when a token is returned while the hub listens.  With ``silent`` nobody
        is told when a process ends with a token: what the token guards is never half changed.
        """
        make_semaphore(block.address, value)
        words = block.view.cast("q")
        words[_TOTAL], words[_MAXIMUM], words[_IS_SILENT] = value, maximum, silent
        new = cls(block, kind, ring)
        new._mutex.create()
        return new

    def _begin(self) -> None:
        """Begin without tokens, in a new process or in a fork."""
        self._me = liveness.own_identity()
        self._idle: list[int] = []
        self._held: list[int] = []
        self._candidates: Iterator[int] = iter(_SLOTS)

    def _after_fork(self) -> None:
        self._sem._after_fork()
        self._begin()

    def acquire(self, block: bool = True, timeout: float | None = None) -> bool | Abandoned:
        """Take a token; False if there is none within ``timeout`` seconds."""
        if self._is_recursive and self._is_mine():
            return self._acquire_again()
        return self._try_acquire() or self._wait(block, timeout)

    def release(self, *, wait: bool = True) -> bool:
        """Return a token; ValueError if the semaphore is at its maximum.

        AssertionError if it is recursive and this thread has not acquired it.  Without ``wait``,
        the result is False during a revival, and the token is not returned.
        """
        if not unconfirmed:
            return self._release(wait)
        try:
            flush_all()
        finally:  # also after an interrupt: the caller does not hold the token any longer
            is_returned = self._release(wait)
        return is_returned

    def _release(self, wait: bool) -> bool:
        if self._is_recursive and (not self._is_mine() or self._count() > 1):
            self._give()
            return True
        words = self._words
        try:
            slot = self._held.pop()
        except IndexError:
            slot = 0
        if not slot:
            if wait:
                return self._mutex.run(self._give_untracked)
            return self._mutex.try_run(self._give_untracked) or False
        try:
            words[slot] = _BUSY
            while words[_ATTENTION] & _IS_STOPPED:
                words[slot] = _HELD
                if not wait:
                    self._held += (slot,)
                    return False
                self._park()
                words[slot] = _BUSY
            self._give()
            words[slot] = _IDLE
            self._idle += (slot,)
        except BaseException:
            self._leave(slot)
            raise
        if words[_ATTENTION] & _IS_LISTENED_TO:
            self._ring()
        return True

    def is_untracked(self) -> bool:
        """Tell whether the holders are unknown, so that tokens of dead processes stay lost."""
        return bool(self._words[_IS_UNTRACKED])

    def is_silent(self) -> bool:
        """Tell whether nobody is told when a process ends with a token."""
        return bool(self._words[_IS_SILENT])

    def listen(self, listens: bool) -> None:
        """Set whether a release rings the hub's doorbell."""
        self._bytes[_LISTENS] = listens

    def try_acquire(self) -> bool | Abandoned:
        """Take a token if there is one.  Look for no lost tokens, and do not wait for a revival.

        It waits for one only if more tokens are in use than there are slots.
        """
        if not self._idle:
            slot = self._mutex.try_run(self._claim)
            if slot is None:
                return False
            self._idle += (slot,)
        return self._try_acquire()

    def disown(self) -> None:
        """Leave a token of this process taken, as if the process had ended."""
        self._words[self._held.pop()] = _LEFT

    def note_death(self, holder: str) -> None:
        """Note for the next acquirer that the process ``holder`` ended with a token."""
        start, size = 8 * _DEAD.start, 8 * len(_DEAD)
        self._bytes[start : start + size] = holder.encode()[:size].ljust(size, b"\0")
        self._bytes[_ABANDONED] = 1

    # Steps

    def _acquire_again(self) -> bool:
        depth = self._count()
        try:
            self._take(False)
            return True
        except BaseException:
            if self._count() > depth:
                self._give()
            raise

    def _try_acquire(self, block: bool = False, timeout: float | None = None) -> bool | Abandoned:
        """Try once.  The result is ``Abandoned`` for the first acquirer after a holder's death."""
        try:
            slot = self._idle.pop()
        except IndexError:
            slot = self._mutex.run(self._claim)
        words = self._words
        try:
            words[slot] = _BUSY
            taken = not words[_ATTENTION] & _IS_STOPPED and self._take(block, timeout)
            if taken and self._bytes[_ABANDONED]:
                taken = self._last_holder()
        except BaseException:
            self._leave(slot)
            raise
        # CPython runs signal handlers after a call.  No call follows, here and in the callers.
        words[slot] = _HELD if taken else _IDLE
        if taken and slot != _NO_SLOT:  # a token without a slot has no note
            self._held += (slot,)
        else:
            self._idle += (slot,)
        return taken

    def _give_untracked(self) -> bool:
        """Return a token that this process has not acquired.  The caller holds the mutex."""
        self._give()
        self._words[_IS_UNTRACKED] = True
        if self._words[_ATTENTION] & _IS_LISTENED_TO:
            self._ring()
        return True

    def _leave(self, slot: int) -> None:
        """Mark a slot as LEFT after an interrupt.  A revival finds out if its token is lost."""
        if self._is_recursive and self._is_mine():
            self._sem._after_fork()  # sets the count to zero: this thread no longer holds it
        self._words[slot] = _LEFT

    def _last_holder(self) -> Abandoned:
        self._bytes[_ABANDONED] = 0
        return Abandoned(_text(self._bytes[8 * _DEAD.start : 8 * _DEAD.stop]))

    # Waiting

    def _wait(self, block: bool, timeout: float | None) -> bool | Abandoned:
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            left = SLICE if deadline is None else min(SLICE, deadline - time.monotonic())
            waits = block and left > 0
            if self._is_stopped():
                self._park()
            elif not self._look_after_the_dead() and not waits:
                return False
            taken = self._try_acquire(True, left) if waits else self._try_acquire()
            if taken or not waits:
                return taken

    def _is_stopped(self) -> bool:
        return bool(self._words[_ATTENTION] & _IS_STOPPED)

    def _park(self) -> None:
        """Wait until a revival is over.  If its process died, finish it."""
        self._warn(self._mutex.run(lambda: self._revive() if self._is_stopped() else []))

    def _look_after_the_dead(self) -> bool:
        """Revive lost tokens, if the last look is long enough ago; return whether that was done."""
        now = time.monotonic()
        if now < self._next_look:
            return False
        self._next_look = now + SLICE
        if not self.is_suspicious():
            return False
        self.revive()
        return True

    # Reviving

    def revive(self) -> None:
        """Return the tokens of dead processes, and warn with their names."""
        self._warn(self._mutex.run(self._revive))

    def is_suspicious(self) -> bool:
        """Tell whether a dead process has a token or may have one."""
        words = self._words
        if words[_IS_UNTRACKED] or self._get_value():
            return False
        states = [(words[slot], slot) for slot in self._used()]
        noted = sum(state == _HELD for state, _ in states)
        # If HELD slots account for all tokens, a BUSY process has none: it waits for one.
        least = _HELD if noted == words[_TOTAL] else _BUSY
        return any(self._is_gone(slot) for state, slot in states if state >= least)

    def _revive(self) -> list[str]:
        """Return the tokens of dead processes; the result is their names.

        The caller holds the mutex.
        """
        self._revivals += 1
        revival = self._revivals
        words = self._words
        released: list[str] = []
        self._bytes[_STOP] = 1
        try:
            time.sleep(_MOMENT)
            gone = self._wait_until_quiet()
            time.sleep(_MOMENT)
            lost = words[_TOTAL] - self._get_value()
            lost -= sum(words[slot] == _HELD for slot in self._used() if slot not in gone)
            if gone and lost > 0 and not words[_IS_UNTRACKED]:
                released = [] if self.is_silent() else self._names(gone)
                if released:
                    self.note_death(released[-1])
                # By another SemLock: the one of this object counts the tokens of this process.
                give = self._semlock(COUNTING).release
                for _ in range(lost):
                    if self._revivals != revival:
                        break  # a signal's handler ran a whole revival in between
                    give()
            for slot, who in gone.items():
                if words[slot + _WHO] == who:
                    words[slot + _WHO] = 0
        finally:
            self._bytes[_STOP] = 0
        return released

    def _wait_until_quiet(self) -> dict[int, int]:
        """Wait until no living process is busy; return the slots of dead processes.

        Return no slots if that takes too long.
        """
        words = self._words
        deadline = time.monotonic() + _QUIET
        while True:
            owners = {slot: words[slot + _WHO] for slot in self._used()}
            gone = {slot: who for slot, who in owners.items() if self._is_gone(slot)}
            if all(words[slot] != _BUSY for slot in owners.keys() - gone.keys()):
                return gone
            if time.monotonic() > deadline:
                return {}
            time.sleep(_NAP)

    def _names(self, gone: Iterable[int]) -> list[str]:
        """Return the dead processes that held a token, or else those that may have held one."""
        states = {slot: self._words[slot] for slot in gone}
        for state in (_HELD, _BUSY):
            if state in states.values():
                return [self._name(slot) for slot in states if states[slot] == state]
        return []

    def _warn(self, released: list[str]) -> None:
        for process in dict.fromkeys(released):
            # The caller of acquire(); for a manager's lock, Fiber's own line.
            warn_of(process, stacklevel=8)

    # Slots

    def _used(self) -> Iterator[int]:
        """Return the slots that are not free."""
        return compress(_SLOTS, self._words[_SLOTS.start + _WHO :: _SLOTS.step].tolist())

    def _is_gone(self, slot: int) -> bool:
        who = self._words[slot + _WHO]
        return self._words[slot] == _LEFT or not (who == self._me or liveness.is_alive(who))

    def _name(self, slot: int) -> str:
        start = 8 * (slot + _NAME)
        name = _text(self._bytes[start : start + _NAME_BYTES])
        return f"{name} (pid {liveness.pid_of(self._words[slot + _WHO])})"

    def _claim(self) -> int:
        """Take a free slot for this process.  The caller holds the mutex."""
        for _ in range(0 if self._words[_IS_UNTRACKED] else 2):
            # One iterator for all threads: a handler that interrupts this search gets other slots.
            for slot in self._candidates:
                if not self._words[slot + _WHO]:
                    return self._settle(slot)
            self._revive()
            self._candidates = iter(_SLOTS)
        # More tokens are taken, or waited for, than there are slots.
        self._words[_IS_UNTRACKED] = True
        return _NO_SLOT

    def _settle(self, slot: int) -> int:
        words, start = self._words, 8 * (slot + _NAME)
        words[slot] = _IDLE
        name = current_process().name.encode()[:_NAME_BYTES]
        self._bytes[start : start + _NAME_BYTES] = name.ljust(_NAME_BYTES, b"\0")
        words[slot + _WHO] = self._me  # last: from here on the slot is taken
        return slot

    def _semlock(self, kind: int) -> SemLock:
        return semaphore_at(self.block.address, kind, self.maximum)


def make_semaphore(address: int, value: int) -> None:
    """Initialize a POSIX semaphore that processes share."""
    if _libc.sem_init(ctypes.c_void_p(address), 1, value):
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))


def semaphore_at(address: int, kind: int = COUNTING, maximum: int = SEM_VALUE_MAX) -> SemLock:
    """Return a SemLock for the POSIX semaphore at an address."""
    # Without a name SemLock uses the handle, here an address, unchanged.  At its end it calls
    # ``sem_close``, which refuses an address that did not come from ``sem_open``.
    return SemLock._rebuild(address, kind, maximum, None)


def warn_of(holder: str, *, stacklevel: int = 2) -> None:
    """Warn that the process ``holder`` ended with a token."""
    warnings.warn(
        f"{holder} ended while it held a lock or semaphore. Fiber has released it. The data that "
        "it guards may be half changed: check that before you rely on it",
        RuntimeWarning,
        stacklevel=stacklevel,
    )


def _text(field: memoryview) -> str:
    return bytes(field).rstrip(b"\0").decode(errors="replace")


_all: weakref.WeakSet[SharedSemaphore] = weakref.WeakSet()


def _after_fork() -> None:
    for semaphore in _all:
        semaphore._after_fork()


os.register_at_fork(after_in_child=_after_fork)
