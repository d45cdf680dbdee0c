"""Objects of other hosts: the base class, channels and counters.

Each operation is a request to the hub of that host.

Each operation uses a stream alone, so threads that wait do not block each other.  An object has as
many streams as threads have ever used it at the same time.
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
from fiber._hub.pipelined import LARGE, PipelinedSender
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
from fiber._unconfirmed import flush_all
from fiber._wire import bundle, packet
from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import Message
from fiber.errors import ConnectionClosed

Taken: TypeAlias = "list[weakref.ref[RemoteObject]]"
"""Objects of other hosts that an unpickling has made here."""

_taken: Taken | None = None


def loads(data: BytesLike, buffers: Iterable[BytesLike]) -> tuple[Any, Taken]:
    """Unpickle; return the object, and the objects of other hosts in it for ``confirm``."""
    global _taken
    taken: Taken = []
    before, _taken = _taken, taken
    try:
        return pickle.loads(data, buffers=buffers), taken
    finally:
        _taken = before


def confirm(taken: Taken) -> None:
    """Return when the hubs know of those objects that are still used here.

    From then on the process that pickled them may end its grants.
    """
    for reference in taken:
        remote = reference()
        if remote is not None:
            remote.confirm()


class RemoteObject:
    """Object of another host.  The hub there keeps it as long as this is open.

    There is no lock: a finalizer or a signal's handler may interrupt a thread here and use the same
    object.  A thread owns the stream that it has taken out of the idle ones.  The object keeps a
    list of all streams.  So a thread that is interrupted with a stream in hand loses only that
    stream, and the hub still keeps the object.
    """

    def __init__(self, home: HubAddress, grant: bytes, identity: bytes = NO_SECRET) -> None:
        self.home = home
        self.identity = identity
        self.token = os.urandom(SECRET_BYTES)
        """Secret by which the hub knows that this process uses the object."""
        self._pid = os.getpid()
        self._closed = False
        self._streams: list[HubStream] = []
        # Opened at once to use the grant, but without waiting: this may be the thread that would
        # have to carry the reply.  The first request raises an error of the hub.
        self._idle = deque([self._open(grant)])
        if _taken is not None:
            _taken.append(weakref.ref(self))

    def confirm(self) -> None:
        """Return when the hub knows that the object is used here, or cannot be reached."""
        if not any(stream.has_answered for stream in tuple(self._streams)):
            with suppress(OSError, ObjectUnreachable), self.stream() as stream:
                stream.ask(Op.SYNC, 0, form=ONE)

    def known(self) -> bytes:
        """Return the token after the hub knows it, so that other streams can use it."""
        self._check()
        self.confirm()
        return self.token

    @contextmanager
    def stream(self) -> Iterator[HubStream]:
        """Yield a stream to the object's hub that no other thread uses."""
        with self._take(self._idle) as stream:
            late = stream.settle()
            if late is not None:
                self._settled(late)
            yield stream

    def close(self) -> None:
        """Drop the object."""
        self._closed = True
        _close_all(self._idle)
        self._streams.clear()

    def __del__(self) -> None:
        if hasattr(self, "_idle"):  # missing if the first stream could not be opened
            self.close()

    def _open(self, grant: bytes = NO_SECRET) -> HubStream:
        stream = HubStream(self.home, [SECRETS.pack(Op.ATTACH, 0, self.token, grant)])
        self._streams.append(stream)
        return stream

    def _pop(self, idle: deque[HubStream]) -> HubStream:
        """Take a stream that no other thread uses.  The caller puts it back."""
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
        """Begin without streams in a forked process.  The parent's streams keep the object."""
        self._pid = os.getpid()
        self._idle.clear()
        self._streams.clear()

    def _settled(self, reply: Reply) -> None:
        """Handle the late reply to a request that was given up (Ctrl-C)."""


