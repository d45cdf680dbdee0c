"""Channels and counters of another host: every operation is a request to the hub there.

An operation has a stream for itself, so that threads which wait do not wait for each other.  There
are as many streams as threads ever used the object at once.
"""

from __future__ import annotations

import os
import pickle
import struct
import weakref
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, TypeAlias

from fiber._hub.client import HubStream, ObjectUnreachable, Reply
from fiber._hub.protocol import (
    HEAD,
    NO_SECRET,
    ONE,
    SECRET,
    SECRET_BYTES,
    SECRETS,
    Extent,
    HubAddress,
    ObjectKind,
    Op,
    Status,
)
from fiber._transport.channels import Claimant, wait_readable
from fiber._wire import packet
from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import Message
from fiber.errors import ConnectionClosed

Taken: TypeAlias = "list[weakref.ref[RemoteObject]]"
"""Objects of other hosts that something unpickled has brought here."""

_taken: Taken | None = None


def loads(data: BytesLike, buffers: Iterable[BytesLike]) -> tuple[Any, Taken]:
    """Unpickle; and what was taken with it, for ``confirm``."""
    global _taken
    taken: Taken = []
    before, _taken = _taken, taken
    try:
        return pickle.loads(data, buffers=buffers), taken
    finally:
        _taken = before


def confirm(taken: Taken) -> None:
    """Returns once the hubs of those that are still here know that they are: whoever learns of it
    then may take back what it granted.
    """
    for reference in taken:
        remote = reference()
        if remote is not None:
            remote.confirm()


class RemoteObject:
    """An object that lives elsewhere, and stays there as long as this is open.

    No lock: whatever interrupts a thread here, a finalizer or a signal's handler, may use the same
    object.  A stream is for whoever has taken it out of the idle ones.  The object holds them all:
    who is interrupted with one in hand loses the use of that one, and not the last hold on what the
    hub keeps for us.
    """

    def __init__(self, home: HubAddress, grant: bytes, identity: bytes = NO_SECRET) -> None:
        self.home = home
        self.identity = identity
        self.token = os.urandom(SECRET_BYTES)
        """Proves to the hub that it uses the object."""
        self._pid = os.getpid()
        self._closed = False
        self._streams: list[HubStream] = []
        # Opened at once, so that the grant is used up, but without waiting: whoever unpickles this
        # may be the very thread that carries the answer.  An error shows at the first request.
        self._idle = deque([self._open(grant)])
        if _taken is not None:
            _taken.append(weakref.ref(self))

    def confirm(self) -> None:
        """Returns once its hub knows that it is used, or cannot be asked."""
        if not any(stream.has_answered for stream in tuple(self._streams)):
            with suppress(OSError, ObjectUnreachable), self.stream() as stream:
                stream.ask(Op.SYNC, 0, form=ONE)

    def known(self) -> bytes:
        """Return the token, once the hub knows it: other streams may name it."""
        self._check()
        self.confirm()
        return self.token

    @contextmanager
    def stream(self) -> Iterator[HubStream]:
        """A stream to the object's hub that nobody else uses."""
        with self._take(self._idle) as stream:
            late = stream.settle()
            if late is not None:
                self._settled(*late)
            yield stream

    def close(self) -> None:
        """Let go of the object."""
        self._closed = True
        _close_all(self._idle)
        self._streams.clear()

    def __del__(self) -> None:
        if hasattr(self, "_idle"):  # otherwise its first stream could not be opened
            self.close()

    def _open(self, grant: bytes = NO_SECRET) -> HubStream:
        stream = HubStream(self.home, [SECRETS.pack(Op.ATTACH, 0, self.token, grant)])
        self._streams.append(stream)
        return stream

    def _pop(self, idle: deque[HubStream]) -> HubStream:
        """A stream that nobody else uses, until it is put back."""
        self._check()
        try:
            return idle.pop()
        except IndexError:
            return self._open()

    @contextmanager
    def _take(self, idle: deque[HubStream]) -> Iterator[HubStream]:
        stream = self._pop(idle)
        try:
            yield stream
        finally:
            idle.append(stream)
            if self._closed:  # in the meantime
                _close_all(idle)
                self._streams.clear()

    def _check(self) -> None:
        if self._closed:
            raise OSError("handle is closed")
        if self._pid != os.getpid():
            self._forked()

    def _forked(self) -> None:
        """Someone else forked us: the streams are our parent's, which keeps the object there."""
        self._pid = os.getpid()
        self._idle.clear()
        self._streams.clear()

    def _settled(self, operation: Op, reply: Reply) -> None:
        """A request that was given up (Ctrl-C) had been granted by then."""


