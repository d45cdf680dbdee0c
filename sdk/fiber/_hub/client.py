"""Access of this process to its hub, and through it to other hubs.

The hub is a part of the agent of its host.  A process that the agent starts gets the hub's address
and key with its start message.  A process talks to hubs by streams.  A stream blocks, and is
for one thread at a time.
"""

from __future__ import annotations

import os
import socket
import struct
import time
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from fiber._hub import protocol
from fiber._hub.local import QuietSocket, without_timeout
from fiber._hub.protocol import HEAD, ONE, SECRETS, Doorbell, HubAddress, Op, Status
from fiber._hub.registry import Registry
from fiber._transport.channels import naming_the_limit, wait_readable
from fiber._unconfirmed import flush_all, unconfirmed
from fiber._wire import packet
from fiber._wire.descriptor import Descriptor
from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import Message
from fiber.errors import ConnectionClosed, FiberError

_WITHOUT_FLUSH = {
    Op.RECV, Op.GET_ITEM, Op.POLL, Op.CHECK, Op.SYNC, Op.VALUE, Op.CHANGED, Op.TOKENS, Op.SLEEP,
    Op.WAITERS, Op.HELD, Op.GET, Op.RETURN_TOKEN,
}  # fmt: skip
"""Requests that do not wait until earlier messages are confirmed.

They change nothing, or take a message that no sender has to wait for.  The caller of
``RETURN_TOKEN`` has waited.
"""

_FORMS = {form.size: form for form in (HEAD, ONE, SECRETS)}


class NoHub(FiberError, OSError):
    """Error: a handle cannot leave this process, because no hub can keep its object."""


class ObjectUnreachable(ConnectionClosed):
    """Error: an object at a hub cannot be used.  The text says why."""

    def __init__(self, host: str, reason: str) -> None:
        EOFError.__init__(self, f"an object on host {host!r} cannot be used: {reason}")
        self.peer = f"host {host!r}"
        self.reason = reason


# The hub of this process


class LocalHub(Protocol):
    """Hub in this process.

    ``Hub`` implements it.  This module stands below ``Hub`` and cannot import it.
    """

    host: str
    key: bytes
    registry: Registry
    doorbell: Doorbell

    @property
    def address(self) -> HubAddress:
        """Address of the hub for other processes of this host; NoHub if they cannot reach it."""

    @property
    def known_address(self) -> HubAddress | None:
        """Address of the hub if another process has it, else None."""

    def dial(self) -> socket.socket:
        """Return the socket of a new stream to this hub."""

    def fetch(self, grant: bytes) -> list[Descriptor]:
        """Return the descriptors of the object of a grant."""

    def on_loop(self) -> bool:
        """Tell whether the caller runs on the thread that serves the hub."""


def set_hub_address(address: HubAddress) -> None:
    """Set the address of this host's hub, which is in another process."""
    global _address, _local_hub
    _address, _local_hub = address, None


def set_local_hub(hub: LocalHub | None) -> None:
    """Set the hub of this host, which is in this process.  None: it has ended."""
    global _local_hub
    flush_all()
    _local_hub = hub


def set_hub_starter(starter: Callable[[], object]) -> None:
    """Set the function that starts a runtime with a hub when a program first needs one."""
    global _starter
    _starter = starter


def local_hub() -> LocalHub | None:
    """Return the hub if it is in this process, else None.  Start it in a new program."""
    if _local_hub is None and _address is None:
        if _starter is None:
            raise NoHub(
                "a pipe, queue, lock or other shared object cannot leave this process: no hub of "
                "Fiber runs here that could keep it for the receiver. Start a process or pool "
                "first."
            )
        _starter()
    return _local_hub


def hub_address() -> HubAddress:
    """Return the address of this host's hub for its processes; NoHub if they cannot reach it."""
    hub = local_hub()
    if hub is not None:
        return hub.address
    assert _address is not None
    if _address.problem:
        raise NoHub(_address.problem)
    return _address


def host() -> str:
    """Return the name of this host."""
    hub = local_hub()
    if hub is not None:
        return hub.host
    assert _address is not None
    return _address.host


def inherited_address() -> HubAddress | None:
    """Return the hub's address if this process got it at its start, else None."""
    return _address


def has_local_hub() -> bool:
    """Tell whether the hub is in this process."""
    return _local_hub is not None


def refuse_on_loop() -> None:
    """Raise RuntimeError on the loop thread, which would wait for itself."""
    if _local_hub is not None and _local_hub.on_loop():
        raise RuntimeError(
            "a callback on Fiber's event loop uses an object of another host: the loop would wait "
            "for itself for ever. Use the object on a thread of the program"
        )


def _after_fork() -> None:
    """Use the parent's hub from outside, after a fork that Fiber did not make.

    A copy of a stream's socket would keep the stream, and a lock that it keeps, when the parent
    dies.
    """
    global _local_hub, _address
    for stream in list(_streams):
        stream.close()
    if _local_hub is not None:
        _address, _local_hub = _local_hub.known_address, None


_address: HubAddress | None = None
_local_hub: LocalHub | None = None
_starter: Callable[[], object] | None = None
_streams: weakref.WeakSet[HubStream] = weakref.WeakSet()
os.register_at_fork(after_in_child=_after_fork)


# Streams


class Reply:
    """Reply of a hub."""

    __slots__ = ("fds", "number", "parts", "status", "values")

    def __init__(self, message: Message) -> None:
        _, self.number, *self.values = _FORMS[len(message.payload)].unpack(message.payload)
        self.status = Status(message.payload[0])
        self.parts = message.buffers
        self.fds, message.fds = message.fds, []


