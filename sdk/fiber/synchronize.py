"""Locks, semaphores and events as in multiprocessing; a dead holder's locks are released.

::

    with lock as acquired:
        if isinstance(acquired, Abandoned):
            repair(what_it_guards)  # a process died in the middle of changing it
"""

from __future__ import annotations

import errno
import math
import operator
import os
import threading
import time
import weakref
from collections.abc import Callable
from multiprocessing import current_process
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, cast

from fiber._hub import shared_blocks
from fiber._hub.local import LocalCounter
from fiber._hub.protocol import RECHECK, BarrierState, Breach
from fiber._hub.shared_blocks import RemoteWaitList
from fiber._sync.semaphore import COUNTING, RECURSIVE, SEM_VALUE_MAX, Abandoned

if TYPE_CHECKING:
    from multiprocessing import synchronize as mp_synchronize
    from types import TracebackType

    from fiber._hub.shared_blocks import AnySemaphore, AnyWaitList
    from fiber._transport.channels import SharedCounter

__all__ = [
    "SEM_VALUE_MAX",
    "Abandoned",
    "Barrier",
    "BoundedSemaphore",
    "Condition",
    "Event",
    "Lock",
    "RLock",
    "Semaphore",
]

_T = TypeVar("_T")


class SemLock:
    """Base of all locks and semaphores: tokens that are acquired and released.

    They pickle at any time: through a queue, or as a task's argument, and not only while a process
    is started.  Tokens of a process that dies are released, with a RuntimeWarning that names the
    process.  The next ``acquire`` then returns an ``Abandoned`` in place of True.
    """

    def __init__(self, kind: int, value: int, maximum: int) -> None:
        self._semlock: AnySemaphore = shared_blocks.create_semaphore(kind, value, maximum)

    def acquire(self, block: bool = True, timeout: float | None = None) -> bool:
        """Take a token; return False if none becomes free within ``timeout`` seconds."""
        if timeout is not None and math.isnan(timeout):
            raise ValueError("timeout must be a number of seconds, not NaN")
        return self._semlock.acquire(block, timeout)

    def release(self) -> None:
        """Give a token back; ValueError if there would be more tokens than the maximum."""
        self._semlock.release()

    def __enter__(self) -> bool:
        return self._semlock.acquire()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._semlock.release()

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuild, (type(self), self._semlock)

    def _owner(self) -> str:
        semlock = self._semlock
        if semlock._is_mine():
            name = current_process().name
            thread = threading.current_thread().name
            return name if thread == "MainThread" else f"{name}|{thread}"
        if semlock._get_value() == 1:
            return "None"
        return "SomeOtherThread" if semlock._count() > 0 else "SomeOtherProcess"


def _rebuild(cls: type[SemLock], semlock: AnySemaphore) -> SemLock:
    new = cls.__new__(cls)
    new._semlock = semlock
    return new


class Semaphore(SemLock):
    """A count that ``acquire`` lowers, waiting while it is zero, and ``release`` raises.

    If a process releases it more often than it acquired it, the semaphore carries signals between
    processes.  From then on no token of a process that dies is released.
    """

    def __init__(self, value: int = 1, *, ctx: Any = None) -> None:
        self._check(value)
        super().__init__(COUNTING, value, SEM_VALUE_MAX)

    def get_value(self) -> int:
        """Return the present count."""
        return self._semlock._get_value()

    @staticmethod
    def _check(value: int) -> None:
        operator.index(value)  # TypeError for what is no integer
        reason = f"a semaphore's value is from 0 to {SEM_VALUE_MAX}, not {value}"
        if value < 0:
            raise OSError(errno.EINVAL, reason)
        if value > SEM_VALUE_MAX:
            raise OverflowError(reason)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}(value={self.get_value()})>"


class BoundedSemaphore(Semaphore):
    """A semaphore whose count never rises above its first value."""

    def __init__(self, value: int = 1, *, ctx: Any = None) -> None:
        self._check(value)
        SemLock.__init__(self, COUNTING, value, value)

    def __repr__(self) -> str:
        maximum = self._semlock.maximum
        return f"<{type(self).__name__}(value={self.get_value()}, maxvalue={maximum})>"


class Lock(SemLock):
    """A mutex that any thread of any process may release."""

    def __init__(self, *, ctx: Any = None) -> None:
        super().__init__(COUNTING, 1, 1)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}(owner={self._owner()})>"


