"""Locks that the clients of a manager's server hold, released when a client dies.

In multiprocessing a client that is killed keeps its locks, its references and its place in a
barrier for ever.  A process that ends in order keeps its locks here too: another process may be
meant to release them.

The ``RLock`` of a manager is a class of this module.  Its lock can be taken from a holder, as a
thread of the server that acts for a dead client may wait in a queue for ever, with a lock that no
other thread could release.
"""

from __future__ import annotations

import itertools
import threading
import weakref
from collections import Counter
from collections.abc import Callable
from queue import Queue
from types import TracebackType
from typing import Any, TypeAlias

_acting = threading.local()


def act_as(holder: int) -> None:
    """Act for ``holder`` from now on: RLocks that this thread acquires belong to that holder."""
    _acting.holder = holder


def _current_holder() -> int:
    holder: int = getattr(_acting, "holder", 0)
    return holder or threading.get_ident()


class ManagedRLock:
    """Reentrant lock of a manager, with the methods of ``threading.RLock``."""

    def __init__(self) -> None:
        self._block = threading.Lock()
        self._mutex = threading.Lock()
        """Lock for the fields below.  A waiter never holds it."""
        self._holder: int | None = None
        self._count = 0

    def acquire(self, blocking: bool = True, timeout: float = -1) -> bool:
        """Acquire the lock as in ``threading``."""
        holder = _current_holder()
        with self._mutex:
            if self._holder == holder:
                self._count += 1
                return True
        if not self._block.acquire(blocking, timeout):
            return False
        with self._mutex:
            self._holder, self._count = holder, 1
        return True

    def release(self) -> None:
        """Release the lock as in ``threading``."""
        with self._mutex:
            if self._holder != _current_holder():
                raise RuntimeError("cannot release un-acquired lock")
            self._count -= 1
            if not self._count:
                self._holder = None
                self._block.release()

    def revoke(self, holder: int) -> bool:
        """Release the lock of ``holder``, which has ended; False if ``holder`` does not hold it."""
        with self._mutex:
            if self._holder != holder:
                return False
            self._holder, self._count = None, 0
            self._block.release()
            return True

    def held_by(self, holder: int) -> bool:
        """Tell whether ``holder`` holds the lock."""
        return self._holder == holder

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.release()

    # Methods that threading.Condition calls on an RLock

    def _is_owned(self) -> bool:
        return self.held_by(_current_holder())

    def _release_save(self) -> int:
        count = self._count
        if not self.revoke(_current_holder()):
            raise RuntimeError("cannot release un-acquired lock")
        return count

    def _acquire_restore(self, count: int) -> None:
        # If this wait was interrupted, another thread may hold it for the same holder meanwhile.
        self._block.acquire()
        with self._mutex:
            self._holder, self._count = _current_holder(), count
        _acting.restored = count

    def undo_restore(self) -> None:
        """Release what this thread's last ``wait`` at a condition acquired."""
        with self._mutex:
            if self._holder != _current_holder():
                return  # the client has ended, and the lock was revoked
            self._count -= _acting.restored
            if not self._count:
                self._holder = None
                self._block.release()


def condition(lock: object = None) -> threading.Condition:
    """Return a ``threading.Condition`` on ``lock``, or on a new ``ManagedRLock``."""
    managed = ManagedRLock() if lock is None else lock
    return threading.Condition(managed)  # type: ignore[arg-type]


_LOCK = type(threading.Lock())
_RELEASED_BY_ANY_THREAD = (_LOCK, threading.Semaphore)
_LOCKS = (*_RELEASED_BY_ANY_THREAD, ManagedRLock)
CONTENDED = (*_LOCKS, threading.Condition, threading.Barrier, Queue)
"""Types of objects that several clients may wait for."""

CallResult: TypeAlias = tuple[Any, str, tuple[str, Any]]
"""An object, the method that was called, and the answer."""


class Client:
    """Process that uses the manager."""

    def __init__(self, name: str) -> None:
        self.name = name
        """Description of the client."""
        self.closed_in_order = False
        self.ended = False
        self.references: Counter[str] = Counter()
        self.mutex = threading.Lock()
        self.barriers: list[threading.Barrier] = []
        """Barriers at which threads of the client wait."""
        self.threads: list[ClientThread] = []
        self.holders: dict[str, LockHolder] = {}
        """Threads of the client, by name."""


class LockHolder:
    """Thread of a client, as a holder of RLocks.

    Several threads of the server act for it, one after the other.  An earlier one may still be in
    a call that the client has interrupted.
    """

    def __init__(self) -> None:
        self.ident = next(_idents)
        self.held: set[ManagedRLock] = set()
        self.threads = 0
        """Number of threads of the server that act for it."""


_idents = itertools.count(-1, -1)
"""Negative numbers, which are the identity of no thread."""


