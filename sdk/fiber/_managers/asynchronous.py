"""Proxies whose methods return at once, with a handle for the result.

::

    proxy ── Pipeline ── calls, one after the other ──► a thread of the server, for this proxy alone
                 ◄────── answers, in the same order

A thread that waits for one result reads the answers of all.  Each answer is kept in its result.
"""

from __future__ import annotations

import itertools
import os
import select
import threading
import time
import weakref
from collections.abc import Callable
from multiprocessing import managers as mp_managers
from typing import Any

from fiber import reduction
from fiber._exceptions import fresh
from fiber._hub.client import ObjectUnreachable
from fiber._managers.client import NUMBER, ManagerSession, proxy_of, session
from fiber._runtime.threads import Waiters, acquire
from fiber.errors import ConnectionClosed, TimeoutError

_mp: Any = mp_managers  # typeshed has part of it

_READ_AGAIN = 1000
"""Milliseconds between the checks of a caller that waits for room: does a thread read answers?"""


class AsyncProxyResult:
    """Result of a call in progress, with the methods of ``multiprocessing.pool.AsyncResult``."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._outcome: tuple[str, Any] | None = None

    def get(self, timeout: float | None = None) -> Any:
        """Return the result of the method, each time the same object, or raise its error.

        TimeoutError if the call has not ended within ``timeout`` seconds; it goes on.
        ConnectionClosed if the manager has ended.
        """
        if not self._pipeline.wait(self, timeout):
            raise TimeoutError(f"the call has not returned within {timeout:g} s")
        kind, result = self._pipeline.outcome(self)
        if kind == "#RETURN":
            return result
        raise fresh(_mp.convert_to_error(kind, result))

    def wait(self, timeout: float | None = None) -> None:
        """Wait until the call has ended, at most ``timeout`` seconds."""
        self._pipeline.wait(self, timeout)

    def ready(self) -> bool:
        """Tell whether the call has ended."""
        return self._pipeline.wait(self, 0)

    def successful(self) -> bool:
        """Tell whether the call ended without an error; ValueError if it has not ended."""
        if not self.ready():
            raise ValueError(f"{self!r} not ready")
        assert self._outcome is not None
        return self._outcome[0] in ("#RETURN", "#PROXY")


class Pipeline:
    """Calls of one proxy.  A call may begin before earlier calls have ended."""

    def __init__(self, server: ManagerSession) -> None:
        self.pid = os.getpid()
        self._session = server
        self._channel = server.open_channel()
        self._numbers = itertools.count(1)
        self._answered = 0
        self._sending = threading.RLock()
        """Held while a call is sent, so that calls are sent in the order of their numbers.

        Reentrant, as a signal's handler may make a call too.
        """
        self._pending: dict[int, weakref.ref[AsyncProxyResult]] = {}
        self._reading = threading.Lock()
        self._waiters = Waiters()

    def call(self, ident: str, method: str, args: Any, kwds: Any) -> AsyncProxyResult:
        """Begin a call and return its result."""
        try:
            payload, buffers = reduction.encode((ident, method, args, kwds))
        except reduction.REFUSALS as error:
            raise reduction.blame({f"the arguments of {method}()": (args, kwds)}, error) from error
        result = AsyncProxyResult(self)
        with self._sending:
            number = next(self._numbers)
            self._pending[number] = weakref.ref(result)
            try:
                while not self._channel.try_send(NUMBER.pack(number) + payload, buffers):
                    self._make_room()
            except OSError:
                self._end()
        return result

    def _make_room(self) -> None:
        """Wait for room for a call.

        If the server reads no calls because no thread reads its answers, read one.
        """
        poller = select.poll()
        poller.register(self._channel.fileno(), select.POLLIN | select.POLLOUT)
        readable = any(events & select.POLLIN for _, events in poller.poll(_READ_AGAIN))
        if readable and self._reading.acquire(blocking=False):
            self._read(0)

    def wait(self, result: AsyncProxyResult, timeout: float | None) -> bool:
        """Wait until a call has ended; return False after ``timeout`` seconds."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while result._outcome is None:
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            if self._reading.acquire(blocking=False):
                came = self._read(left)
            else:
                came = self._let_another_read(result, left)
            if not came and deadline is not None and time.monotonic() >= deadline:
                break
        return result._outcome is not None

    def _let_another_read(self, result: AsyncProxyResult, timeout: float | None) -> bool:
        lock = self._waiters.join()
        try:
            return not self._reading.locked() or acquire(lock, timeout)
        finally:
            self._waiters.leave(lock)

    def _read(self, timeout: float | None) -> bool:
        """Read one answer; return False if none comes within ``timeout`` seconds.

        The caller holds the lock for reading, which is released here.
        """
        try:
            if not self._channel.poll(timeout):
                return False
            self._store(*self._next())
            return True
        except _Ended:
            self._end()
            return True
        finally:
            self._reading.release()
            self._waiters.wake()

    def _next(self) -> tuple[int, str, Any]:
        try:
            answer: tuple[int, str, Any] = self._channel.recv_object()
            return answer
        except ConnectionClosed as error:
            if isinstance(error, ObjectUnreachable):  # an object in the answer is, not the server
                return self._answered + 1, "#ERROR", error
            raise _Ended from error
        except Exception as error:  # the answer does not unpickle
            return self._answered + 1, "#ERROR", error

    def _store(self, number: int, kind: str, value: Any) -> None:
        for lost in range(self._answered + 1, number):  # the thread that read it was interrupted
            self._settle(lost, "#ERROR", InterruptedError("the answer was lost to a signal"))
        self._answered = number
        if not self._settle(number, kind, value) and kind == "#PROXY":
            ident = str(value[1].id)
            self._session.add_reference(ident)
            self._session.drop_reference(ident)

    def _settle(self, number: int, kind: str, value: Any) -> bool:
        """Store the outcome of a call; return False if its result was forgotten."""
        reference = self._pending.pop(number, None)
        result = None if reference is None else reference()
        if result is None:
            return False
        result._outcome = kind, value
        return True

    def _end(self) -> None:
        error = self._session.closed_error()
        for number in list(self._pending):
            self._settle(number, "#ERROR", error)
        self._waiters.wake()

    def outcome(self, result: AsyncProxyResult) -> tuple[str, Any]:
        """Return the outcome of a call that has ended.  Runs on its caller's thread."""
        assert result._outcome is not None
        kind, value = result._outcome
        if kind == "#PROXY":
            result._outcome = "#RETURN", proxy_of(self._session, *value)
        return result._outcome


