"""An agent behind a link, as the master sees it: the same ports as the agent in this process."""

from __future__ import annotations

import itertools
import pickle
import signal
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from functools import lru_cache

from fiber._agent.interface import Cause, ChildObserver, ChildSpec, ExitReport
from fiber._backends.output import Output
from fiber._backends.parcels import Parcels
from fiber._backends.remote_channel import RemoteTaskChannel
from fiber._hub.hub import Hub
from fiber._transport.link import EventLoop, Link
from fiber._transport.stream import Frame
from fiber._wire import messages, packet
from fiber._wire.blob import Blob
from fiber._wire.packet import BytesLike

_SHUTDOWN_GRACE = 0.5

_REMEMBERED = 1024
"""Packets to one child whose sequence numbers are remembered; a worker has a few at a time."""


class RemoteAgent:
    """An ``AgentHandle``.

    It takes work before its link is there; what it cannot do it reports as exits.

    ``child``, ``send`` and ``close``, and a child's ``recall`` and ``signal``, come from anywhere
    and only put into the loop's queue; everything else happens on the loop's thread.
    """

    def __init__(
        self,
        host: str,
        loop: EventLoop,
        hub: Hub,
        output: Output,
        on_lost: Callable[[RemoteAgent, str], None],
    ) -> None:
        self.host = host
        self.loop = loop
        self._hub = hub
        self._tunnels = hub.link(host, self.send, dialer=False)
        self._output = output
        self._on_lost = on_lost
        self._ids = itertools.count(1)
        self._children: dict[int, RemoteChild] = {}
        self._to_start: weakref.WeakSet[RemoteChild] = weakref.WeakSet()
        self._parcels = Parcels(loop, self._send)
        self._link: Link | None = None
        self._early: list[Frame] = []
        self._lost: str | None = None

    @property
    def lost(self) -> bool:
        """Whether it is gone for good."""
        return self._lost is not None

    @property
    def children(self) -> int:
        """How many children it has, or is about to have."""
        return len(self._children) + len(self._to_start)

    def can_take(self, limit: float) -> bool:
        """Whether it may have one more child, of at most so many."""
        return self._lost is None and self.children < limit

    @property
    def joined(self) -> bool:
        """Whether it has its link."""
        return self._link is not None

    def join(self, link: Link) -> None:
        """Its process dialled in.  On the loop's thread."""
        self._link = link
        early, self._early = self._early, []
        for frame in early:
            link.send(frame)
        link.attach(self)

    def child(self, spec: ChildSpec, observer: ChildObserver) -> RemoteChild:
        """A child to be started there."""
        if self._lost is not None:
            raise RuntimeError(f"agent {self.host} cannot start {spec.name}: {self._lost}")
        child = RemoteChild(self, next(self._ids), spec, observer)
        self._to_start.add(child)
        return child

    def start(self, child: RemoteChild, message: messages.Start) -> None:
        """Start it, once all that it needs is there.  On the loop's thread."""
        self._to_start.discard(child)
        if self._lost is not None:
            child.end(self._report_of_loss(self._lost))
            return
        self._children[child.number] = child
        self._parcels.send_missing(child.blobs)
        self._send(message.encode())

    def send(self, message: messages.Message) -> None:
        """Send a frame as soon as there is a link."""
        self.loop.call_soon(self._send, message.encode())

    def close(self) -> None:
        """End it and its children."""
        self.send(messages.Shutdown(_SHUTDOWN_GRACE))

    def lose(self, reason: str) -> None:
        """It is gone, and its children with it.  On the loop's thread."""
        if self._lost is not None:
            return
        self._lost = reason
        self._hub.unlink(self.host, reason)
        try:
            self._on_lost(self, reason)
        finally:  # whatever becomes of it, nobody must wait for these
            children, self._children = self._children, {}
            for child in children.values():
                child.end(self._report_of_loss(reason))

    def _report_of_loss(self, reason: str) -> ExitReport:
        why, cause = f"agent {self.host} lost: {reason}", Cause.AGENT_LOST
        return ExitReport(-signal.SIGKILL, why, host=self.host, cause=cause)

    # On the loop's thread

    def _send(self, frame: Frame) -> None:
        if self._link is None:
            self._early.append(frame)
        else:
            self._link.send(frame)

    # What comes over the link

    def on_frame(self, frame: Frame) -> None:
        """What the agent tells of its children."""
        message = messages.decode(frame)
        if isinstance(message, messages.TunnelOpen | messages.TunnelData | messages.TunnelClose):
            self._tunnels.on_frame(message)
            return
        if isinstance(message, messages.Lacking):
            self._parcels.lost(message.digest)
            return
        number = getattr(message, "child", None)
        child = None if number is None else self._children.get(number)
        if child is None:
            return
        if isinstance(message, messages.Exited):
            self._children.pop(message.child, None)
        child.heard(message, self._output)

    def on_suspect(self) -> None:
        """Silent for a while: the backend places nothing on it until it is heard again."""
        self.suspect = True

    def on_trusted(self) -> None:
        """Heard again."""
        self.suspect = False

    suspect = False

    def on_lost(self, reason: str) -> None:
        """The link is over."""
        self.lose(reason)


