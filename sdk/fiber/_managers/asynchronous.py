"""Calls of managed objects that return at once, with a handle for the result.

::

    proxy ── Pipeline ── calls, one after the other ──► a thread of the server, for this proxy alone
                 ◄────── replies, each with the number of its call

The reply is taken in by whoever waits for any of them, and unpickled by whoever asks for it.
"""

from __future__ import annotations

import itertools
import os
import select
import struct
import threading
import time
import weakref
from multiprocessing import managers as mp_managers
from multiprocessing.managers import Token
from typing import Any, Self

from fiber import reduction
from fiber._managers.client import Session, proxy_of, session, thread_name
from fiber._managers.door import ManagerAddress
from fiber._runtime.latch import Waiters, acquire
from fiber._wire import packet
from fiber._wire.packet import Message
from fiber.errors import ConnectionClosed, TimeoutError

NUMBER = struct.Struct("<Q")
"""Before the pickle of a call and of its reply: what does not unpickle has a number too."""

_convert_to_error: Any = mp_managers.convert_to_error  # type: ignore[attr-defined]


class AsyncProxyResult:
    """A call under way, as multiprocessing's ``AsyncResult``."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._reply: Message | ConnectionClosed | None = None
        self._outcome: tuple[str, Any] | None = None

    def get(self, timeout: float | None = None) -> Any:
        """What the method returned; raises what it raised.

        TimeoutError if it has not within ``timeout`` seconds; the call goes on.  ConnectionClosed
        if the manager is gone.
        """
        if not self._pipeline.wait(self, timeout):
            raise TimeoutError(f"the call has not returned within {timeout:g} s")
        kind, result = self._decoded()
        if kind == "#RETURN":
            return result
        raise _convert_to_error(kind, result)

    def wait(self, timeout: float | None = None) -> None:
        """Wait until the call has ended, at most ``timeout`` seconds."""
        self._pipeline.wait(self, timeout)

    def ready(self) -> bool:
        """Whether the call has ended."""
        return self._pipeline.wait(self, 0)

    def successful(self) -> bool:
        """Whether it has returned without an error; ValueError if it has not ended."""
        if not self.ready():
            raise ValueError(f"{self!r} not ready")
        return self._decoded()[0] == "#RETURN"

    def settle(self, reply: Message | ConnectionClosed) -> None:
        """It has ended so."""
        self._reply = reply

    @property
    def settled(self) -> bool:
        """Whether it has."""
        return self._reply is not None

    def _decoded(self) -> tuple[str, Any]:
        if self._outcome is None:
            assert self._reply is not None
            self._outcome = self._pipeline.decode(self._reply)
        return self._outcome


class Pipeline:
    """Calls of one object by one proxy."""

    def __init__(self, address: ManagerAddress, *first: Any) -> None:
        self._session: Session = session(address)
        self._channel = self._session.hand_over("pipeline", thread_name())
        self._pid = os.getpid()
        self._numbers = itertools.count(1)
        self._pending: dict[int, weakref.ref[AsyncProxyResult]] = {}
        self._reading = threading.Lock()
        self._waiters = Waiters()
        self.made = self.call(*first)
        """(id, names of methods) of the object, once there is one."""

    def call(self, method: str, args: tuple[Any, ...], kwds: dict[str, Any]) -> AsyncProxyResult:
        """Begin a call, without waiting for those before it."""
        if self._pid != os.getpid():
            raise RuntimeError(
                "this proxy was made before its process was forked, and belongs to the parent: "
                "pass it to the process as an argument"
            )
        try:
            payload, buffers = reduction.encode((method, args, kwds))
        except reduction.REFUSALS as error:
            raise reduction.blame({f"the arguments of {method}()": (args, kwds)}, error) from error
        number = next(self._numbers)
        result = AsyncProxyResult(self)
        self._pending[number] = weakref.ref(result)
        try:
            while not self._channel.try_send(NUMBER.pack(number) + payload, buffers):
                self._make_room()
        except (BrokenPipeError, ConnectionClosed):
            self._end()
        return result

    def _make_room(self) -> None:
        """The server reads no calls, perhaps since nobody reads its replies."""
        poller = select.poll()
        poller.register(self._channel.fileno(), select.POLLIN | select.POLLOUT)
        if not any(events & select.POLLIN for _, events in poller.poll(1000)):
            return
        if self._reading.acquire(blocking=False):
            self._read_as_reader(0)

    def wait(self, result: AsyncProxyResult, timeout: float | None) -> bool:
        """Wait for a call's end; False if ``timeout`` seconds are over first."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while not result.settled:
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            if self._reading.acquire(blocking=False):
                came = result.settled or self._read_as_reader(left)
            else:
                came = self._wait_for_reader(result, left)
            if not came and left is not None and time.monotonic() - (deadline or 0) >= 0:
                return result.settled
        return True

    def _read_as_reader(self, timeout: float | None) -> bool:
        """Take in one reply; the reader's lock is held, and released."""
        try:
            if not self._channel.poll(timeout):
                return False
            message = self._channel.try_recv()
            if message is not None:
                self._settle(message)
            return True
        except ConnectionClosed:
            self._end()
            return True
        finally:
            self._reading.release()
            self._waiters.wake()

    def _wait_for_reader(self, result: AsyncProxyResult, timeout: float | None) -> bool:
        """Until another thread has read something, or reads no longer."""
        lock = self._waiters.join()
        if not self._reading.locked() or result.settled or not acquire(lock, timeout):
            self._waiters.leave(lock)
        return result.settled

    def _settle(self, message: Message) -> None:
        (number,) = NUMBER.unpack_from(message.payload)
        reference = self._pending.pop(number, None)
        result = reference and reference()
        if result is None:  # nobody wants it
            message.release()
            return
        kept = memoryview(message.tobytes())[NUMBER.size :]
        result.settle(Message(kept, message.buffers, []))

    def _end(self) -> None:
        error = self._session.gone()
        pending, self._pending = self._pending, {}
        for reference in pending.values():
            result = reference()
            if result is not None:
                result.settle(error)
        self._waiters.wake()

    def decode(self, reply: Message | ConnectionClosed) -> tuple[str, Any]:
        """How a call ended."""
        if isinstance(reply, ConnectionClosed):
            return "#ERROR", reply
        try:
            kind, result = packet.loads(reply)
        except Exception as error:  # it came, and does not unpickle here
            return "#ERROR", error
        if kind == "#PROXY":
            return "#RETURN", proxy_of(self._session, *result)
        return kind, result


