"""``Connection``, ``Pipe`` and ``wait`` as in multiprocessing, over message channels.

``Listener``, ``Client`` and their constants, ``families`` or ``CHALLENGE`` for instance, are
multiprocessing's objects, since they connect to other programs.  With an ``authkey`` both sides
prove that they know it, or get an AuthenticationError.

A message arrives whole.  Large contiguous buffers (NumPy arrays) are not copied into the pickle.
"""

from __future__ import annotations

import pickle
import weakref
from collections.abc import Callable
from multiprocessing import AuthenticationError
from multiprocessing import connection as _mp
from multiprocessing.connection import Client, Listener, answer_challenge, deliver_challenge
from typing import TYPE_CHECKING, Any, Generic, Self, TypeAlias, overload

from fiber import reduction
from fiber._hub import handles, one_way
from fiber._transport.channels import Channel, UnixChannel
from fiber._wire import packet
from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import Message
from fiber.errors import BufferTooShort, ConnectionClosed

if TYPE_CHECKING:
    from collections.abc import Iterable
    from socket import socket
    from types import TracebackType

    from typing_extensions import TypeVar

    # What is sent and received, if an annotation says so: ``Connection[Task, Answer]``.
    _Sent_contra = TypeVar("_Sent_contra", contravariant=True, default=Any)
    _Received_co = TypeVar("_Received_co", covariant=True, default=Any)
else:
    from multiprocessing.connection import wait
    from typing import TypeVar  # without a default before Python 3.13

    _Sent_contra = TypeVar("_Sent_contra", contravariant=True)
    _Received_co = TypeVar("_Received_co", covariant=True)

__all__ = [
    "AuthenticationError",
    "Client",
    "Connection",
    "Listener",
    "Pipe",
    "answer_challenge",
    "deliver_challenge",
    "wait",
]


if TYPE_CHECKING:
    _Waitable: TypeAlias = "Connection[Any, Any] | _mp.Connection[Any, Any] | socket | int"

    @overload
    def wait(
        object_list: Iterable[Connection[_Sent_contra, _Received_co]], timeout: float | None = None
    ) -> list[Connection[_Sent_contra, _Received_co]]: ...

    @overload
    def wait(object_list: Iterable[_Waitable], timeout: float | None = None) -> list[_Waitable]: ...

    def wait(object_list: Iterable[Any], timeout: float | None = None) -> list[Any]:
        """Wait as in multiprocessing, whose types know only its connections."""

else:  # a type checker would accept any name

    def __getattr__(name: str) -> object:
        if name not in vars(_mp):
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return vars(_mp)[name]


_LAST_MOMENT = 0.05
"""Seconds, at most, from the end of a connection to the end of its holder's process."""

_NEWS = 2.0
"""Seconds that the report of an end may take on a busy machine."""

_PF_EXITING = 0x4
"""Bit of the flags in /proc/PID/stat, from Linux's ``include/linux/sched.h``."""