class RemoteChannel(RemoteObject):
    """End of a message pipe on another host; a ``SharedChannel``."""

    can_try_send = False

    def __init__(self, home: HubAddress, grant: bytes, identity: bytes = NO_SECRET) -> None:
        self._late: deque[Reply] = deque()
        # One; more once threads have asked for a descriptor at the same moment.
        self._watching: deque[HubStream] = deque()
        self._unconfirmed: deque[HubStream] = deque()
        super().__init__(home, grant, identity)

    def send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message; returns when it can be received."""
        if self._unconfirmed:  # on streams of their own: they must not be overtaken
            self.send_unconfirmed(payload, buffers)
            self._confirm()
            return
        with _naming_the_end(), self.stream() as stream:
            _check_sent(stream.ask(Op.SEND, buffers=[memoryview(payload), *buffers]))

    def send_unconfirmed(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message and return at once.

        The next one finds out first whether it could be sent, and raises what ``send`` would have.
        """
        with _naming_the_end(), self._take(self._unconfirmed) as stream:
            _check_sent(stream.finish())
            stream.begin(Op.SEND, [memoryview(payload), *buffers])

    def _confirm(self) -> None:
        with _naming_the_end(), self._take(self._unconfirmed) as stream:
            _check_sent(stream.finish())

    def post(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """The same: a channel of another host takes a message when its hub has it."""
        self.send(payload, buffers)

    def try_send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Never: to find out takes as long as to send."""
        return False

    def recv(self, *, passing: bool = False) -> Message:
        """The next message; EOFError at the end."""
        message = self._receive(Op.RECV)
        assert message is not None
        return message

    def recv_object(self) -> Any:
        """The next message, unpickled."""
        return packet.loads(self.recv())

    def try_recv(self) -> Message | None:
        """The next message if one is there; EOFError at the end."""
        return self._receive(Op.TRY_RECV)

    def recv_counting(self, counter: RemoteCounter, *, wait: bool) -> Message | None:
        """Receive a message, for which the hub raises ``counter``; None if there is none."""
        return self._receive(Op.DRAW if wait else Op.TRY_DRAW, counter.known(), form=SECRET)

    def _receive(self, operation: Op, *values: bytes, form: struct.Struct = HEAD) -> Message | None:
        with self.stream() as stream:
            reply = (
                self._late.popleft() if self._late else stream.ask(operation, *values, form=form)
            )
        if reply.status is Status.EOF:
            raise ConnectionClosed()
        if reply.status is Status.NO:
            return None
        (more,) = reply.values
        if not more:
            self._watch_again()
        return Message(reply.parts[0], reply.parts[1:], [])

    def poll(self, timeout: float | None) -> bool:
        """Wait until ``recv`` would return or raise at once; False after ``timeout`` seconds."""
        with self.stream() as stream:
            return bool(self._late) or stream.ask(Op.POLL, timeout=timeout).status is Status.OK

    def fileno(self) -> int:
        """A descriptor that is readable if, at this moment, there is something to receive.

        It becomes so when there is.  It may stay so for too long if another holder receives it:
        ask again for the truth.
        """
        with self._take(self._watching) as watching:
            if watching.ask(Op.CHECK).status is Status.OK:
                wait_readable(watching.fileno(), None)
            return watching.fileno()

    def close(self) -> None:
        """Let go of this end."""
        super().close()
        _close_all(self._watching)
        _close_all(self._unconfirmed)

    def _watch_again(self) -> None:
        """The descriptor says that there is something, and there is not."""
        for _ in range(len(self._watching)):
            with self._take(self._watching) as watching:
                while wait_readable(watching.fileno(), 0):
                    watching.receive()
                watching.say(Op.WATCH)
            self._watching.rotate()

    def _forked(self) -> None:
        super()._forked()
        self._watching.clear()
        self._unconfirmed.clear()

    def _settled(self, operation: Op, reply: Reply) -> None:
        if reply.parts:
            self._late.append(reply)


class RemoteEnd(RemoteChannel):
    """An end of a one-way channel on another host, and what a handle needs to rebuild it there."""

    def __init__(
        self,
        kind: ObjectKind,
        extent: Extent,
        home: HubAddress,
        grant: bytes,
        identity: bytes = NO_SECRET,
    ) -> None:
        self.kind = kind
        self.extent = extent
        super().__init__(home, grant, identity)


class RemoteCounter(RemoteObject):
    """A counting event on another host; a ``SharedCounter``."""

    def add(self, n: int = 1) -> None:
        """Raise the count; returns when it is done."""
        with self.stream() as stream:
            stream.ask(Op.ADD, n, form=ONE)

    def take(self, timeout: float | None, taken: list[Any] | None = None) -> bool:
        """Lower the count by one once it is above zero; False when ``timeout`` is over."""
        with self.stream() as stream:
            if stream.ask(Op.TAKE, timeout=timeout).status is not Status.OK:
                return False
            if taken is not None:
                taken.append(1)
            return True

    def claim(self, timeout: float | None, taken: list[Any], claims: Claimant) -> bool:
        """Take one as ``take`` does.  The hub takes it back if this process dies before."""
        with self.stream() as stream:
            if stream.ask(Op.CLAIM, timeout=timeout).status is not Status.OK:
                return False
            taken.append(1)
            claims.add()
            stream.say(Op.KEEP)
            return True

    def clear(self) -> int:
        """Set the count to zero and say what it was."""
        with self.stream() as stream:
            count: int = stream.ask(Op.CLEAR).values[0]
        return count

    def value(self) -> int:
        """The count now."""
        with self.stream() as stream:
            count: int = stream.ask(Op.VALUE).values[0]
        return count

    def wait(self, timeout: float | None) -> bool:
        """Wait until the count is above zero, without lowering it."""
        with self.stream() as stream:
            return stream.ask(Op.WAIT, timeout=timeout).status is Status.OK

    def changed(self, since: int, timeout: float | None) -> bool:
        """Wait until the count is not ``since``; False when ``timeout`` is over."""
        with self.stream() as stream:
            reply = stream.ask(Op.CHANGED, since, form=ONE, timeout=timeout)
            return reply.status is Status.OK

    def _settled(self, operation: Op, reply: Reply) -> None:
        if operation is Op.TAKE:
            self.add(1)


@contextmanager
def _naming_the_end() -> Iterator[None]:
    try:
        yield
    except ObjectUnreachable as error:
        raise BrokenPipeError(str(error)) from error


def _check_sent(reply: Reply | None) -> None:
    if reply is not None and reply.status is Status.BROKEN:
        raise BrokenPipeError("the other end is closed")


def _close_all(streams: deque[HubStream]) -> None:
    while streams:
        with suppress(IndexError):  # someone else has closed the last one
            streams.pop().close()