class RLock(SemLock):
    """A mutex that its holder, a thread, may acquire again, and that only its holder may release.

    In any other thread ``release`` raises AssertionError.
    """

    def __init__(self, *, ctx: Any = None) -> None:
        super().__init__(RECURSIVE, 1, 1)

    def __repr__(self) -> str:
        count = self._semlock._count()
        owner = self._owner()
        if owner.startswith("Some"):
            return f"<{type(self).__name__}({owner}, nonzero)>"
        return f"<{type(self).__name__}({owner}, {count})>"


if TYPE_CHECKING:
    LockLike: TypeAlias = SemLock | mp_synchronize.SemLock
    """Type of a lock: Fiber's, or multiprocessing's, which the types of ``Value`` mention."""


class Condition:
    """A lock, and threads of any process that wait until a holder of the lock notifies them.

    ``notify`` passes over a waiter that was killed.  In multiprocessing it waits for the waiter.
    """

    def __init__(self, lock: LockLike | None = None, *, ctx: Any = None) -> None:
        # multiprocessing's locks have the methods that are used here, too.
        self._lock = RLock() if lock is None else cast(SemLock, lock)
        self._waiters: AnyWaitList = shared_blocks.create_wait_list()

    def acquire(self, block: bool = True, timeout: float | None = None) -> bool:
        """Acquire the lock."""
        return self._lock.acquire(block, timeout)

    def release(self) -> None:
        """Release the lock."""
        self._lock.release()

    def __enter__(self) -> bool:
        return self._lock.__enter__()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._lock.__exit__(kind, error, trace)

    def wait(self, timeout: float | None = None) -> bool:
        """Release the lock until notified; return False after ``timeout`` seconds."""
        self._check("wait")
        waiters: Any = self._waiters  # the type of a place is private to the wait list
        depth = self._lock._semlock._count()
        place = waiters.enter()
        for _ in range(depth):
            self._lock.release()
        try:
            waiters.sleep(place, timeout)
        finally:
            try:
                for _ in range(depth):
                    self._lock.acquire()
            finally:
                notified = waiters.leave(place)
        return bool(notified)

    def wait_for(self, predicate: Callable[[], _T], timeout: float | None = None) -> _T:
        """Wait until ``predicate`` is true; return its last value after ``timeout`` seconds."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while not (result := predicate()):
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0:
                break
            self.wait(left)
        return result

    def notify(self, n: int = 1) -> None:
        """Wake ``n`` waiters, those that have waited longest first."""
        self._check("notify")
        self._waiters.notify(max(0, n))

    def notify_all(self) -> None:
        """Wake all waiters."""
        self._check("notify")
        self._waiters.notify(SEM_VALUE_MAX)

    def _check(self, what: str) -> None:
        assert self._lock._semlock._is_mine(), f"must acquire() condition before using {what}()"

    def __repr__(self) -> str:
        return f"<{type(self).__name__}({self._lock!r}, {self._waiters.waiters()})>"


class Barrier(threading.Barrier):
    """A point at which ``parties`` threads of any process wait for each other.

    If a process that has taken part is killed, the barrier breaks within a second or two, for
    present and later waiters.  In multiprocessing they wait for ever.
    """

    def __init__(
        self,
        parties: int,
        action: Callable[[], object] | None = None,
        timeout: float | None = None,
        *,
        ctx: Any = None,
    ) -> None:
        if parties < 1:
            raise ValueError(f"a barrier is for at least one party, not {parties}")
        self._set_up(parties, action, timeout, Condition(), shared_blocks.create_wait_list())

    def _set_up(
        self,
        parties: int,
        action: Callable[[], object] | None,
        timeout: float | None,
        condition: Condition,
        members: AnyWaitList,
    ) -> None:
        self._parties, self._action, self._timeout = parties, action, timeout
        self._cond = condition
        # Processes that took part, and their counted threads.  The lock guards both.
        self._members: Any = members
        self._membership: Any = None
        self._member = 0
        self._counted = 0

    def __reduce__(self) -> tuple[Any, ...]:
        parts = self._parties, self._action, self._timeout, self._cond, self._members
        return _rebuild_barrier, (type(self), parts)

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the others; return a different number from 0 to ``parties`` - 1 to each."""
        timeout = self._timeout if timeout is None else timeout
        if isinstance(self._members, RemoteWaitList):
            return self._meet(self._members, timeout)
        with self._cond as acquired:
            if isinstance(acquired, Abandoned):  # its process died in this method
                self._bury()
                self._break()
            self._join()
            self._enter()
            self._change_count(1)
            try:
                if self._count == self._parties:
                    self._release()
                else:
                    self._wait(timeout)
            finally:
                self._change_count(-1)
                # Also after a thread was interrupted, no two threads leave with the same count.
                index = self._count
                self._exit()
        return index

    def _meet(self, members: RemoteWaitList, timeout: float | None) -> int:
        """Let the hub of the barrier's host take the steps of ``wait``."""
        if self._member != os.getpid():
            self._member = os.getpid()
            weakref.finalize(self, members.dismiss_all)
        condition: Any = self._cond._waiters
        lock: Any = self._cond._lock._semlock
        met = members.meet(condition, lock, self._parties, self._action, timeout)
        if isinstance(met, Breach):
            raise threading.BrokenBarrierError(*_reason(met, timeout))
        return met

    def reset(self) -> None:
        """Return to the initial state; waiters get BrokenBarrierError."""
        with self._cond:
            self._bury()
        super().reset()

    def _join(self) -> None:
        if self._member != os.getpid():  # a forked process is another member
            self._member, self._counted = os.getpid(), 0
            self._membership = self._members.enter()
            # A process that ends normally breaks no barrier.
            weakref.finalize(self, self._members.dismiss, self._membership)

    def _change_count(self, by: int) -> None:
        self._counted += by
        self._members.tally(self._membership, self._counted, self._count + by)

    def _enter(self) -> None:
        while self._state in (BarrierState.RESETTING, BarrierState.DRAINING):
            if not self._cond.wait(RECHECK) and self._bury():
                self._break()
        if self._state < 0:
            raise threading.BrokenBarrierError

    def _wait(self, timeout: float | None) -> None:
        deadline = math.inf if timeout is None else time.monotonic() + timeout
        while self._state == BarrierState.FILLING:
            left = max(0.0, deadline - time.monotonic())
            if self._cond.wait(min(left, RECHECK)):
                continue
            lost = self._bury()
            if self._state == BarrierState.FILLING and (lost or left <= RECHECK):
                self._break()
                breach = Breach.DIED if lost else Breach.LATE
                raise threading.BrokenBarrierError(*_reason(breach, timeout))
        if self._state < 0:
            raise threading.BrokenBarrierError

    def _bury(self) -> bool:
        """Stop counting members that died; tell whether there were any."""
        died = self._cond._waiters.remove_dead() + self._members.remove_dead()
        if died:
            self._members.set(1, self._members.held())
        return bool(died)

    # Attributes of threading's class, in shared memory

    @property
    def _state(self) -> int:
        return self._cond._waiters.get(0)

    @_state.setter
    def _state(self, value: int) -> None:
        self._cond._waiters.set(0, value)

    @property
    def _count(self) -> int:
        count: int = self._members.get(1)
        return count

    if TYPE_CHECKING:  # methods of threading's class that its stub lacks

        def _break(self) -> None: ...
        def _release(self) -> None: ...
        def _exit(self) -> None: ...