class _Ended(Exception):
    """Signal that the channel is closed and no more answers come."""


class AsyncBaseProxy(mp_managers.BaseProxy):
    """Proxy whose methods return an ``AsyncProxyResult`` at once.

    The server runs the calls of one proxy one after the other, in their order.  Calls of different
    proxies run at the same time.
    """

    _token: Any

    def __init__(self, *args: Any, exposed: Any = None, **options: Any) -> None:
        _mp.BaseProxy.__init__(self, *args, exposed=exposed, **options)
        self._exposed = tuple(exposed or ())
        self._calls: Pipeline | None = None

    def __getattr__(self, name: str) -> Callable[..., AsyncProxyResult]:
        if name.startswith("_") or name not in self._exposed:
            raise AttributeError(f"{self!r} has no method {name!r}")

        def method(*args: Any, **kwds: Any) -> AsyncProxyResult:
            return self._callmethod(name, args, kwds)

        method.__name__ = name
        return method

    def _callmethod(  # type: ignore[override]  # the base's waits for the result
        self, methodname: str, args: Any = (), kwds: Any = None
    ) -> AsyncProxyResult:
        """Begin a call of any exposed method, ``__getitem__`` for instance."""
        calls, token = self._calls, self._token
        if calls is None or calls.pid != os.getpid():  # none yet, or this process was forked
            calls = self._calls = Pipeline(session(token.address))
        return calls.call(token.id, methodname, args, kwds or {})

    def _getvalue(self) -> AsyncProxyResult:
        """Begin to fetch a copy of the object."""
        return self._callmethod("#GETVALUE")

    def __reduce__(self) -> tuple[Any, ...]:
        token, serializer = self._token, self._serializer
        return _mp.RebuildProxy, (type(self), token, serializer, {"exposed": self._exposed})

    def __repr__(self) -> str:
        token = self._token
        return f"<{type(self).__name__} object, typeid {token.typeid!r}, of {token.address.server}>"

    __str__ = __repr__
