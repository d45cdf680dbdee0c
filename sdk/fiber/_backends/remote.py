"""Agents behind links and their children, as the master sees them.

``RemoteAgent`` is an agent that has connected. ``RemoteChild`` is a child on its host, and
``RemoteTaskChannel`` the child's task channel. ``BlobSender`` sends the blobs that the agent's
children need.
"""

from __future__ import annotations

import itertools
import pickle
import signal
import threading
import weakref
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache, partial
from typing import Protocol

from fiber._agent.interface import Cause, ChildObserver, ChildSpec, ExitReport
from fiber._hub.hub import Hub
from fiber._logs import OutputWriter
from fiber._transport.link import Link
from fiber._transport.link_protocol import Frame
from fiber._transport.loop import EventLoop
from fiber._wire import messages, packet
from fiber._wire.memory_files import Blob, BytesLike
from fiber._wire.packet import Message

_SHUTDOWN_GRACE = 0.5

_FATAL = (signal.SIGINT, signal.SIGKILL, signal.SIGTERM)
"""Signals that end a child that has not begun."""

_REMEMBERED = 1024
"""Packets to one child whose sequence numbers are remembered; a worker has a few at a time."""


class AgentObserver(Protocol):
    """Hears what becomes of an agent; on the loop's thread."""

    def lost(self, agent: RemoteAgent, reason: str) -> None:
        """Note that an agent is lost for good.  Its children are told after this."""

    def child_gone(self, agent: RemoteAgent) -> None:
        """Note that a child of an agent has ended."""

    def suspected(self, agent: RemoteAgent, suspect: bool) -> None:
        """Note that an agent is silent, or is heard again."""

    def leaving(self, agent: RemoteAgent) -> None:
        """Note that an agent takes no new children."""


class Starter(Protocol):
    """Sees to it that children get an agent; on the loop's thread."""

    loop: EventLoop

    def start(self, child: RemoteChild) -> None:
        """Have it started, now or as soon as there is room."""

    def withdraw(self, child: RemoteChild) -> bool:
        """Withdraw a child; return False if it has an agent already."""


class RemoteAgent:
    """An agent that has dialled in.  Everything but ``send`` and ``close`` happens on the loop's
    thread.
    """

    def __init__(
        self,
        host: str,
        link: Link,
        loop: EventLoop,
        hub: Hub,
        output: OutputWriter,
        observer: AgentObserver,
    ) -> None:
        self.host = host
        self.loop = loop
        self.lost: str | None = None
        """Why it is gone for good."""
        self.pod = self.node = ""
        """The pod that it runs in, and that pod's node; empty if it is in none."""
        self.ending = ""
        """Why its pod is about to go, where that is known."""
        self.disrupted = False
        """True if the cluster ends its pod."""
        self.leaving = ""
        """Reason why it takes no new work and is about to go; empty if it stays."""
        self.suspect = False
        """True if it has been silent for a while."""
        self._link = link
        self._blobs = BlobSender(loop, self._put)
        self._hub = hub
        self._output = output
        self._observer = observer
        self._hub_link = hub.link(host, self._put, dialer=False)
        self._numbers = itertools.count(1)
        self._children: dict[int, RemoteChild] = {}

    def start(self, child: RemoteChild) -> None:
        """Start a child, once all that it needs is there."""
        if self.lost is not None:
            child.end(self._report_of_loss(self.lost))
            return
        number = next(self._numbers)
        self._children[number] = child
        child.place(self, number)
        self._blobs.send_missing(child.blobs, child.begin)

    def withdraw(self, child: RemoteChild) -> bool:
        """None waits here."""
        return False

    def send(self, message: messages.LinkMessage) -> None:
        """Send a message.  From anywhere."""
        self.loop.call_soon(self.transmit, message)

    def transmit(
        self, message: messages.LinkMessage, on_left: Callable[[], None] | None = None
    ) -> None:
        """Send a message now; ``on_left`` is called once the last of it is on its way."""
        self._hub_link.flush()
        self._put(message, on_left)

    def _put(
        self, message: messages.LinkMessage, on_left: Callable[[], None] | None = None
    ) -> None:
        lane = messages.lane(message)
        self._link.send(*messages.pieces(message), lane=lane, on_left=on_left)

    def close(self) -> None:
        """End it and its children.  From anywhere."""
        self.send(messages.Shutdown(_SHUTDOWN_GRACE))

    def leave(self, reason: str) -> None:
        """Note that the agent is about to go: its workers get no new work."""
        if self.leaving or self.lost is not None:
            return
        self.leaving = reason
        self._observer.leaving(self)
        for child in list(self._children.values()):
            child.observer.draining()

    def lose(self, reason: str, *, disrupted: bool = False) -> None:
        """Note that the agent is gone, with its children.  ``disrupted``: the cluster ended it."""
        if self.lost is not None:
            return
        self.lost = reason
        self.disrupted = bool(disrupted or self.disrupted or self.leaving)
        self._hub.unlink(self.host, reason)
        try:
            self._observer.lost(self, reason)
        finally:  # whatever becomes of it, nobody must wait for these
            children, self._children = self._children, {}
            for child in children.values():
                child.end(self._report_of_loss(reason))

    def _report_of_loss(self, reason: str) -> ExitReport:
        why = self.ending or self.leaving or f"agent {self.host} lost: {reason}"
        return ExitReport(-signal.SIGKILL, why, host=self.host, cause=Cause.AGENT_LOST)

    def explain(self, report: ExitReport) -> ExitReport:
        """Add to a child's report where that was, and whether the cluster ended it."""
        # The report's claims do not count.
        report = report._replace(host=self.host, pod=self.pod, node=self.node)
        if report.cause == Cause.AGENT_LOST:
            return report._replace(disrupted=self.disrupted)
        if report.cause == Cause.DRAINED:
            why = self.ending or self.leaving
            return report._replace(disrupted=True, reason=why or report.reason)
        if self.ending and report.exitcode < 0:  # together with its pod
            killed = report.exitcode in (-signal.SIGKILL, -signal.SIGTERM)
            return report._replace(reason=self.ending, disrupted=self.disrupted and killed)
        return report

    # What comes over the link

    def on_frame(self, frame: Frame) -> None:
        """Take a message of the agent about its children."""
        message = messages.decode(frame)
        if isinstance(message, messages.HubMessage):
            self._hub_link.on_frame(message)
            return
        if isinstance(message, messages.Leave):
            self.leave(message.reason)
            return
        if isinstance(message, messages.Lacking):
            self._blobs.lost(message.digest)
            return
        number = getattr(message, "child", None)
        child = None if number is None else self._children.get(number)
        if child is None:
            return
        if isinstance(message, messages.Exited):
            del self._children[message.child]
            self._observer.child_gone(self)  # there is room for what its end makes anybody start
        child.heard(message, self._output)

    def on_suspect(self) -> None:
        """Silent for a while."""
        self.suspect = True
        self._observer.suspected(self, True)

    def on_trusted(self) -> None:
        """Heard again."""
        self.suspect = False
        self._observer.suspected(self, False)

    def on_lost(self, reason: str) -> None:
        """The link is over.  Long silence is that of a node or of a network, not of a task."""
        self.lose(reason, disrupted=self.suspect)


