"""Holdings of the clients of a manager's server, which are released when clients die.

Differs from multiprocessing, where a client that is killed keeps its locks, its references and its
place in a barrier for ever.  A process that ends in good order keeps its locks here too: another
one may be meant to release them.
"""

from __future__ import annotations

import itertools
import threading
import weakref
from collections import Counter
from collections.abc import Callable
from queue import Queue
from typing import Any, TypeAlias

from fiber._managers.rlock import RLock, act_as

_LOCK = type(threading.Lock())
_ANYBODYS = (_LOCK, threading.Semaphore)
"""Any thread may release them."""
_LOCKS = (*_ANYBODYS, RLock)
CONTENDED = (*_LOCKS, threading.Condition, threading.Barrier, Queue)
"""Types of objects for which several clients may wait."""

Got: TypeAlias = tuple[Any, str, tuple[str, Any]]
"""An object, the method that was called, and the answer."""


class Client:
    """A process that uses the manager."""

    def __init__(self, name: str) -> None:
        self.name = name
        """Description of the client."""
        self.left_in_order = False
        self.gone = False
        self.references: Counter[str] = Counter()
        self.mutex = threading.Lock()
        self.barriers: list[threading.Barrier] = []
        """At which its threads wait."""
        self.threads: list[ClientThread] = []
        self.owners: dict[str, Owner] = {}
        """Threads of the client."""


class Owner:
    """A thread of a client.

    It has several threads here, one after the other: the one before may still be in a call that
    was interrupted.
    """

    def __init__(self) -> None:
        self.ident = next(_idents)
        self.owned: set[RLock] = set()
        self.threads = 0
        """Number of threads of the server that act for it."""


_idents = itertools.count(-1, -1)
"""Numbers that no thread has."""


class Holdings:
    """Table of the locks and semaphores that each client has acquired, and how often."""

    def __init__(self) -> None:
        self._mutex = threading.Lock()
        self._held: dict[int, tuple[Any, Counter[Client]]] = {}
        self._warnings: weakref.WeakKeyDictionary[Any, str] = weakref.WeakKeyDictionary()

    def acquired(self, lock: Any, client: Client) -> bool:
        """``client`` has it now; False if it cannot have anything any more."""
        with self._mutex:
            if client.gone:
                return False
            if isinstance(lock, RLock):  # that is known by its threads
                return True
            self._held.setdefault(id(lock), (lock, Counter()))[1][client] += 1
            return True

    def releasing(self, lock: Any, client: Client) -> None:
        """``client`` is about to release it: noted first, as then it can be somebody else's."""
        with self._mutex:
            holders = self._held.get(id(lock), (lock, Counter[Client]()))[1]
            self._note_release(lock, client, holders)

    def _note_release(self, lock: Any, client: Client, holders: Counter[Client]) -> None:
        if client in holders:
            holders[client] -= 1
            if not holders[client]:
                del holders[client]
        elif type(lock) is _LOCK:
            holders.clear()  # it was handed over
        if not holders:
            self._held.pop(id(lock), None)

    def withdraw(self, lock: Any, client: Client) -> bool:
        """``client`` is not to have it; False if it has not, as it is gone."""
        with self._mutex:
            holders = self._held.get(id(lock), (lock, Counter[Client]()))[1]
            if client not in holders:
                return False
            self._note_release(lock, client, holders)
            return True

    def end(self, client: Client) -> None:
        """Note the end of a client.  If it was not in good order, release its locks."""
        with self._mutex:
            client.gone = True
            mine = [(lock, holders.pop(client, 0)) for lock, holders in self._held.values()]
            self._held = {key: value for key, value in self._held.items() if value[1]}
        if client.left_in_order:
            return
        for lock, count in mine:
            for _ in range(count):
                self.warn(lock, abandoned(lock, client.name))
                lock.release()
        for thread in list(client.threads):
            thread.abandon()
        for barrier in list(client.barriers):
            barrier.abort()

    def warn(self, lock: Any, text: str) -> None:
        """Have the next one who acquires it know."""
        self._warnings[lock] = text

    def warning(self, lock: Any) -> str | None:
        """Return a warning for the client that has just acquired a lock; None if there is none."""
        return self._warnings.pop(lock, None) if self._warnings else None