def _reason(breach: Breach, timeout: float | None) -> list[str]:
    if breach is Breach.DIED:
        return ["a process that took part has died"]
    return [f"the others did not come in {timeout} s"] if breach is Breach.LATE else []


def _rebuild_barrier(cls: type[Barrier], parts: tuple[Any, ...]) -> Barrier:
    new = cls.__new__(cls)
    new._set_up(*parts)
    return new


class Event:
    """A flag to wait for.

    ``set`` wakes all waiters even if ``clear`` follows at once.  ``wait`` then returns True, as in
    ``threading``.
    """

    def __init__(self, *, ctx: Any = None) -> None:
        self._flag: SharedCounter = LocalCounter.create()
        # Number of calls of ``set``.  A waiter that finds it changed was woken, set or not.
        self._bell: SharedCounter = LocalCounter.create()

    def is_set(self) -> bool:
        """Tell whether the flag is set."""
        return self._flag.wait(0)

    def set(self) -> None:
        """Set the flag and wake all waiters."""
        if not self._flag.wait(0):
            self._flag.add(1)
        self._bell.add(1)

    def clear(self) -> None:
        """Unset the flag."""
        self._flag.clear()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the flag is set; return False after ``timeout`` seconds."""
        if self._flag.wait(0):
            return True
        rung = self._bell.value()
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._flag.wait(0):
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0:
                return False
            if self._bell.changed(rung, RECHECK if left is None else min(left, RECHECK)):
                break
        return True

    def __repr__(self) -> str:
        status = "set" if self.is_set() else "unset"
        return f"<{type(self).__qualname__} at {id(self):#x} {status}>"