class AsyncBaseProxy:
    """A managed object of which every method returns an ``AsyncProxyResult`` at once.

    Calls of one proxy are made one after the other, in their order; those of different proxies side
    by side, of different managers in different processes.  The object goes with its last proxy.  If
    it could not be made, its calls raise what went wrong.
    """

    def __init__(self, address: ManagerAddress, typeid: str, pipeline: Pipeline) -> None:
        self._address = address
        self._typeid = typeid
        self._pipeline = pipeline

    @classmethod
    def create(cls, address: ManagerAddress, typeid: str, args: Any, kwds: Any) -> Self:
        """A proxy of a new object."""
        return cls(address, typeid, Pipeline(address, "create", (typeid, *args), kwds))

    @classmethod
    def attach(cls, token: Token) -> Self:
        """A proxy of an object that is there."""
        address: Any = token.address
        return cls(address, token.typeid, Pipeline(address, "attach", (token.id,), {}))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

        def method(*args: Any, **kwds: Any) -> AsyncProxyResult:
            return self._callmethod(name, args, kwds)

        method.__name__ = name
        return method

    def _callmethod(
        self, methodname: str, args: tuple[Any, ...] = (), kwds: dict[str, Any] | None = None
    ) -> AsyncProxyResult:
        """Call any exposed method, such as ``__getitem__``."""
        return self._pipeline.call(methodname, args, kwds or {})

    def _getvalue(self) -> AsyncProxyResult:
        """A copy of the object."""
        return self._callmethod("#GETVALUE")

    def __reduce__(self) -> tuple[Any, ...]:
        ident, _ = self._pipeline.made.get()
        return _attached, (type(self), Token(self._typeid, self._address, ident))

    def __repr__(self) -> str:
        return f"<{type(self).__name__} object, typeid {self._typeid!r}, of {self._address.server}>"


def _attached(kind: type[AsyncBaseProxy], token: Token) -> AsyncBaseProxy:
    return kind.attach(token)
