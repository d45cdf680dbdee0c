"""Hub's side of one stream: its client, the object it is attached to, the request that waits."""

from __future__ import annotations

import hmac
import struct
from array import array
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Protocol

from fiber._hub import protocol
from fiber._hub.hosted import (
    HostedChannel,
    HostedCounter,
    HostedSemaphore,
    HostedWaitList,
    Parts,
)
from fiber._hub.parties import Party, new_party
from fiber._hub.pending import PendingRequest, QueuedMessage
from fiber._hub.protocol import (
    FOUR,
    GRANTING,
    HEAD,
    NUMBERS,
    ONE,
    SECRET,
    SECRETS,
    TWO,
    Doorbell,
    Extent,
    GrantFlags,
    ObjectKind,
    Op,
    Origin,
    Status,
)
from fiber._hub.registry import Hosted, NoSuchObject, ObjectAttachment, Registry
from fiber._hub.replicas import BlockIdentity, Joining, Replicas
from fiber._hub.streams import NullHandler, Stream
from fiber._transport.loop import Loop
from fiber._wire import bundle
from fiber._wire.packet import Message

_NAME_BYTES = 80
"""Longest name of the holder of a lock, in bytes."""


class HandlerHub(Protocol):
    """Part of the hub that a handler uses.

    ``Hub`` implements it.  This module stands below ``Hub`` and cannot import it.
    """

    key: bytes
    registry: Registry
    doorbell: Doorbell
    replicas: Replicas
    loop: Loop

    def connect(self, host: str, stream: Stream) -> None:
        """Connect ``stream`` to the hub of ``host``."""

    def ended(self, handler: ClientHandler) -> None:
        """Note that a handler has ended."""


class RequestRefused(Exception):
    """Error: a request is refused and the stream ends.  The text says why."""


