"""What the clients of a manager's server hold, so that it is let go when they die.

Differs from multiprocessing, where a client that is killed keeps its locks, its references and its
place in a barrier for ever.  A process that ends in good order keeps its locks here too: another
one may be meant to release them.
"""

from __future__ import annotations

import threading
import weakref
from collections import Counter
from collections.abc import Callable
from queue import Queue
from typing import Any, TypeAlias

_LOCK = type(threading.Lock())
_ANYBODYS = (_LOCK, threading.Semaphore)
"""Any thread may release them."""
_OWNED = (type(threading.RLock()), threading.Condition)
"""Only the thread that acquired them may."""
SYNCHRONIZATION = (*_ANYBODYS, *_OWNED, threading.Barrier)
"""What a client that dies would leave in the others' way."""
WAITING = frozenset({"acquire", "get", "wait"})
"""Methods that get something for which others may wait, too."""

Got: TypeAlias = tuple[Any, str, tuple[str, Any]]
"""An object, the method that was called, and the answer."""


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

    def releasing(self, lock: Any, client: Client) -> None:
        """``client`` is about to release it: noted first, as then it can be somebody else's."""
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
                self.abandon(lock, client.name)
        for barrier in list(client.barriers):
            barrier.abort()

    def abandon(self, lock: Any, holder: str) -> None:
        """Release it for ``holder``, and have the next one who acquires it know."""
        self.warn(
            lock,
            f"{holder} ended while it held a {type(lock).__name__.lower()} of this manager, "
            "which was released: what the lock protects may be half changed",
        )
        lock.release()

    def warn(self, lock: Any, text: str) -> None:
        """What the next one who acquires it should know."""
        self._abandoned[lock] = text

    def warning(self, lock: Any) -> str | None:
        """What whoever has just acquired it should know."""
        return self._abandoned.pop(lock, None) if self._abandoned else None


class ClientThread:
    """What one thread of the server has on behalf of one thread of a client."""

    def __init__(self, holdings: Holdings, client: Client) -> None:
        self._holdings = holdings
        self._client = client
        self._owned: list[Any] = []
        self.got: Got | None = None
        """What the last call brought, if others wait for such."""
        self.kept: Any = None
        """The last result that has proxies in it: until the client has references of its own to
        what they stand for, which it has when it asks for the next."""

    def call(
        self, obj: Any, method: str, function: Callable[..., Any], args: Any, kwds: Any
    ) -> tuple[str, Any]:
        """The answer to a call of a ``WAITING`` method, or of a ``SYNCHRONIZATION`` object's."""
        if isinstance(obj, threading.Barrier):
            self._client.barriers.append(obj)
            try:
                return "#RETURN", function(*args, **kwds)
            finally:
                self._client.barriers.remove(obj)
        if method == "release" and isinstance(obj, _ANYBODYS):
            self._holdings.releasing(obj, self._client)
        result = function(*args, **kwds)
        if method == "release" and isinstance(obj, _OWNED):
            self._owned.remove(obj)
        answer = "#RETURN", result
        if method == "acquire" and result:
            answer = self._acquired(obj, result)
        if method in WAITING:
            self.got = obj, method, answer
        return answer

    def _acquired(self, lock: Any, result: Any) -> tuple[str, Any]:
        if isinstance(lock, _OWNED):
            self._owned.append(lock)
        elif not isinstance(lock, _ANYBODYS):
            return "#RETURN", result
        elif not self._holdings.acquired(lock, self._client):
            lock.release()
            return "#RETURN", False
        warning = self._holdings.warning(lock)
        return ("#RETURN", result) if warning is None else ("#WARNING", (warning, result))

    def take_back(self, got: Got | None) -> None:
        """The client will never know what it got: let others have it."""
        if got is None:
            return
        obj, method, (kind, result) = got
        if kind == "#WARNING":
            self._holdings.warn(obj, result[0])
        if method == "acquire" and result:
            self._give_up(obj)
        elif method == "wait" and result and isinstance(obj, threading.Condition):
            obj.notify()
            while obj in self._owned:  # it only waited: nothing is half changed
                self._give_up(obj)
        elif method == "get" and type(obj) is Queue:
            with obj.mutex:
                obj.queue.appendleft(result)
                obj.not_empty.notify()

    def _give_up(self, lock: Any) -> None:
        if isinstance(lock, _OWNED):
            self._owned.remove(lock)
        elif isinstance(lock, _ANYBODYS):
            self._holdings.releasing(lock, self._client)
        else:
            return
        lock.release()

    def end(self) -> None:
        """The client's thread has ended: nobody else could release them."""
        whose = "" if self._client.gone else "a thread of "
        while self._owned:
            self._holdings.abandon(self._owned.pop(), whose + self._client.name)