@lru_cache(maxsize=8)
def _preparation(data: bytes) -> Blob:
    """The blob of a preparation: few are in use at a time, and agents forget the others."""
    return Blob(data)


class RemoteChild:
    """A ``ChildHandle`` whose child is on another host."""

    def __init__(
        self, agent: RemoteAgent, number: int, spec: ChildSpec, observer: ChildObserver
    ) -> None:
        self.number = number
        self.name = spec.name
        self.host = agent.host
        self.pid: int | None = None
        self.start_error: Exception | None = None
        self.observer = observer
        self._agent = agent
        self._delivered = 0
        self._latest: deque[int] = deque(maxlen=_REMEMBERED)
        self._channel: RemoteTaskChannel | None = None
        self._gone = False
        needed = (_preparation(spec.preparation), spec.program, spec.arguments)
        self.blobs = [blob for blob in needed if blob is not None]
        """What its agent must have, for as long as it lives."""
        digests = tuple(blob and blob.digest for blob in needed)
        fields = (spec.name, spec.method, spec.payload, spec.tasks, digests)
        self._start: messages.Start | None = messages.Start(
            number, pickle.dumps(fields, protocol=5)
        )

    def start(self) -> None:
        """Have it started."""
        message, self._start = self._start, None
        assert message is not None
        self._agent.start(self, message)

    def deliver(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send a packet to its task channel; False if its end is known."""
        if self._gone:
            return False
        self._delivered += 1
        self._latest.append(seq)
        self._agent.send(messages.Deliver(self.number, seq, payload, buffers))
        return True

    def lend(self) -> RemoteTaskChannel | None:
        """Its task channel, for direct use; None if it is gone."""
        if self._gone:
            return None
        self._channel = RemoteTaskChannel(self._agent.loop, self.deliver)
        return self._channel

    def reclaim(self) -> None:
        """Hear what it says again, and what nobody has received."""
        channel, self._channel = self._channel, None
        if channel is not None:
            for message in channel.drain():
                self.observer.received(message)

    def recall(self) -> None:
        """Recall unread packets."""
        self._agent.send(messages.Recall(self.number))

    def signal(self, signum: int) -> None:
        """Send it a signal."""
        self._agent.send(messages.Signal(self.number, signum))

    def heard(self, message: messages.Message, output: Output) -> None:
        """Something about this child."""
        if isinstance(message, messages.FromChild):
            buffers = [memoryview(buffer) for buffer in message.buffers]
            said = packet.Message(memoryview(message.payload), buffers, [])
            if self._channel is None:
                self.observer.received(said)
            else:
                self._channel.put(said)
        elif isinstance(message, messages.Started):
            self.pid = message.pid
            self.observer.started(message.pid)
        elif isinstance(message, messages.Recalled):
            self.observer.recalled(list(message.seqs))
        elif isinstance(message, messages.Output):
            output.write(f"{self.name}@{self.host}", message.text)
        elif isinstance(message, messages.Exited):
            self.end(ExitReport(*message[2:]), self._delivered - message.delivered)

    def end(self, report: ExitReport, crossed: int = 0) -> None:
        """It is gone; the last ``crossed`` packets met the news of that on their way."""
        self._gone = True
        self.blobs.clear()
        if self._channel is not None:
            self._channel.end()
        missed = list(self._latest)[max(0, len(self._latest) - crossed) :]
        self.observer.exited(report._replace(unread=(*report.unread, *missed)))