class Connection(Generic[_Sent_contra, _Received_co]):
    """End of a pipe.  EOFError when the last holder of the other end has closed it or died."""

    def __init__(self, channel: Channel, readable: bool = True, writable: bool = True) -> None:
        if isinstance(channel, int):
            raise TypeError(
                f"a fiber Connection is made by Pipe(), not from descriptor {channel}: "
                "for that use multiprocessing.connection.Connection"
            )
        self._channel: Channel | None = channel
        self._readable = readable
        self._writable = writable
        self._given_to: list[weakref.ref[Any]] = []
        self._other_given_to: list[weakref.ref[Any]] = []

    # Sending

    def send(self, obj: _Sent_contra) -> None:
        """Send a picklable object."""
        channel = self._channel
        if channel is None or not self._writable:
            raise self._misuse("read-only")
        channel.send(*_encoded(obj))

    def _send_unconfirmed(self, obj: Any) -> None:
        """Send without waiting until a large object has arrived at another host."""
        channel = self._channel
        if channel is None or not self._writable:
            raise self._misuse("read-only")
        channel.send_unconfirmed(*_encoded(obj))

    def _exchange(self, obj: Any) -> Callable[[], Message]:
        """Pickle an object; return a function that sends it, and returns the next message.

        The message is not unpickled.  Between hosts that takes one request, where ``send`` and
        ``recv`` take two.
        """
        channel = self._channel
        if channel is None or not (self._readable and self._writable):
            raise self._misuse("one-way")
        encoded = _encoded(obj)

        def exchange() -> Message:
            try:
                return channel.exchange(*encoded, soon=True)
            except ConnectionClosed as error:
                raise self._explained(error) from None

        return exchange

    def send_bytes(self, buf: BytesLike, offset: int = 0, size: int | None = None) -> None:
        """Send bytes as one message."""
        channel = self._channel
        if channel is None or not self._writable:
            raise self._misuse("read-only")
        view = memoryview(buf)
        if view.itemsize > 1 or view.ndim != 1:
            view = view.cast("B")
        _check_window(len(view), offset, size)
        channel.send(view[offset:] if size is None else view[offset : offset + size])

    # Receiving

    def recv(self) -> _Received_co:
        """Return the next object; wait until there is one."""
        channel = self._channel
        if channel is None or not self._readable:
            raise self._misuse("write-only")
        try:
            received: _Received_co = channel.recv_object()
            return received
        except ConnectionClosed as error:
            raise self._explained(error) from None

    def _recv_pickled(self) -> Message:
        """Return the next object, not unpickled.

        The caller soon copies or drops it.  So large arrays may stay in the memory of the sender.
        """
        if self._channel is None:
            raise self._misuse()
        return self._channel.recv(passing=True)

    def recv_bytes(self, maxlength: int | None = None) -> bytes:
        """Return the next message as bytes.

        If it is longer than ``maxlength``, close the connection and raise OSError.
        """
        if maxlength is not None and maxlength < 0:
            raise ValueError("negative maxlength")
        data = _as_bytes(self._receive())
        if maxlength is not None and len(data) > maxlength:
            self.close()
            raise OSError("bad message length")
        return data

    def recv_bytes_into(self, buf: Any, offset: int = 0) -> int:
        """Write the next message into ``buf`` and return its length.

        BufferTooShort, which has the whole message, if it does not fit.
        """
        view = memoryview(buf)
        room = view.itemsize * len(view)
        if offset < 0:
            raise ValueError("negative offset")
        if offset > room:
            raise ValueError("offset too large")
        data = _as_bytes(self._receive())
        if len(data) > room - offset:
            raise BufferTooShort(data)
        view.cast("B")[offset : offset + len(data)] = data
        return len(data)

    def poll(self, timeout: float | None = 0.0) -> bool:
        """Tell whether ``recv`` would return or raise at once, after up to ``timeout`` seconds."""
        channel = self._channel
        if channel is None or not self._readable:
            raise self._misuse("write-only")
        return channel.poll(timeout)

    def _receive(self) -> Message:
        channel = self._channel
        if channel is None or not self._readable:
            raise self._misuse("write-only")
        try:
            return channel.recv()
        except ConnectionClosed as error:
            raise self._explained(error) from None

    def _explained(self, error: ConnectionClosed) -> ConnectionClosed:
        """Return the error, with the reason for the end of the other end's process."""
        if error.reason:
            return error
        for reference in reversed(self._other_given_to):
            process = reference()
            reason = how_it_ended(process)
            if reason is not None:
                return ConnectionClosed(process.name, reason)
        return error

    # State

    def fileno(self) -> int:
        """Return a descriptor that is readable when a message can be received."""
        if self._channel is None:
            raise self._misuse()
        return self._channel.fileno()

    def close(self) -> None:
        """Close this end."""
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()

    @property
    def closed(self) -> bool:
        """True if this end was closed."""
        return self._channel is None

    @property
    def readable(self) -> bool:
        """True if this end can receive."""
        return self._readable

    @property
    def writable(self) -> bool:
        """True if this end can send."""
        return self._writable

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __del__(self) -> None:
        if getattr(self, "_channel", None) is not None:
            self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        if self._channel is None:
            raise self._misuse()
        spawning = reduction.spawning()
        process = getattr(spawning, "process", None)
        if process is not None:
            self._given_to.append(weakref.ref(process))
        return _rebuild, (handles.handle_for(self._channel), self._readable, self._writable)

    def _misuse(self, wrong_way: str = "") -> OSError:
        if self._channel is None:
            return OSError("handle is closed")
        return OSError(f"connection is {wrong_way}")


def _rebuild(handle: handles.Handle, readable: bool, writable: bool) -> Connection:
    return Connection(handles.channel(handle), readable, writable)


def Pipe(duplex: bool = True) -> tuple[Connection, Connection]:
    """Return two connected ends.

    Without ``duplex`` the first end only receives and the second only sends.
    """
    one, other = UnixChannel.pair() if duplex else one_way.pair()
    first = Connection(one, writable=duplex)
    second = Connection(other, readable=duplex)
    first._other_given_to, second._other_given_to = second._given_to, first._given_to
    return first, second


def how_it_ended(process: Any) -> str | None:
    """Return how a child ended that held an end of a connection; None if it still runs."""
    popen = getattr(process, "_popen", None)
    if popen is None:
        return None
    # The report of a death follows moments after the kernel has closed the process's descriptors.
    # The pid of a process on another host means nothing here, so it is not looked at.
    if popen.wait(_LAST_MOMENT) is None and (not popen.same_pids or _is_exiting(popen.pid)):
        popen.wait(_NEWS)
    return None if popen.report is None else popen.report.describe()


def _is_exiting(pid: int | None) -> bool:
    """Return whether a process of this host is gone, a zombie, or inside the kernel's exit.

    The kernel sets PF_EXITING before it closes the descriptors of a process.  On a busy machine the
    process becomes a zombie long after that.
    """
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            # The name before these fields may contain any character.
            fields = file.read().rpartition(b")")[2].split()
    except OSError:
        return True
    state, flags = fields[0], int(fields[6])
    return state in (b"Z", b"X") or bool(flags & _PF_EXITING)


def _as_bytes(message: Message) -> bytes:
    if not message.buffers:
        return message.tobytes()
    # The sender used ``send``.  A reader of bytes expects one pickle.
    return pickle.dumps(packet.loads(message), protocol=5)


def _encoded(obj: Any) -> tuple[bytes, list[memoryview]]:
    try:
        return reduction.encode(obj)
    except reduction.REFUSALS as error:
        raise reduction.blame({"the object to send": obj}, error) from error


def _check_window(length: int, offset: int, size: int | None) -> None:
    if offset < 0:
        raise ValueError("offset is negative")
    if length < offset:
        raise ValueError("buffer length < offset")
    if size is not None:
        if size < 0:
            raise ValueError("size is negative")
        if offset + size > length:
            raise ValueError("buffer length < offset + size")
