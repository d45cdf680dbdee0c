"""Access of this process to its hub, and by streams through it to other hubs.

The hub lives in the agent of its host.  The processes that the agent starts are told its address
and key when they are born.  A stream blocks, and is for one thread at a time.
"""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

from fiber._hub import protocol
from fiber._hub.local import QuietSocket, without_timeout
from fiber._hub.protocol import HEAD, ONE, SECRETS, Doorbell, HubAddress, Op, Status
from fiber._hub.registry import Registry
from fiber._transport.channels import naming_the_limit, wait_readable
from fiber._wire import packet
from fiber._wire.descriptor import Descriptor
from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import Message
from fiber.errors import ConnectionClosed, FiberError

_FORMS = {form.size: form for form in (HEAD, ONE, SECRETS)}


class NoHub(FiberError, OSError):
    """A handle has to leave this process and no hub is there to keep what it stands for."""


class ObjectUnreachable(ConnectionClosed):
    """An object of some hub that cannot be used any more, or never could; says why."""

    def __init__(self, host: str, reason: str) -> None:
        EOFError.__init__(self, f"what is kept on host {host!r} cannot be used: {reason}")
        self.peer = f"host {host!r}"
        self.reason = reason


# The hub of this process


class LocalHub(Protocol):
    """A hub that lives in this process."""

    host: str
    key: bytes
    registry: Registry
    doorbell: Doorbell

    @property
    def address(self) -> HubAddress:
        """Address of the hub for other processes of this host; NoHub if they cannot reach it."""

    @property
    def known_address(self) -> HubAddress | None:
        """The same, if anybody was told yet."""

    def dial(self) -> socket.socket:
        """A stream to it."""

    def fetch(self, grant: bytes) -> list[Descriptor]:
        """The descriptors of an object that it keeps."""

    def on_loop(self) -> bool:
        """Tell whether the caller runs on the thread that serves the hub."""


def set_hub_address(address: HubAddress) -> None:
    """Note the address of this host's hub, which another process has."""
    global _address, _local_hub
    _address, _local_hub = address, None


def set_local_hub(hub: LocalHub | None) -> None:
    """Note that this process has the hub of its host; None: it has ended."""
    global _local_hub
    _local_hub = hub


def set_hub_starter(starter: Callable[[], object]) -> None:
    """Set the function that makes a runtime with a hub, for a program that needs one."""
    global _starter
    _starter = starter


