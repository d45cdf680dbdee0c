"""What the clients of a manager's server hold, so that it is let go when they die.

Differs from multiprocessing, where a client that is killed keeps its locks, its references and its
place in a barrier for ever.  A process that ends in good order keeps its locks here too: another
one may be meant to release them.
"""

from __future__ import annotations

import threading
import weakref
from collections import Counter
from queue import Queue
from typing import Any

_LOCK = type(threading.Lock())
_ANYBODYS = (_LOCK, threading.Semaphore)
"""Any thread may release them."""
_OWNED = (type(threading.RLock()), threading.Condition)
"""Only the thread that acquired them may."""


class Client:
    """A process that uses the manager."""

    def __init__(self, name: str) -> None:
        self.name = name
        """In words."""
        self.left_in_order = False
        self.gone = False
        self.references: Counter[str] = Counter()
        self.mutex = threading.Lock()
        self.barriers: list[threading.Barrier] = []
        """At which its threads wait."""


class Holdings:
    """Who has acquired which lock or semaphore how often."""

    def __init__(self) -> None:
        self._mutex = threading.Lock()
        self._held: dict[int, tuple[Any, Counter[Client]]] = {}
        self._abandoned: weakref.WeakKeyDictionary[Any, str] = weakref.WeakKeyDictionary()

    def acquired(self, lock: Any, client: Client) -> bool:
        """``client`` has it now; False if it cannot have anything any more."""
        with self._mutex:
            if client.gone:
                return False
            self._held.setdefault(id(lock), (lock, Counter()))[1][client] += 1
            return True

    def released(self, lock: Any, client: Client) -> None:
        """``client`` has released it."""
        with self._mutex:
            holders = self._held.get(id(lock), (lock, Counter[Client]()))[1]
            if client in holders:
                holders[client] -= 1
                holders += Counter()  # less those that have none
            elif type(lock) is _LOCK:
                holders.clear()  # it was handed over
            if not holders:
                self._held.pop(id(lock), None)

    def end(self, client: Client) -> None:
        """It is gone; if not in good order, release what it had."""
        with self._mutex:
            client.gone = True
            mine = [(lock, holders.pop(client, 0)) for lock, holders in self._held.values()]
            self._held = {key: value for key, value in self._held.items() if value[1]}
        if client.left_in_order:
            return
        for lock, count in mine:
            for _ in range(count):
                self.abandon(lock, client)
        for barrier in client.barriers:
            barrier.abort()

    def abandon(self, lock: Any, client: Client) -> None:
        """Release it for ``client``, and have the next one who acquires it know."""
        self._abandoned[lock] = (
            f"{client.name} ended while it held a {type(lock).__name__.lower()} of this manager, "
            "which was released: what the lock protects may be half changed"
        )
        lock.release()

    def warning(self, lock: Any) -> str | None:
        """What whoever has just acquired it should know."""
        return self._abandoned.pop(lock, None) if self._abandoned else None


class ClientThread:
    """What one thread of the server has on behalf of one thread of a client."""

    def __init__(self, holdings: Holdings, client: Client) -> None:
        self._holdings = holdings
        self._client = client
        self._owned: list[Any] = []
        self.kept: Any = None
        """The last result that has proxies in it: until the client has references of its own to
        what they stand for, which it has when it asks for the next."""

    def note(self, obj: Any, method: str, result: Any) -> str | None:
        """A method of a lock was called; what its caller should be warned of."""
        if method == "release":
            if isinstance(obj, _ANYBODYS):
                self._holdings.released(obj, self._client)
            elif isinstance(obj, _OWNED):
                self._owned.remove(obj)
        elif result and isinstance(obj, _OWNED):
            self._owned.append(obj)
            return self._holdings.warning(obj)
        elif result and isinstance(obj, _ANYBODYS):
            if not self._holdings.acquired(obj, self._client):
                obj.release()
                return None
            return self._holdings.warning(obj)
        return None

    def take_back(self, obj: Any, method: str, result: Any) -> None:
        """The client will never know what it got: let others have it."""
        if method == "acquire" and result:
            if isinstance(obj, _ANYBODYS):
                self._holdings.released(obj, self._client)
                obj.release()
            elif isinstance(obj, _OWNED):
                self._owned.remove(obj)
                obj.release()
        elif method == "get" and type(obj) is Queue:
            with obj.mutex:
                obj.queue.appendleft(result)
                obj.not_empty.notify()
        elif method == "wait" and result and isinstance(obj, threading.Condition):
            obj.notify()

    def end(self) -> None:
        """The client's thread has ended: nobody else could release them."""
        while self._owned:
            self._holdings.abandon(self._owned.pop(), self._client)