class LockTable:
    """Table of the locks and semaphores that each client has acquired, and how often."""

    def __init__(self) -> None:
        self._mutex = threading.Lock()
        self._held: dict[int, tuple[Any, Counter[Client]]] = {}
        self._warnings: weakref.WeakKeyDictionary[Any, str] = weakref.WeakKeyDictionary()

    def acquired(self, lock: Any, client: Client) -> bool:
        """Note that ``client`` has acquired ``lock``; False if the client has ended."""
        with self._mutex:
            if client.ended:
                return False
            if isinstance(lock, ManagedRLock):  # its LockHolder has a note of it
                return True
            self._held.setdefault(id(lock), (lock, Counter()))[1][client] += 1
            return True

    def releasing(self, lock: Any, client: Client) -> None:
        """Note that ``client`` is about to release ``lock``.

        Call it before the release: after that another client may hold the lock.
        """
        with self._mutex:
            holders = self._held.get(id(lock), (lock, Counter[Client]()))[1]
            self._note_release(lock, client, holders)

    def _note_release(self, lock: Any, client: Client, holders: Counter[Client]) -> None:
        if client in holders:
            holders[client] -= 1
            if not holders[client]:
                del holders[client]
        elif type(lock) is _LOCK:
            holders.clear()  # another client acquired it for this one to release
        if not holders:
            self._held.pop(id(lock), None)

    def withdraw(self, lock: Any, client: Client) -> bool:
        """Remove one acquisition of ``client``; False if there is none, as the client has ended."""
        with self._mutex:
            holders = self._held.get(id(lock), (lock, Counter[Client]()))[1]
            if client not in holders:
                return False
            self._note_release(lock, client, holders)
            return True

    def end(self, client: Client) -> None:
        """Note the end of a client.  Release its locks, unless it ended in order."""
        with self._mutex:
            client.ended = True
            held = [(lock, holders.pop(client, 0)) for lock, holders in self._held.values()]
            self._held = {key: value for key, value in self._held.items() if value[1]}
        if client.closed_in_order:
            return
        for lock, count in held:
            for _ in range(count):
                self.warn(lock, _released_text(lock, client.name))
                lock.release()
        for thread in list(client.threads):
            thread.release_locks()
        for barrier in list(client.barriers):
            barrier.abort()

    def warn(self, lock: Any, text: str) -> None:
        """Keep a warning for the next client that acquires ``lock``."""
        self._warnings[lock] = text

    def warning(self, lock: Any) -> str | None:
        """Return a warning for the client that has just acquired ``lock``, or None."""
        return self._warnings.pop(lock, None) if self._warnings else None


class ClientThread:
    """Thread of the server that acts for one thread of a client."""

    def __init__(self, locks: LockTable, client: Client, name: str) -> None:
        self._locks = locks
        self._client = client
        self._name = name
        with client.mutex:
            self._holder = client.holders.setdefault(name, LockHolder())
            self._holder.threads += 1
        self._ident = self._holder.ident
        self._held = self._holder.held
        act_as(self._ident)
        self.last_result: CallResult | None = None
        """Result of the last call, if other clients may wait for it."""
        self.kept: Any = None
        """Last result that has proxies in it.

        It keeps their objects until the client has its own references.  The client has them when
        it makes the next call.
        """
        client.threads.append(self)

    def call(
        self, obj: Any, method: str, function: Callable[..., Any], args: Any, kwds: Any
    ) -> tuple[str, Any]:
        """Call a method of a ``CONTENDED`` object and return the answer."""
        if isinstance(obj, threading.Barrier):
            self._client.barriers.append(obj)
            try:
                return "#RETURN", function(*args, **kwds)
            finally:
                self._client.barriers.remove(obj)
        lock = _lock_of(obj)
        if method == "release" and isinstance(lock, _RELEASED_BY_ANY_THREAD):
            self._locks.releasing(lock, self._client)
        result = function(*args, **kwds)
        answer = "#RETURN", result
        if method == "acquire" and result:
            answer = self._acquired(lock, result)
        elif (
            method == "release" and isinstance(lock, ManagedRLock) and not lock.held_by(self._ident)
        ):
            self._held.discard(lock)
        self.last_result = obj, method, answer
        return answer

    def _acquired(self, lock: Any, result: Any) -> tuple[str, Any]:
        if not isinstance(lock, _LOCKS):
            return "#RETURN", result
        if isinstance(lock, ManagedRLock):
            self._held.add(lock)
        if not self._locks.acquired(lock, self._client):
            lock.release()
            return "#RETURN", False
        warning = self._locks.warning(lock)
        return ("#RETURN", result) if warning is None else ("#WARNING", (warning, result))

    def take_back(self, taken: CallResult | None) -> None:
        """Undo a call whose answer the client does not get, so that other clients can have it."""
        if taken is None:
            return
        obj, method, (kind, result) = taken
        lock = _lock_of(obj)
        if method == "acquire" and result and isinstance(lock, _LOCKS):
            if kind == "#WARNING":
                self._locks.warn(lock, result[0])
            if isinstance(lock, ManagedRLock):
                held = lock.held_by(self._ident)  # not after the client's end, which revoked it
            else:
                held = self._locks.withdraw(lock, self._client)
            if held:
                lock.release()
        elif method == "wait" and result and isinstance(lock, ManagedRLock):
            with lock:
                obj.notify()
            lock.undo_restore()  # no warning: the thread only waited
        elif method == "get" and type(obj) is Queue:
            with obj.mutex:
                obj.queue.appendleft(result)
                obj.not_empty.notify()

    def release_locks(self) -> None:
        """Release the RLocks of this thread, as no other thread can."""
        for lock in [lock for lock in self._held if lock.held_by(self._ident)]:
            self._locks.warn(lock, _released_text(lock, f"a thread of {self._client.name}"))
            lock.revoke(self._ident)

    def end(self) -> None:
        """Note that the client's thread has ended."""
        client, holder = self._client, self._holder
        client.threads.remove(self)
        with client.mutex:
            holder.threads -= 1
            if holder.threads:
                return
            del client.holders[self._name]
        self.release_locks()


def _released_text(lock: Any, holder: str) -> str:
    kind = "rlock" if isinstance(lock, ManagedRLock) else type(lock).__name__.lower()
    return (
        f"{holder} ended while it held this {kind} of a manager. The manager has released it. The "
        "data that it guards may be half changed: check that before you rely on it"
    )


def _lock_of(obj: Any) -> Any:
    return vars(obj)["_lock"] if isinstance(obj, threading.Condition) else obj
