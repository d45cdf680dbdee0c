"""A process's side of its streams to hubs: blocking, and for one thread at a time."""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Iterable, Sequence

from fiber._hub import access, protocol
from fiber._hub.access import Access
from fiber._hub.local import QuietSocket, blocking
from fiber._hub.protocol import HEAD, ONE, TWO, Op, Status
from fiber._transport.unix import naming_the_limit, wait_readable
from fiber._wire import packet
from fiber._wire.packet import BytesLike, Message
from fiber.errors import ConnectionClosed

_FORMS = {form.size: form for form in (HEAD, ONE, TWO)}


class Unreachable(ConnectionClosed):
    """An object of some hub that cannot be used any more, or never could; says why."""

    def __init__(self, host: str, reason: str) -> None:
        EOFError.__init__(self, f"what is kept on host {host!r} cannot be used: {reason}")
        self.peer = f"host {host!r}"
        self.reason = reason


class Reply:
    """What a hub answered."""

    __slots__ = ("fds", "number", "parts", "status", "values")

    def __init__(self, message: Message) -> None:
        fields: tuple[int, ...] = _FORMS[len(message.payload)].unpack(message.payload)
        self.number, self.values = fields[1], fields[2:]
        self.status = Status(message.payload[0])
        self.parts = message.buffers
        self.fds, message.fds = message.fds, []

    def close_descriptors(self) -> None:
        """Nobody wants them."""
        for fd in self.fds:
            os.close(fd)


class Line:
    """A stream to the hub that has ``home``'s objects.  Opening one waits for nothing."""

    def __init__(self, home: Access, greeting: Iterable[bytes] = ()) -> None:
        self._host = home.host
        self._number = 0
        self._unsettled: Op | None = None
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
        *values: int,
        form: struct.Struct = HEAD,
        timeout: float | None = None,
        buffers: Sequence[memoryview] = (),
        fds: Sequence[int] = (),
    ) -> Reply:
        """Make a request and wait for its answer; NO once ``timeout`` seconds are over."""
        access.refuse_on_loop()
        self._unsettled = operation
        number = self._next()
        try:
            self._send(form.pack(operation, number, *values), buffers, fds)
            reply = self._reply(number, timeout)
        except Unreachable:
            raise
        except BaseException:
            # Ctrl-C, or what another signal's handler raised.  What nobody waits for any more
            # should not be taken for us; what was, ``settle`` finds.
            self._send(HEAD.pack(Op.SYNC, self._next()))
            raise
        self._unsettled = None
        return reply

    def settle(self) -> tuple[Op, Reply] | None:
        """The answer to a request that was given up, if it was answered all the same."""
        operation = self._unsettled
        if operation is None:
            return None
        number = self._next()
        self._send(HEAD.pack(Op.SYNC, number))
        late = None
        while (reply := self.receive()).number != number:
            if reply.status is Status.OK and (reply.parts or operation is not Op.RECV):
                late = late or reply
        self._unsettled = None
        return (operation, late) if late is not None else None

    def say(self, operation: Op, *values: int, form: struct.Struct = HEAD) -> None:
        """Make a request that has no answer."""
        self._send(form.pack(operation, self._next(), *values))

    def receive(self) -> Reply:
        """What comes next, asked for or not; Unreachable with the hub's reason at the end."""
        try:
            message = packet.receive(self._sock, descriptors=True)
        except (EOFError, ConnectionError) as error:
            raise Unreachable(self._host, self._end) from error
        try:
            if message.payload[0] == Status.GONE:
                self._end = protocol.text(message.payload)
                raise Unreachable(self._host, self._end)
            return Reply(message)
        finally:
            message.close_descriptors()
            message.release()

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


def _dial(home: Access) -> tuple[socket.socket, Sequence[bytes]]:
    """A socket towards ``home``, and what to say before greeting it."""
    if home.host == access.host():
        return _connect(home), []
    hub = access.own_hub()
    if hub is not None:
        return hub.dial(), [protocol.hello(hub.key), protocol.connect(home.host)]
    own = access.current()
    return _connect(own), [protocol.hello(own.key), protocol.connect(home.host)]


def _connect(to: Access) -> socket.socket:
    with naming_the_limit("reaching the hub"):
        sock = blocking(QuietSocket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
    try:
        sock.connect(to.address)
    except OSError as error:
        sock.close()
        reason = f"nobody serves {to.address}, so its program has ended"
        raise Unreachable(to.host, reason) from error
    return sock