class ClientHandler:
    """Server of one stream; its ``StreamHandler``."""

    def __init__(self, home: HandlerHub, stream: Stream) -> None:
        self.stream = stream
        self.waiting: PendingRequest | None = None
        self._home = home
        self._admitted = False
        self._ended = False
        self._attachment: ObjectAttachment | None = None
        self._joined: BlockIdentity | None = None
        self._bound: set[bytes] = set()
        """Grants that end with the stream."""
        self._holder: str | None = None
        """Name of the process whose token the stream keeps."""
        self._last_token_request: int | None = None
        """Number of the last request that got a token, while the client may still give it up."""
        self._place: int | None = None
        """Place of the client in the wait list of a condition."""
        self._queued: set[QueuedMessage] = set()
        """Messages that the channel has not taken."""
        self._party: Party | None = None
        """Part of the client in a barrier."""
        self._claimed = False
        """True if the counter was lowered for this client, which has not confirmed that."""
        stream.handler = self

    def on_message(self, message: Message) -> None:
        """Carry out a request."""
        try:
            operation = Op(message.payload[0])
            if not self._admitted:
                self._admit(operation, message.payload)
            else:
                if self._claimed and operation not in (Op.KEEP, Op.CANCEL):
                    self._unclaim()
                _OPERATIONS[operation](self, message)
        except (RequestRefused, NoSuchObject) as refusal:
            self._end(str(refusal))
        except (struct.error, ValueError, IndexError, KeyError, OSError) as error:
            # A malformed request, or a system without a free descriptor.
            self.refuse(error)

    def refuse(self, error: Exception) -> None:
        """End the stream, whose request failed."""
        if not self._ended:
            self._end(f"the hub could not carry out the request: {error}")

    def on_room(self) -> None:
        """Do nothing: there is at most one reply at a time."""

    def on_closed(self, reason: str) -> None:
        """Return the token that the stream keeps: the client has ended.

        The next acquirer gets the name of the dead holder.
        """
        if self._holder is not None:
            self._semaphore().abandon(self._holder)
            self._holder = None
        self._leave()

    def close(self, reason: str) -> None:
        """End the stream from this side."""
        self._end(reason)

    def _end(self, reason: str) -> None:
        # The token returns without a holder's name, since the client may live.
        self._leave()
        self.stream.finish(reason)

    def _leave(self) -> None:
        party, self._party = self._party, None
        if party is not None:
            party.abandon()
        self._cancel()
        self._give_back()
        self._unclaim()
        place, self._place = self._place, None
        if place is not None:
            self._wait_list().places.lose(place)
        if self._attachment is not None and isinstance(self._hosted, HostedChannel):
            self._hosted.forget(self.ready)
            if self._attachment.shared.kind is ObjectKind.CHANNEL:
                self._drop_messages(self._hosted)
        self._ended = True
        self._detach()
        joined, self._joined = self._joined, None
        if joined is not None:
            self._home.replicas.leave(joined, self)
        self._home.registry.take_back(self._bound)
        self._bound.clear()
        self._home.ended(self)

    def _drop_messages(self, channel: HostedChannel) -> None:
        """Drop the messages for which a pipe has no room: the client was killed.

        To keep them would keep its end of the pipe.  Then a process that sends to the client, and
        reads nothing, would wait for ever.
        """
        for queued in self._queued:
            channel.withdraw(queued)
        self._queued.clear()

    def _detach(self) -> None:
        """Detach the stream from its object, once the channel has taken all messages."""
        if self._attachment is not None and not self._queued:
            attachment, self._attachment = self._attachment, None
            self._home.registry.detach(attachment)

    def _cancel(self) -> None:
        """Withdraw the request that waits."""
        request, self.waiting = self.waiting, None
        if request is not None and self._hosted is not None:
            self._hosted.withdraw(request)
            if request.on_withdrawal is not None:
                request.on_withdrawal()

    def _request(
        self, message: Message, granted: Callable[[], None] | None = None
    ) -> PendingRequest:
        """Return a request to answer later, and withdraw the one before.

        ``granted`` is called before a reply with the status OK.
        """
        self._cancel()
        self.waiting = PendingRequest(self, HEAD.unpack_from(message.payload)[1], granted)
        return self.waiting

    # Greeting

    def _admit(self, operation: Op, payload: memoryview) -> None:
        if operation is not Op.HELLO:
            raise RequestRefused("a stream to a hub has to begin with a greeting")
        _, _, version, key = protocol.HELLO.unpack(payload)
        if version != protocol.VERSION:
            raise RequestRefused(
                f"this hub speaks version {protocol.VERSION} of its protocol, the other side "
                f"{version}: install the same fiberpool on both sides"
            )
        if not hmac.compare_digest(key, self._home.key):
            raise RequestRefused("the key is not this hub's: the handle belongs to another program")
        self._admitted = True

    def hello(self, message: Message) -> None:
        """Check a second greeting, which comes after CONNECT to this host."""
        self._admit(Op.HELLO, message.payload)

    def connect(self, message: Message) -> None:
        """Connect the stream to another host's hub."""
        host = protocol.text(message.payload)
        self.stream.handler = NullHandler()
        self._leave()
        self._home.connect(host, self.stream)

    # Objects

    def register(self, message: Message) -> None:
        """Register the object of a descriptor, and reply with a grant."""
        _, number, kind, flags, *extent = FOUR.unpack(message.payload)
        fd, *beside = message.fds
        granted = self._home.registry.register(
            ObjectKind(kind),
            fd,
            Extent(*extent),
            beside=beside,
            reusable=bool(flags & GrantFlags.REUSABLE),
        )
        self._granted(number, flags, *granted)

    def grant(self, message: Message) -> None:
        """Make a grant for an object that the client uses."""
        _, number, flags, token = GRANTING.unpack(message.payload)
        granted = self._home.registry.grant(token, reusable=bool(flags & GrantFlags.REUSABLE))
        self._granted(number, flags, *granted)

    def _granted(self, number: int, flags: int, grant: bytes, identity: bytes) -> None:
        if flags & GrantFlags.ENDS_WITH_STREAM:
            self._bound.add(grant)
        self.stream.send(SECRETS.pack(Status.OK, number, grant, identity))

    def release(self, message: Message) -> None:
        """End a grant."""
        self._home.registry.take_back([SECRET.unpack(message.payload)[2]])

    def fetch(self, message: Message) -> None:
        """Reply with an object's descriptors."""
        _, number, grant = SECRET.unpack(message.payload)
        if not self.stream.passes_descriptors:
            raise RequestRefused("a descriptor cannot go to another host")
        fds = self._home.registry.fetch(grant)
        self.stream.send(HEAD.pack(Status.OK, number), (), fds)

    def attach(self, message: Message) -> None:
        """Attach the stream to an object."""
        if self._attachment is not None:
            raise RequestRefused("a stream can have one object only")
        _, _, token, grant = SECRETS.unpack(message.payload)
        self._attachment = self._home.registry.attach(token, grant)

    @property
    def _hosted(self) -> Hosted | None:
        """Hosted object that the stream is attached to."""
        return None if self._attachment is None else self._attachment.shared.hosted

    def ring(self, message: Message) -> None:
        """Ring the doorbell: requests that wait for shared memory look at it again."""
        self._home.doorbell.rung()

    def replicate(self, message: Message) -> None:
        """Reply with a replica of another host's memory.  The stream keeps it."""
        number = HEAD.unpack_from(message.payload)[1]
        if not self.stream.passes_descriptors:
            raise RequestRefused("a descriptor cannot go to another host")
        if self._joined is not None:
            raise RequestRefused("a stream can have one object only")
        origin = Origin.decode(message.buffers[0])
        self._joined = origin.block
        self._home.replicas.join(origin, self, Joining(self, number))

    def cancel(self, message: Message) -> None:
        """Reply NO to the request that waits."""
        request = self.waiting
        if request is not None and request.number == HEAD.unpack_from(message.payload)[1]:
            self._cancel()
            request.answer(Status.NO)

    def sync(self, message: Message) -> None:
        """Reply after all earlier replies, so that the client knows that none is on its way.

        The reply has the numbers of the messages that the channel has not taken.

        Take back a token whose reply the client has not read.
        """
        if self._holder is not None:
            self._give_back()
        elif ONE.unpack(message.payload)[2] == self._last_token_request:
            self._semaphore().release()
        self._last_token_request = None
        numbers = array(NUMBERS, (queued.number for queued in self._queued)).tobytes()
        parts = [memoryview(numbers)] if numbers else []
        reply = partial(self._request(message).answer, Status.OK, buffers=parts)
        reply() if self._party is None else self._party.withdraw(reply)

    # A channel

    def _channel(self) -> HostedChannel:
        hosted = self._hosted
        if not isinstance(hosted, HostedChannel):
            raise RequestRefused("the stream is not attached to a channel")
        return hosted

    def send(self, message: Message) -> None:
        """Send a message behind the earlier ones, also if the client ends in the meantime."""
        if not message.buffers:
            raise RequestRefused("there is no message to send")
        channel = self._channel()
        payload, *buffers = message.buffers
        queued = QueuedMessage(self, HEAD.unpack_from(message.payload)[1])
        self._queued.add(queued)
        channel.send(queued, deque([(payload, buffers)]))
        if not queued.was_taken:
            queued.acknowledge()

    def message_taken(self, queued: QueuedMessage) -> None:
        """Note that the channel has taken a message, or that no process can read it."""
        self._queued.discard(queued)
        if self._ended:
            self._detach()

    def exchange(self, message: Message) -> None:
        """Send a message, then receive one."""
        payload, *buffers = message.buffers
        request, channel = self._request(message), self._channel()
        request.then = partial(channel.receive, request)
        channel.send(request, deque([(payload, buffers)]))

    def put_items(self, message: Message) -> None:
        """Count the messages of a bundle, reply, and send them.

        When the client ends, messages that are not sent yet are dropped and no longer counted.
        """
        counter = self._counter_named_in(message)
        items: deque[Parts] = deque((item, ()) for item in bundle.unpack(message.buffers[0]))
        request = self._request(message)
        counter.add(len(items))
        self._channel().send(request, items)
        if items and self.waiting is request:
            request.acknowledge()
            own_count = counter.duplicate()  # the client may end its use of the counter first
            request.on_withdrawal = lambda: own_count.lower(len(items))

    def recv(self, message: Message) -> None:
        """Receive a message."""
        self._channel().receive(self._request(message))

    def draw(self, message: Message) -> None:
        """Receive a message and raise a counter."""
        granted = partial(self._counter_named_in(message).add, 1)
        self._channel().receive(self._request(message, granted))

    def get_item(self, message: Message) -> None:
        """Receive a message and lower a counter."""
        granted = partial(self._counter_named_in(message).lower, 1)
        self._channel().receive(self._request(message, granted))

    def poll(self, message: Message) -> None:
        """Wait for a message."""
        self._channel().poll(self._request(message))

    def watch(self, message: Message) -> None:
        """Send READY once when there is a message."""
        self._channel().watch(self.ready)

    def check(self, message: Message) -> None:
        """Reply whether there is a message now; send READY once there is one."""
        channel, number = self._channel(), HEAD.unpack_from(message.payload)[1]
        channel.forget(self.ready)
        if channel.readable():
            self.stream.send(HEAD.pack(Status.OK, number))
            self.ready()
        else:
            self.stream.send(HEAD.pack(Status.NO, number))
            channel.watch(self.ready)

    def ready(self) -> None:
        """Send READY: the channel that this stream watches is readable."""
        self.stream.send(HEAD.pack(Status.READY, 0))

    # A counter

    def _counter(self) -> HostedCounter:
        return self._checked(self._hosted)

    def _counter_named_in(self, message: Message) -> HostedCounter:
        return self._checked(self._home.registry.hosted(SECRET.unpack(message.payload)[2]))

    @staticmethod
    def _checked(hosted: Hosted | None) -> HostedCounter:
        if not isinstance(hosted, HostedCounter):
            raise RequestRefused("the request is not for a counter")
        return hosted

    def add(self, message: Message) -> None:
        """Raise the counter."""
        counter, n = self._counter(), ONE.unpack(message.payload)[2]
        try:
            counter.add(n)
        except BlockingIOError:
            raise RequestRefused("the counter is at its maximum") from None
        self._request(message).answer(Status.OK)

    def take(self, message: Message) -> None:
        """Lower the counter."""
        self._counter().take(self._request(message))

    def claim(self, message: Message) -> None:
        """Lower the counter.  Without KEEP it is raised again at the next request or the end."""
        self._counter().take(self._request(message, self._on_claim))

    def _on_claim(self) -> None:
        self._claimed = True

    def keep(self, message: Message) -> None:
        """Keep the counter lowered."""
        self._claimed = False

    def _unclaim(self) -> None:
        if self._claimed:
            self._claimed = False
            self._counter().add(1)

    def clear(self, message: Message) -> None:
        """Set the counter to zero."""
        self._request(message).answer(Status.OK, self._counter().clear())

    def value(self, message: Message) -> None:
        """Reply with the count."""
        self._request(message).answer(Status.OK, self._counter().value())

    def changed(self, message: Message) -> None:
        """Wait until the count changes."""
        self._counter().changed(self._request(message), ONE.unpack(message.payload)[2])

    # A semaphore

    def _semaphore(self) -> HostedSemaphore:
        hosted = self._hosted
        if not isinstance(hosted, HostedSemaphore):
            raise RequestRefused("the stream is not attached to a lock or semaphore")
        return hosted

    def acquire(self, message: Message) -> None:
        """Take a token, which the stream keeps."""
        holder = _name_in(message)
        request = self._request(message)
        self._semaphore().acquire(request, partial(self._token_taken, holder, request.number))

    def _token_taken(self, holder: str, number: int, keeps: bool) -> None:
        self._holder = holder if keeps else None
        self._last_token_request = number

    def _give_back(self) -> None:
        if self._holder is not None:
            self._semaphore().release()
            self._holder = None

    def return_token(self, message: Message) -> None:
        """Return the token of this stream or of another holder."""
        request = self._request(message)
        try:
            self._semaphore().release()
        except ValueError:
            request.answer(Status.NO)
        else:
            self._holder = None
            request.answer(Status.OK)

    def disown(self, message: Message) -> None:
        """Leave the stream's token taken: its process ends without releasing it."""
        if self._holder is not None:
            self._semaphore().disown()
            self._holder = None

    def tokens(self, message: Message) -> None:
        """Reply with the number of tokens."""
        self._request(message).answer(Status.OK, self._semaphore().value())

    # A wait list

    def _wait_list(self) -> HostedWaitList:
        hosted = self._hosted
        if not isinstance(hosted, HostedWaitList):
            raise RequestRefused("the stream is not attached to a condition")
        return hosted

    def enter(self, message: Message) -> None:
        """Take a place, which the stream keeps."""
        self._place = self._wait_list().places.enter(afar=True)
        self._request(message).answer(Status.OK)

    def _own_place(self) -> int:
        if self._place is None:
            raise RequestRefused("the stream has no place at the condition")
        return self._place

    def sleep(self, message: Message) -> None:
        """Reply once the place is notified."""
        self._wait_list().sleep(self._request(message), self._own_place())

    def leave(self, message: Message) -> None:
        """Free the place."""
        request = self._request(message)
        if self._party is not None:
            self._party.dismiss()
        place, self._place = self._place, None
        notified = place is not None and self._wait_list().places.leave(place)
        request.answer(Status.OK if notified else Status.NO)

    def notify(self, message: Message) -> None:
        """Wake some waiters."""
        self._wait_list().places.notify(ONE.unpack(message.payload)[2])
        self._request(message).answer(Status.OK)

    def waiters(self, message: Message) -> None:
        """Reply with the number of waiters."""
        self._request(message).answer(Status.OK, self._wait_list().places.waiters())

    def remove_dead(self, message: Message) -> None:
        """Reply with the number of waiters that died."""
        self._request(message).answer(Status.OK, self._wait_list().places.remove_dead())

    def hold(self, message: Message) -> None:
        """Note how many things the process of this stream has."""
        self._wait_list().places.hold(self._own_place(), ONE.unpack(message.payload)[2])

    def held(self, message: Message) -> None:
        """Reply with the number of things of all processes."""
        self._request(message).answer(Status.OK, self._wait_list().places.held())

    def reclaim(self, message: Message) -> None:
        """Add the things of dead processes to a counter."""
        number = self._wait_list().places.reclaim(self._counter_named_in(message))
        self._request(message).answer(Status.OK, number)

    def get(self, message: Message) -> None:
        """Reply with one of the user's words."""
        value = self._wait_list().places.get(ONE.unpack(message.payload)[2] & 1)
        self._request(message).answer(Status.OK, value & _WORD)

    def set(self, message: Message) -> None:
        """Set one of the user's words."""
        _, _, number, value = TWO.unpack(message.payload)
        self._wait_list().places.set(number & 1, value - (1 << 64) if value >> 63 else value)
        self._request(message).answer(Status.OK)

    # A barrier

    def meet(self, message: Message) -> None:
        """Wait at the barrier of which this wait list has the members."""
        _, _, *tokens, parties, acts, timeout = protocol.MEETING.unpack(message.payload)
        if self._party is None:
            home, members = self._home, self._wait_list()
            self._party = new_party(home.loop, home.registry, members, *tokens)
        request, party = self._request(message), self._party
        request.on_withdrawal = party.withdraw
        party.meet(request, parties, protocol.seconds(timeout), _name_in(message) if acts else "")

    def acted(self, message: Message) -> None:
        """Let all threads at the barrier go: the client has called the action."""
        if self._party is None:
            raise RequestRefused("the stream has no part in a barrier")
        self._party.acted(self._request(message))


_WORD = (1 << 64) - 1


def _name_in(message: Message) -> str:
    return bytes(message.buffers[0][:_NAME_BYTES]).decode(errors="replace")


_OPERATIONS: dict[Op, Callable[[ClientHandler, Message], None]] = {
    operation: getattr(ClientHandler, operation.name.lower()) for operation in Op
}