def local_hub() -> LocalHub | None:
    """The hub, if it lives in this process; made now if this process is to have one."""
    if _local_hub is None and _address is None:
        if _starter is None:
            raise NoHub(
                "what processes share (a pipe, queue, lock, value and so on) cannot leave this "
                "process: nothing of Fiber runs here that could keep it for the other side. Start "
                "a process or pool first."
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
    """The name of this host."""
    hub = local_hub()
    if hub is not None:
        return hub.host
    assert _address is not None
    return _address.host


def inherited_address() -> HubAddress | None:
    """The hub's address, if this process was told it when it was born."""
    return _address


def _refuse_on_loop() -> None:
    """RuntimeError on the thread that would have to carry the answer."""
    if _local_hub is not None and _local_hub.on_loop():
        raise RuntimeError(
            "an object of another host is used in a callback on Fiber's own thread, which would "
            "wait for itself for ever: use it on a thread of the program"
        )


def _after_fork() -> None:
    """Reach the hub as another process, after a fork without Fiber: the copy does not have it."""
    global _local_hub, _address
    if _local_hub is not None:
        _address, _local_hub = _local_hub.known_address, None


_address: HubAddress | None = None
_local_hub: LocalHub | None = None
_starter: Callable[[], object] | None = None
os.register_at_fork(after_in_child=_after_fork)


# Streams


class Reply:
    """Answer of a hub."""

    __slots__ = ("fds", "number", "parts", "status", "values")

    def __init__(self, message: Message) -> None:
        _, self.number, *self.values = _FORMS[len(message.payload)].unpack(message.payload)
        self.status = Status(message.payload[0])
        self.parts = message.buffers
        self.fds, message.fds = message.fds, []

    def close_descriptors(self) -> None:
        """Close the descriptors of the answer, which are not wanted."""
        for fd in self.fds:
            os.close(fd)


class HubStream:
    """A stream to the hub that has ``home``'s objects.  Opening one waits for nothing."""

    def __init__(self, home: HubAddress, greeting: Iterable[bytes] = ()) -> None:
        self._host = home.host
        self._number = 0
        self._asked = 0
        """The number of the last request that has an answer."""
        self._unsettled: Op | None = None
        self._begun: int | None = None
        """The number of a request whose answer nobody has read."""
        self._end = "its hub is gone"
        self._sock, to_its_hub = _dial(home)
        try:
            for part in (*to_its_hub, protocol.hello(home.key), *greeting):
                packet.send(self._sock, part)
        except BrokenPipeError:
            pass  # the first request will find out why
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
        """Make a request and wait for its answer; NO once ``timeout`` seconds are over."""
        _refuse_on_loop()
        number = self._asked = self._next()
        self._unsettled = operation
        try:
            self._send(form.pack(operation, number, *values), buffers, fds)
            reply = self._reply(number, timeout)
        except ObjectUnreachable:
            raise
        except BaseException:
            # Ctrl-C, or what another signal's handler raised.
            self.give_up(operation)
            raise
        self._unsettled = None
        return reply

    def begin(self, operation: Op, buffers: Sequence[memoryview]) -> None:
        """Make a request and leave its answer for ``finish``."""
        _refuse_on_loop()
        number = self._next()
        self._send(HEAD.pack(operation, number), buffers)
        self._begun = number

    def finish(self) -> Reply | None:
        """The answer to what was begun; None if nothing was."""
        number, self._begun = self._begun, None  # an answer that Ctrl-C interrupts is not repeated
        return None if number is None else self._reply(number, None)

    def give_up(self, operation: Op) -> None:
        """Give up the answer to the last request, which was this operation.

        What it waits for should not be taken for us; what was, ``settle`` finds, and the hub takes
        back a token.
        """
        self._unsettled = operation
        self._send(ONE.pack(Op.SYNC, self._next(), self._asked))

    def settle(self) -> tuple[Op, Reply] | None:
        """The answer to a request that was given up, if it was answered all the same."""
        operation = self._unsettled
        if operation is None:
            return None
        number = self._next()
        self._send(ONE.pack(Op.SYNC, number, self._asked))
        late = None
        while (reply := self.receive()).number != number:
            if reply.status is Status.OK and reply.number == self._asked:
                late = reply
        self._unsettled = None
        return (operation, late) if late is not None else None

    def say(self, operation: Op, *values: int | bytes, form: struct.Struct = HEAD) -> None:
        """Make a request that has no answer."""
        self._send(form.pack(operation, self._next(), *values))

    def receive(self) -> Reply:
        """Receive the next message; ObjectUnreachable with the hub's reason at the end."""
        try:
            message = packet.receive(self._sock, descriptors=True)
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
        """True if the last request was answered."""
        return self._asked > 0 and self._unsettled is None

    def fileno(self) -> int:
        """The stream's descriptor."""
        return self._sock.fileno()

    def close(self) -> None:
        """End it."""
        self._sock.close()

    def _next(self) -> int:
        self._number = (self._number + 1) & 0xFFFFFFFF
        return self._number

    def _reply(self, number: int, timeout: float | None) -> Reply:
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            if deadline is not None and not self._comes_by(deadline):
                self._send(HEAD.pack(Op.CANCEL, number))
                deadline = None  # now there will be an answer, whichever
            reply = self.receive()
            if reply.number == number:
                return reply
            reply.close_descriptors()

    def _comes_by(self, deadline: float) -> bool:
        return wait_readable(self._sock.fileno(), deadline - time.monotonic())

    def _send(
        self, payload: BytesLike, buffers: Sequence[memoryview] = (), fds: Sequence[int] = ()
    ) -> None:
        try:
            packet.send(self._sock, payload, buffers, fds)
        except BrokenPipeError:
            while True:  # what the hub said before it closed says why, in the end
                self.receive()


def _dial(home: HubAddress) -> tuple[socket.socket, Sequence[bytes]]:
    """A socket towards ``home``, and what to say before greeting it."""
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
        reason = f"nobody serves {to.path}, so its program has ended"
        raise ObjectUnreachable(to.host, reason) from error
    return sock