class RemoteChannel(RemoteObject):
    """End of a message pipe on another host; a ``SendingChannel`` and a ``ReceivingChannel``."""

    can_try_send = False

    def __init__(self, home: HubAddress, grant: bytes, identity: bytes = NO_SECRET) -> None:
        self._late: deque[Reply] = deque()
        # One stream; more if threads asked for a descriptor at the same moment.
        self._watching: deque[HubStream] = deque()
        # One; more for a moment if threads sent the first messages at the same time.
        self._pipelined: list[PipelinedSender] = []
        super().__init__(home, grant, identity)

    def send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message.  Wait until a large one is in the channel, and for room for small ones.

        BrokenPipeError if an earlier message did not arrive.
        """
        self._sender().send(payload, buffers, waits=packet.size_of(payload, buffers) > LARGE)

    def send_surely(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message; return when the channel has taken it."""
        self._sender().send(payload, buffers, waits=True)

    post = send

    def send_unconfirmed(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message as ``send`` does, but do not wait for a large one, either."""
        self._sender().send(payload, buffers)

    def send_within(self, payload: BytesLike, seconds: float) -> bool:
        """Send one message, if those before arrive within ``seconds``.

        What this process does later may overtake the message.
        """
        sender = self._sender()
        if not sender.taken_within(seconds):
            return False
        sender.send(payload, tracked=False)
        return True

    def all_taken_within(self, seconds: float) -> bool:
        """Return whether the channel takes all messages within ``seconds``."""
        return self._sender().taken_within(seconds)

    def _sender(self) -> PipelinedSender:
        self._check()
        if not self._pipelined:
            with _naming_the_end():
                stream = self._stream_for_sender()
                new = PipelinedSender(stream, hub_keeps=isinstance(self, RemoteEnd))
            self._pipelined.append(new)
            if self._pipelined[0] is not new:  # another thread was faster
                new.close()
        return self._pipelined[0]

    def _stream_for_sender(self) -> HubStream:
        try:
            stream = self._idle.pop()
        except IndexError:
            self.known()
            return self._open()
        late = stream.settle()
        if late is not None:
            self._settled(late)
        return stream

    def try_send_directly(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Return False: to find out whether there is room takes as long as to send."""
        return False

    def recv(self, *, passing: bool = False) -> Message:
        """Return the next message; ConnectionClosed at the end."""
        message = self._receive(Op.RECV)
        assert message is not None
        return message

    def exchange(
        self, payload: BytesLike, buffers: Sequence[memoryview] = (), *, soon: bool = False
    ) -> Message:
        """Send one message and return the next one, by one request.

        BrokenPipeError or ConnectionClosed at the end.  The message may have been sent or not.
        """
        message = self._receive(Op.EXCHANGE, buffers=[memoryview(payload), *buffers])
        assert message is not None
        return message

    def recv_object(self) -> Any:
        """Return the next message, unpickled."""
        return packet.loads(self.recv())

    def try_recv(self) -> Message | None:
        """Return the next message if there is one; ConnectionClosed at the end."""
        return self._receive(Op.RECV, timeout=0)

    def recv_counting(
        self, counter: RemoteCounter, claims: Claimant, *, wait: bool
    ) -> Message | None:
        """Receive a message, and have the hub raise ``counter``; None if there is no message.

        The hub raises it also if this process dies.
        """
        timeout = None if wait else 0
        return self._receive(Op.DRAW, counter.known(), form=SECRET, timeout=timeout)

    def recv_uncounting(self, counter: RemoteCounter, *, wait: bool) -> Message | None:
        """Receive a message, and have the hub lower ``counter``; None if there is no message."""
        timeout = None if wait else 0
        return self._receive(Op.GET_ITEM, counter.known(), form=SECRET, timeout=timeout)

    @contextmanager
    def put_items(self, items: Sequence[bytes], counter: RemoteCounter) -> Iterator[None]:
        """Send messages, and have the hub raise ``counter`` by their number.

        They are counted when the context begins, and can be received when it ends.
        """
        token = counter.known()
        with _naming_the_end(), self.stream() as stream:
            parts = [memoryview(bundle.pack(items))]
            reply = stream.ask(Op.PUT_ITEMS, token, form=SECRET, buffers=parts)
            yield
            if reply.status is Status.OK and not reply.values[0]:
                reply = stream.ask_on()
            _check_sent(reply)

    def _receive(
        self,
        operation: Op,
        *values: bytes,
        form: struct.Struct = HEAD,
        timeout: float | None = None,
        buffers: Sequence[memoryview] = (),
    ) -> Message | None:
        with self.stream() as stream:
            if self._late:
                if buffers:
                    self.send(buffers[0], buffers[1:])
                reply = self._late.popleft()
            else:
                reply = stream.ask(operation, *values, form=form, timeout=timeout, buffers=buffers)
        _check_sent(reply)
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
        """Return a descriptor that is readable if there is a message at this moment.

        It becomes readable when a message comes.  If another holder receives that message, it stays
        readable until the next call.
        """
        with self._take(self._watching) as watching:
            if watching.ask(Op.CHECK).status is Status.OK:
                wait_readable(watching.fileno(), None)
            return watching.fileno()

    def close(self) -> None:
        """Drop this end."""
        try:
            if self._pid == os.getpid() and not self._closed:  # a fork has none of its own
                flush_all()
                for sender in self._pipelined:
                    sender.close()
        finally:
            if self._pid == os.getpid():
                for sender in self._pipelined:
                    sender.abandon()
            super().close()
            _close_all(self._watching)

    def _watch_again(self) -> None:
        """Make the descriptors not readable, as there is no message, and watch again."""
        for _ in range(len(self._watching)):
            with self._take(self._watching) as watching:
                while wait_readable(watching.fileno(), 0):
                    watching.receive()
                watching.say(Op.WATCH)
            self._watching.rotate()

    def _forked(self) -> None:
        super()._forked()
        self._watching.clear()
        self._pipelined.clear()

    def _settled(self, reply: Reply) -> None:
        if reply.parts:
            self._late.append(reply)


class RemoteEnd(RemoteChannel):
    """End of a one-way channel on another host, with the data of its handle."""

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
    """Counter of another host; a ``SharedCounter``."""

    def add(self, n: int = 1) -> None:
        """Raise the count; return when that is done."""
        with self.stream() as stream:
            stream.ask(Op.ADD, n, form=ONE)

    def take(self, timeout: float | None) -> bool:
        """Lower the count by one once it is above zero; False when ``timeout`` is over."""
        with self.stream() as stream:
            return stream.ask(Op.TAKE, timeout=timeout).status is Status.OK

    def claim(self, timeout: float | None, taken: list[Any], claims: Claimant) -> bool:
        """Take one and record it.  If this process dies in between, the hub undoes it."""
        with self.stream() as stream:
            if stream.ask(Op.CLAIM, timeout=timeout).status is not Status.OK:
                return False
            taken.append(1)
            claims.add()
            stream.say(Op.KEEP)
            return True

    def clear(self) -> int:
        """Set the count to zero and return the count before."""
        with self.stream() as stream:
            count: int = stream.ask(Op.CLEAR).values[0]
        return count

    def value(self) -> int:
        """Return the count."""
        with self.stream() as stream:
            count: int = stream.ask(Op.VALUE).values[0]
        return count

    def wait(self, timeout: float | None) -> bool:
        """Wait until the count is above zero, without lowering it."""
        return self.changed(0, timeout)

    def changed(self, since: int, timeout: float | None) -> bool:
        """Wait until the count is not ``since``; False when ``timeout`` is over."""
        with self.stream() as stream:
            reply = stream.ask(Op.CHANGED, since, form=ONE, timeout=timeout)
            return reply.status is Status.OK


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
        with suppress(IndexError):  # another thread has closed the last one
            streams.pop().close()