class HubStream:
    """Stream to the hub ``home``.  Opening one does not wait for the hub."""

    def __init__(self, home: HubAddress, greeting: Iterable[bytes] = ()) -> None:
        self._host = home.host
        self._number = 0
        self._asked = 0
        """Number of the last request that gets a reply."""
        self._unsettled = False
        """True while a reply is awaited or was given up."""
        self.has_acknowledged = False
        """True once the hub has replied to a request of ``send_request``."""
        self._end = "its hub is gone"
        self._sock, to_its_hub = _dial(home)
        _streams.add(self)
        try:
            for part in (*to_its_hub, protocol.hello(home.key), *greeting):
                packet.send(self._sock, part)
        except BrokenPipeError:
            pass  # the first request raises the reason
        except BaseException:
            self._sock.close()
            raise

    def ask(
        self,
        operation: Op,
        *values: int | bytes,
        form: struct.Struct = HEAD,
        timeout: float | None = None,
        buffers: Sequence[memoryview] = (),
        fds: Sequence[int] = (),
    ) -> Reply:
        """Send a request and wait for the reply; its status is NO after ``timeout`` seconds."""
        refuse_on_loop()
        if unconfirmed and operation not in _WITHOUT_FLUSH:
            flush_all()
        number = self._asked = self._next()
        self._unsettled = True
        try:
            self._send(form.pack(operation, number, *values), buffers, fds)
            reply = self._reply(number, timeout)
        except ObjectUnreachable:
            raise
        except BaseException:
            # Ctrl-C, or an error of another signal's handler.
            self.give_up()
            raise
        self._unsettled = False
        return reply

    def ask_on(self) -> Reply:
        """Wait for a further reply to the request of ``ask``."""
        return self._reply(self._asked, None)

    def send_request(self, request: bytes, buffers: Sequence[memoryview] = ()) -> None:
        """Send a request that the caller has numbered, and whose replies the caller reads."""
        refuse_on_loop()
        self._send(request, buffers)

    def give_up(self) -> None:
        """Give up the reply to the last request.

        The hub takes back a token that it gave this stream.  ``settle`` finds a reply that was sent
        all the same.
        """
        self._unsettled = True
        self._send(ONE.pack(Op.SYNC, self._next(), self._asked))

    def settle(self) -> Reply | None:
        """Return the reply to a request that was given up, if the hub replied all the same."""
        if not self._unsettled:
            return None
        number = self._next()
        self._send(ONE.pack(Op.SYNC, number, self._asked))
        late = None
        while (reply := self.receive()).number != number:
            if reply.status is Status.OK and reply.number == self._asked:
                late = reply
        self._unsettled = False
        return late

    def say(self, operation: Op, *values: int | bytes, form: struct.Struct = HEAD) -> None:
        """Send a request that has no reply."""
        self._send(form.pack(operation, self._next(), *values))

    def try_receive(self) -> Reply | None:
        """Receive the next reply, as ``receive`` does, if it is there."""
        try:
            return self.receive(wait=False)
        except BlockingIOError:
            return None

    def receive(self, *, wait: bool = True) -> Reply:
        """Receive the next reply; ObjectUnreachable with the hub's reason at the end."""
        try:
            message = packet.receive(self._sock, descriptors=True, wait=wait)
        except (EOFError, ConnectionError) as error:
            raise ObjectUnreachable(self._host, self._end) from error
        try:
            if message.payload[0] == Status.GONE:
                self._end = protocol.text(message.payload)
                raise ObjectUnreachable(self._host, self._end)
            return Reply(message)
        finally:
            message.close_descriptors()
            message.release()

    @property
    def has_answered(self) -> bool:
        """True if the hub replied to the last request, or to one of ``send_request``."""
        return self.has_acknowledged or (self._asked > 0 and not self._unsettled)

    def fileno(self) -> int:
        """Return the stream's descriptor."""
        return self._sock.fileno()

    def close(self) -> None:
        """Close the stream."""
        self._sock.close()

    def _next(self) -> int:
        self._number = (self._number + 1) & 0xFFFFFFFF
        return self._number

    def _reply(self, number: int, timeout: float | None) -> Reply:
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            if deadline is not None and not self._comes_by(deadline):
                self._send(HEAD.pack(Op.CANCEL, number))
                deadline = None  # from here on there is a reply for sure
            reply = self.receive()
            if reply.number == number:
                return reply

    def _comes_by(self, deadline: float) -> bool:
        return wait_readable(self._sock.fileno(), deadline - time.monotonic())

    def _send(
        self, payload: BytesLike, buffers: Sequence[memoryview] = (), fds: Sequence[int] = ()
    ) -> None:
        try:
            packet.send(self._sock, payload, buffers, fds)
        except BrokenPipeError:
            while True:  # the last reply before the end has the reason
                self.receive()


def _dial(home: HubAddress) -> tuple[socket.socket, Sequence[bytes]]:
    """Return a socket towards ``home``, and the messages before its greeting."""
    if home.host == host():
        return _connect(home), []
    hub = local_hub()
    if hub is not None:
        return hub.dial(), [protocol.hello(hub.key), protocol.connect(home.host)]
    own = hub_address()
    return _connect(own), [protocol.hello(own.key), protocol.connect(home.host)]


def _connect(to: HubAddress) -> socket.socket:
    with naming_the_limit("reaching the hub"):
        sock = without_timeout(QuietSocket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
    try:
        sock.connect(to.path)
    except OSError as error:
        sock.close()
        reason = f"no process listens at {to.path}, so its program has ended"
        raise ObjectUnreachable(to.host, reason) from error
    return sock