class ClientThread:
    """Thread of the server that acts for one thread of a client."""

    def __init__(self, holdings: Holdings, client: Client, name: str) -> None:
        self._holdings = holdings
        self._client = client
        self._name = name
        with client.mutex:
            self._owner = client.owners.setdefault(name, Owner())
            self._owner.threads += 1
        self._ident = self._owner.ident
        self._owned = self._owner.owned
        act_as(self._ident)
        self.got: Got | None = None
        """Result of the last call, if other clients wait for such a thing."""
        self.kept: Any = None
        """The last result that has proxies in it: until the client has references of its own to
        what they stand for, which it has when it asks for the next."""
        client.threads.append(self)

    def call(
        self, obj: Any, method: str, function: Callable[..., Any], args: Any, kwds: Any
    ) -> tuple[str, Any]:
        """The answer to a call of a method of something ``CONTENDED``."""
        if isinstance(obj, threading.Barrier):
            self._client.barriers.append(obj)
            try:
                return "#RETURN", function(*args, **kwds)
            finally:
                self._client.barriers.remove(obj)
        lock = _lock_of(obj)
        if method == "release" and isinstance(lock, _ANYBODYS):
            self._holdings.releasing(lock, self._client)
        result = function(*args, **kwds)
        answer = "#RETURN", result
        if method == "acquire" and result:
            answer = self._acquired(lock, result)
        elif method == "release" and isinstance(lock, RLock) and not lock.owned_by(self._ident):
            self._owned.discard(lock)
        self.got = obj, method, answer
        return answer

    def _acquired(self, lock: Any, result: Any) -> tuple[str, Any]:
        if not isinstance(lock, _LOCKS):
            return "#RETURN", result
        if isinstance(lock, RLock):
            self._owned.add(lock)
        if not self._holdings.acquired(lock, self._client):
            lock.release()
            return "#RETURN", False
        warning = self._holdings.warning(lock)
        return ("#RETURN", result) if warning is None else ("#WARNING", (warning, result))

    def take_back(self, got: Got | None) -> None:
        """The client will never know what it got: let others have it."""
        if got is None:
            return
        obj, method, (kind, result) = got
        lock = _lock_of(obj)
        if method == "acquire" and result and isinstance(lock, _LOCKS):
            if kind == "#WARNING":
                self._holdings.warn(lock, result[0])
            if isinstance(lock, RLock):
                mine = lock.owned_by(self._ident)  # else its client is gone, and it was revoked
            else:
                mine = self._holdings.withdraw(lock, self._client)
            if mine:
                lock.release()
        elif method == "wait" and result and isinstance(lock, RLock):
            with lock:
                obj.notify()
            lock.undo_restore()  # without a warning: it only waited
        elif method == "get" and type(obj) is Queue:
            with obj.mutex:
                obj.queue.appendleft(result)
                obj.not_empty.notify()

    def abandon(self) -> None:
        """Give up the locks of this thread, which no other could release."""
        for lock in [lock for lock in self._owned if lock.owned_by(self._ident)]:
            self._holdings.warn(lock, abandoned(lock, f"a thread of {self._client.name}"))
            lock.revoke(self._ident)

    def end(self) -> None:
        """The client's thread has ended."""
        client, owner = self._client, self._owner
        client.threads.remove(self)
        with client.mutex:
            owner.threads -= 1
            if owner.threads:
                return
            del client.owners[self._name]
        self.abandon()


def abandoned(lock: Any, holder: str) -> str:
    """Return the message about a lock that ``holder`` had."""
    return (
        f"{holder} ended while it held this {type(lock).__name__.lower()} of a manager, "
        "which was released: what it protects may be half changed"
    )


def _lock_of(obj: Any) -> Any:
    return vars(obj)["_lock"] if isinstance(obj, threading.Condition) else obj