@lru_cache(maxsize=8)
def _preparation(data: bytes) -> Blob:
    """The blob of a preparation: few are in use at a time, and agents forget the others."""
    return Blob(data)


class RemoteChild:
    """A ``ChildHandle`` whose child is, or will be, on another host."""

    def __init__(self, starter: Starter, spec: ChildSpec, observer: ChildObserver) -> None:
        self.name = spec.name
        self.is_worker = spec.tasks
        """True for a worker of a pool."""
        self.host = ""
        """Host of the child; empty while it waits for an agent."""
        self.pid: int | None = None
        self.start_error: Exception | None = None
        self.observer = observer
        self._starter = starter
        self._loop = starter.loop
        self._agent: RemoteAgent | None = None
        self._number = 0
        self._ended_by = 0
        """Fatal signal that was sent to it before it had begun."""
        self._early: list[tuple[int, BytesLike, Sequence[memoryview]]] = []
        """Packets to deliver after its Start."""
        self._unasked: list[messages.LinkMessage] | None = []
        """Signals and recalls, which wait until its Start has left: they would pass a large one."""
        self._delivered = 0
        self._latest: deque[int] = deque(maxlen=_REMEMBERED)
        self._channel: RemoteTaskChannel | None = None
        self._gone = False
        needed = (_preparation(spec.preparation), spec.program, spec.arguments)
        self.blobs = [blob for blob in needed if blob is not None]
        """Blobs that its agent must have while the child lives."""
        digests = tuple(blob and blob.digest for blob in needed)
        fields = (spec.name, spec.method, spec.tasks, digests)
        self._asked: tuple[bytes, bytes] | None = None
        """Start of the child, kept until it has started: its agent may be about to go."""
        self._start: tuple[bytes, bytes] | None = pickle.dumps(fields, protocol=5), spec.payload

    @property
    def node(self) -> str:
        """The node of its agent's pod."""
        return "" if self._agent is None else self._agent.node

    @property
    def waiting(self) -> bool:
        """True while it has no agent."""
        return self._agent is None and not self._gone

    @property
    def leaving(self) -> str:
        """Why its agent is about to go."""
        agent = self._agent
        return "" if agent is None or not agent.leaving else agent.ending or agent.leaving

    def start(self) -> None:
        """Have it started."""
        self._starter.start(self)

    def move(self, starter: Starter) -> None:
        """Have it started by somebody else, while it has no agent."""
        self._starter = starter
        starter.start(self)

    def place(self, agent: RemoteAgent, number: int) -> None:
        """Place the child on an agent."""
        self._agent, self._number, self.host = agent, number, agent.host

    def begin(self) -> None:
        """Have its agent start it: what it needs is there."""
        start, self._start = self._start, None
        if start is None or self._agent is None:
            return  # its agent was lost meanwhile
        self._asked = None if self.is_worker else start
        self._agent.transmit(messages.Start(self._number, *start), self._start_left)
        early, self._early = self._early, []
        for packet_ in early:
            self.deliver(*packet_)

    def _start_left(self) -> None:
        unasked, self._unasked = self._unasked, None
        for message in unasked or ():
            self._tell(message)

    def deliver(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send a packet to its task channel; False if its end is known."""
        if self._gone:
            return False
        if self._agent is None or self._start is not None:
            self._early.append((seq, payload, buffers))
            return True
        self._delivered += 1
        self._latest.append(seq)
        self._agent.transmit(messages.Deliver(self._number, seq, payload, buffers))
        return True

    def lend(self) -> RemoteTaskChannel | None:
        """Return its task channel, for direct use; None if it has ended."""
        if self._gone:
            return None
        self._channel = RemoteTaskChannel(self._loop, self.deliver)
        return self._channel

    def reclaim(self) -> None:
        """Hear what it says again, and what nobody has received."""
        channel, self._channel = self._channel, None
        if channel is not None:
            for message in channel.drain():
                self.observer.received(message)

    def recall(self) -> None:
        """Recall unread packets."""
        self._loop.call_soon(self._ask, messages.Recall)

    def signal(self, signum: int) -> None:
        """Send it a signal."""
        self._loop.call_soon(self._ask, messages.Signal, signum)

    def _ask(self, message: Callable[..., messages.LinkMessage], *fields: int) -> None:
        if self._gone:
            return
        if self._agent is not None:
            if self.pid is None and fields and fields[0] in _FATAL:
                self._ended_by = fields[0]
            self._tell(message(self._number, *fields))
        elif fields and fields[0] in _FATAL and self._starter.withdraw(self):
            name = signal.Signals(fields[0]).name
            self.end(ExitReport(-fields[0], f"killed by {name} before it had a host"))

    def _tell(self, message: messages.LinkMessage) -> None:
        if self._unasked is not None:
            self._unasked.append(message)
        elif self._agent is not None and not self._gone:
            self._agent.transmit(message)

    def heard(self, message: messages.LinkMessage, output: OutputWriter) -> None:
        """Something about this child."""
        if isinstance(message, messages.FromChild):
            buffers = [memoryview(buffer) for buffer in message.buffers]
            said = packet.Message(memoryview(message.payload), buffers, [])
            if self._channel is None:
                self.observer.received(said)
            else:
                self._channel.put(said)
        elif isinstance(message, messages.Started):
            self.pid, self._asked = message.pid, None
            self.observer.started(message.pid)
        elif isinstance(message, messages.Recalled):
            self.observer.recalled(list(message.seqs))
        elif isinstance(message, messages.ChildOutput):
            output.write(f"{self.name}@{self.host}", message.text)
        elif isinstance(message, messages.Exited) and self._may_begin_elsewhere(message):
            self._agent, self.host, self._unasked = None, "", []
            self._start, self._asked = self._asked, None
            self._starter.start(self)
        elif isinstance(message, messages.Exited):
            self.end(ExitReport(*message[2:]), self._delivered - message.delivered)

    def _may_begin_elsewhere(self, end: messages.Exited) -> bool:
        """Tell whether its host refused to start it, since the host is about to go.

        A worker's pool has replaced it already.
        """
        refused = end.cause == Cause.DRAINED and end.exitcode > 0 and self.pid is None
        return refused and self._asked is not None and not self._ended_by

    def end(self, report: ExitReport, crossed: int = 0) -> None:
        """Note that the child has ended.  The last ``crossed`` packets came too late for it."""
        self._gone, self._start, self._asked = True, None, None
        self.blobs.clear()
        if self._channel is not None:
            self._channel.end()
        missed = list(self._latest)[max(0, len(self._latest) - crossed) :]
        missed += [seq for seq, _, _ in self._early]
        self._early.clear()
        report = report._replace(unread=(*report.unread, *missed))
        if self._agent is not None:
            report = self._agent.explain(report)
        self.observer.exited(report)


class Send(Protocol):
    """Sends a message to the agent; ``on_left`` is called once the last of it is on its way."""

    def __call__(
        self, message: messages.LinkMessage, on_left: Callable[[], None] | None = None
    ) -> None: ...


class BlobSender:
    """Sends each blob once, and has the agent forget it when nobody here has it any more.

    So an agent keeps no more than this program does, and nobody counts: a blob lives as long as a
    pool, a child or the program itself refers to it.  On the loop's thread.
    """

    def __init__(self, loop: EventLoop, send: Send) -> None:
        self._loop = loop
        self._send = send
        self._sent: dict[bytes, weakref.ref[Blob]] = {}
        self._leaving: dict[bytes, int] = {}
        """Number of times that each blob was sent and has not left."""
        self._waiting: list[tuple[list[bytes], Callable[[], None]]] = []
        """The blobs that a caller needs, and what follows when they have left."""

    def send_missing(self, blobs: Iterable[Blob], then: Callable[[], None]) -> None:
        """Send the blobs that the agent does not have, and call ``then`` when all have left.

        What is sent next finds them there, though large messages pass one another.
        """
        needed = []
        for blob in blobs:
            digest = blob.digest
            needed.append(digest)
            if digest not in self._sent:
                self._leaving[digest] = self._leaving.get(digest, 0) + 1
                self._send(messages.KeepBlob(digest, blob.data), partial(self._left, digest))
            # The newest of several with the same content counts.
            self._sent[digest] = weakref.ref(blob, self._forgetter(digest))
        self._waiting.append((needed, then))
        self._go_on()

    def lost(self, digest: bytes) -> None:
        """The agent could not keep it."""
        self._sent.pop(digest, None)

    def _left(self, digest: bytes) -> None:
        self._leaving[digest] -= 1
        if not self._leaving[digest]:
            del self._leaving[digest]
            self._go_on()

    def _go_on(self) -> None:
        waiting, self._waiting = self._waiting, []
        for needed, then in waiting:
            if self._leaving.keys().isdisjoint(needed):
                then()
            else:
                self._waiting.append((needed, then))

    def _forgetter(self, digest: bytes) -> Callable[[object], None]:
        # A finalizer runs anywhere, and may only put something into the loop's queue.
        return lambda _: self._loop.call_soon(self._forget, digest)

    def _forget(self, digest: bytes) -> None:
        reference = self._sent.get(digest)
        if reference is not None and reference() is None:  # otherwise it was made and sent again
            del self._sent[digest]
            self._send(messages.Forget(digest))


class RemoteTaskChannel:
    """A ``DirectChannel``.  What it sends and receives passes the loop, and nothing above it.

    ``deliver`` is the child handle's own.  Each wait has a lock of its own, which the loop
    releases: an interruption at any line leaves at most a lock that nobody waits for.
    """

    def __init__(self, loop: EventLoop, deliver: Callable[..., bool]) -> None:
        self._loop = loop
        self._deliver = deliver
        self._messages: deque[Message] = deque()
        self._waiting: deque[threading.Lock] = deque()
        self._under_way = 0
        """The last packet that was sent and that the link does not have yet."""
        self._ended = False

    # Whoever borrowed it

    def send(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send a packet; BrokenPipeError if the worker is gone."""
        if self._ended:
            raise BrokenPipeError("the worker is gone")
        self._under_way = seq
        self._loop.call_soon(self._send, seq, payload, buffers)

    def receive(self, timeout: float) -> Message | None:
        """The next packet, None after ``timeout`` seconds.

        At the end EOFError, or BrokenPipeError if what was sent last never left.
        """
        if not self._messages and not self._ended:
            self._wait(timeout)
        try:
            return self._messages.popleft()
        except IndexError:
            if not self._ended:
                return None
        if self._under_way:
            raise BrokenPipeError("the worker was gone before this was sent")
        raise EOFError

    def close(self) -> None:
        """Let go of it."""

    def _wait(self, timeout: float) -> None:
        lock = threading.Lock()
        lock.acquire()
        self._waiting.append(lock)
        # The loop notes what there is first and looks who waits then.
        if not self._messages and not self._ended:
            lock.acquire(timeout=timeout)

    # The loop's thread

    def put(self, message: Message) -> None:
        """The worker sent it."""
        self._messages.append(message)
        self._wake()

    def end(self) -> None:
        """The worker is gone."""
        self._ended = True
        self._wake()

    def drain(self) -> Iterator[Message]:
        """Yield the messages that were not received."""
        while self._messages:
            yield self._messages.popleft()

    def _send(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview]) -> None:
        if self._deliver(seq, payload, buffers):
            self._under_way = 0

    def _wake(self) -> None:
        while self._waiting:
            self._waiting.popleft().release()
