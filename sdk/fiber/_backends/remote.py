"""Agents behind links and their children, as the master sees them.

``RemoteAgent`` is an agent that has connected. ``RemoteChild`` is a child on its host, and
``RemoteTaskChannel`` the child's task channel.
"""

from __future__ import annotations

import itertools
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache, partial
from typing import Protocol

from fiber._agent.interface import OUT_OF_MEMORY, Cause, ChildObserver, ChildSpec, ExitReport
from fiber._agent.usage import Usage
from fiber._backends.blobs import BlobSender, Fanout
from fiber._hub.hub import Hub
from fiber._logs import OutputWriter
from fiber._output_files import OutputFile
from fiber._transport.link import Link
from fiber._transport.link_protocol import Frame
from fiber._transport.loop import EventLoop
from fiber._wire import messages, packet
from fiber._wire.blob_messages import Holding, Lacking, Unfetched
from fiber._wire.memory_files import Blob, BytesLike, shared_blob
from fiber._wire.packet import Message

_SHUTDOWN_GRACE = 0.5

_FATAL = (signal.SIGINT, signal.SIGKILL, signal.SIGTERM)
"""Signals that end a child that has not begun."""

_REMEMBERED = 1024
"""Packets to one child whose sequence numbers are remembered; a worker has a few at a time."""


class AgentObserver(Protocol):
    """Observer of an agent.  Called on the loop thread."""

    def lost(self, agent: RemoteAgent, reason: str) -> None:
        """Note that an agent is lost for good.  Its children end after this call."""

    def child_gone(self, agent: RemoteAgent) -> None:
        """Note that a child of an agent has ended."""

    def suspected(self, agent: RemoteAgent, suspect: bool) -> None:
        """Note that an agent is silent, or that it answers again."""

    def leaving(self, agent: RemoteAgent) -> None:
        """Note that an agent takes no new children."""


class Starter(Protocol):
    """Starter of children, which gives them agents.  Called on the loop thread."""

    loop: EventLoop

    def start(self, child: RemoteChild) -> None:
        """Start a child, now or as soon as there is room."""

    def withdraw(self, child: RemoteChild) -> bool:
        """Withdraw a child; return False if it has an agent already."""


class RemoteAgent:
    """Agent that has dialed in.

    Any thread may call ``send`` and ``close``.  All else runs on the loop thread.
    """

    def __init__(
        self,
        host: str,
        link: Link,
        loop: EventLoop,
        hub: Hub,
        output: OutputWriter,
        observer: AgentObserver,
        fanout: Fanout | None = None,
    ) -> None:
        self.host = host
        self.loop = loop
        self.lost: str | None = None
        """Reason why the agent is lost; None while it is not."""
        self.pod = self.node = ""
        """Pod of the agent, and node of that pod; empty if it is in no pod."""
        self.ending = ""
        """Reason why the pod ends or has ended; empty if it is not known."""
        self.disrupted = False
        """True if the cluster ends the pod."""
        self.leaving = ""
        """Reason why the agent takes no new work and will end; empty if it stays."""
        self.suspect = False
        """True while the agent is silent for longer than usual."""
        self._link = link
        self._blobs = BlobSender(loop, self._put, fanout)
        self._hub = hub
        self._output = output
        self._observer = observer
        self._hub_link = hub.link(host, self._put, dialer=False)
        self._numbers = itertools.count(1)
        self._children: dict[int, RemoteChild] = {}

    def start(self, child: RemoteChild) -> None:
        """Start a child, once the agent has all blobs that the child needs."""
        if self.lost is not None:
            child.end(self._report_of_loss(self.lost))
            return
        number = next(self._numbers)
        self._children[number] = child
        child.place(self, number)
        self._blobs.send_missing(child.blobs, child.begin)

    def bring(self, blobs: Iterable[Blob], then: Callable[[], None]) -> None:
        """Call ``then`` once the agent has these blobs."""
        self._blobs.send_missing(blobs, then)

    def describe_pod(self, pod: str, node: str, *, ending: str, disrupted: bool) -> None:
        """Set the facts of the agent's pod, for the reports of its children."""
        self.pod, self.node, self.ending, self.disrupted = pod, node, ending, disrupted

    def withdraw(self, child: RemoteChild) -> bool:
        """Forget a child, to which no Start was sent; return False if it is not here."""
        if self._children.pop(child.number, None) is None:
            return False
        self.loop.call_soon(self._observer.child_gone, self)
        return True

    def send(self, message: messages.LinkMessage) -> None:
        """Send a message.  Any thread."""
        self.loop.call_soon(self.transmit, message)

    def transmit(
        self, message: messages.LinkMessage, on_left: Callable[[], None] | None = None
    ) -> None:
        """Send a message; call ``on_left`` once the whole message has left."""
        self._hub_link.flush()
        self._put(message, on_left)

    def _put(
        self, message: messages.LinkMessage, on_left: Callable[[], None] | None = None
    ) -> None:
        lane = messages.lane(message)
        self._link.send(*messages.pieces(message), lane=lane, on_left=on_left)

    def close(self) -> None:
        """End the agent and its children.  Any thread."""
        self.send(messages.Shutdown(_SHUTDOWN_GRACE))

    def leave(self, reason: str) -> None:
        """Note that the agent will end: its workers get no new work."""
        if self.leaving or self.lost is not None:
            return
        self.leaving = reason
        self._blobs.retire()
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
        self._blobs.close()
        try:
            self._observer.lost(self, reason)
        finally:  # also after an error, so that no caller waits for these children
            children, self._children = self._children, {}
            for child in children.values():
                child.end(self._report_of_loss(reason))

    def _report_of_loss(self, reason: str) -> ExitReport:
        why = self.ending or self.leaving or f"agent {self.host} lost: {reason}"
        return ExitReport(-signal.SIGKILL, why, host=self.host, cause=Cause.AGENT_LOST)

    def explain(self, report: ExitReport) -> ExitReport:
        """Add the pod and node to a child's report, and whether the cluster ended the child."""
        # The agent's own claims about host, pod and node do not count.
        report = report._replace(host=self.host, pod=self.pod, node=self.node)
        if report.cause == Cause.AGENT_LOST:
            return report._replace(disrupted=self.disrupted)
        if report.cause == Cause.DRAINED:
            why = self.ending or self.leaving
            return report._replace(disrupted=True, reason=why or report.reason)
        if report.reason.startswith(OUT_OF_MEMORY):
            return report  # by its own doing, also if its pod ends meanwhile
        if self.ending and report.exitcode < 0:  # together with its pod
            killed = report.exitcode in (-signal.SIGKILL, -signal.SIGTERM)
            return report._replace(reason=self.ending, disrupted=self.disrupted and killed)
        return report

    # Frames and events of the link

    def on_frame(self, frame: Frame) -> None:
        """Handle a message of the agent."""
        if self.lost is not None:
            return
        message = messages.decode(frame)
        if isinstance(message, messages.HubMessage):
            self._hub_link.on_frame(message)
            return
        if isinstance(message, messages.Leave):
            self.leave(message.reason)
            return
        if isinstance(message, Lacking | Holding | Unfetched):
            self._blobs.on_report(message)
            return
        number = getattr(message, "child", None)
        child = None if number is None else self._children.get(number)
        if child is None:
            return
        if isinstance(message, messages.Exited):
            del self._children[message.child]
            self._observer.child_gone(self)  # before the observer of the child may start another
        child.on_message(message, self._output)

    def on_suspect(self) -> None:
        """Note that the agent is silent."""
        self.suspect = True
        self._observer.suspected(self, True)

    def on_trusted(self) -> None:
        """Note that the agent answers again."""
        self.suspect = False
        self._observer.suspected(self, False)

    def on_lost(self, reason: str) -> None:
        """Note that the link has ended.  After a long silence the node or network is to blame."""
        self.lose(reason, disrupted=self.suspect)


@lru_cache(maxsize=8)
def _preparation(data: bytes) -> Blob:
    """Return the blob of a preparation.  Few are in use at a time; agents forget the others."""
    return Blob(data)


class RemoteChild:
    """Child that runs, or will run, on another host; a ``ChildHandle``."""

    def __init__(self, starter: Starter, spec: ChildSpec, observer: ChildObserver) -> None:
        self.name = spec.name
        self.is_worker = spec.tasks
        """True for a pool worker."""
        self.host = ""
        """Host of the child; empty while it waits for an agent."""
        self.pid: int | None = None
        self.start_error: Exception | None = None
        self._file: OutputFile | None = None
        """File with the child's output, if it is kept and there was any."""
        self.observer = observer
        self._starter = starter
        self._loop = starter.loop
        self._agent: RemoteAgent | None = None
        self.number = 0
        """Number of the child at its agent."""
        self._ended_by = 0
        """Fatal signal that was sent to the child before it had started."""
        self._early: list[tuple[int, BytesLike, Sequence[memoryview]]] = []
        """Packets to deliver after the Start."""
        self._unasked: list[messages.LinkMessage] | None = []
        """Signals and recalls that wait until the Start has left, so as not to overtake it."""
        self._held: deque[_HeldPacket] = deque()
        """Packets to deliver after blobs that some of them need."""
        self._delivered = 0
        self._latest: deque[int] = deque(maxlen=_REMEMBERED)
        self._channel: RemoteTaskChannel | None = None
        self._gone = False
        needed = (_preparation(spec.preparation), spec.program, spec.arguments)
        self.blobs = [blob for blob in needed if blob is not None]
        """Blobs that the agent must have while the child lives."""
        digests = tuple(blob and blob.digest for blob in needed)
        fields = (spec.name, spec.method, spec.tasks, digests)
        self._asked: tuple[bytes, bytes] | None = None
        """Start that was sent, kept until the child runs, because its agent may refuse it."""
        self._start: tuple[bytes, bytes] | None = pickle.dumps(fields, protocol=5), spec.payload

    @property
    def node(self) -> str:
        """Node of the pod of the child's agent."""
        return "" if self._agent is None else self._agent.node

    @property
    def waiting(self) -> bool:
        """True while the child has no agent."""
        return self._agent is None and not self._gone

    @property
    def leaving(self) -> str:
        """Reason why the child's agent will end; empty if it stays."""
        agent = self._agent
        return "" if agent is None or not agent.leaving else agent.ending or agent.leaving

    def start(self) -> None:
        """Start the child, now or as soon as there is an agent with room."""
        self._starter.start(self)

    def move(self, starter: Starter) -> None:
        """Start the child by another ``starter``, while it has no agent."""
        self._starter = starter
        starter.start(self)

    def place(self, agent: RemoteAgent, number: int) -> None:
        """Place the child on an agent."""
        self._agent, self.number, self.host = agent, number, agent.host

    def begin(self) -> None:
        """Send the Start: the agent has all that the child needs."""
        start, self._start = self._start, None
        if start is None or self._agent is None:
            return  # the agent was lost meanwhile
        self._asked = None if self.is_worker else start
        self._agent.transmit(messages.Start(self.number, *start), self._start_left)
        early, self._early = self._early, []
        for packet_ in early:
            self.deliver(*packet_)

    def _start_left(self) -> None:
        unasked, self._unasked = self._unasked, None
        for message in unasked or ():
            self._tell(message)

    def deliver(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send a packet to the task channel; return False if the child has ended."""
        if self._gone:
            return False
        if self._agent is None or self._start is not None:
            self._early.append((seq, payload, buffers))
            return True
        shared = [(at, blob) for at, one in enumerate(buffers) if (blob := shared_blob(one))]
        if not shared and not self._held:
            self._note_delivery(seq)
            self._agent.transmit(messages.Deliver(self.number, seq, payload, buffers))
            return True
        packet_ = _HeldPacket(seq, payload, buffers, shared)
        self._held.append(packet_)
        self._agent.bring([blob for _, blob in shared], partial(self._release, packet_))
        return True

    def _note_delivery(self, seq: int) -> None:
        self._delivered += 1
        self._latest.append(seq)

    def _release(self, released: _HeldPacket) -> None:
        """Send the packets whose blobs the agent has, in their order."""
        released.is_ready = True
        while self._held and self._held[0].is_ready and self._agent is not None:
            ready = self._held.popleft()
            self._note_delivery(ready.seq)
            # The blobs are kept until the message has left, so that no Forget passes it.
            self._agent.transmit(ready.message(self.number), partial(ready.shared.clear))

    def _take_held(self) -> list[int]:
        held = [one.seq for one in self._held]
        self._held.clear()
        return held

    def lease_channel(self) -> RemoteTaskChannel | None:
        """Return the task channel for direct use; None if the child has ended."""
        if self._gone:
            return None
        self._channel = RemoteTaskChannel(self._loop, self.deliver)
        return self._channel

    def reclaim(self) -> None:
        """End the direct use; the observer gets the packets that were not received."""
        channel, self._channel = self._channel, None
        if channel is not None:
            for message in channel.drain():
                self.observer.received(message)

    def recall(self) -> None:
        """Recall unread packets."""
        self._loop.call_soon(self._ask, messages.Recall)

    def signal(self, signum: int) -> None:
        """Send the child a signal."""
        self._loop.call_soon(self._ask, messages.Signal, signum)

    def measure(self) -> None:
        """Ask the child's agent to measure the child."""
        self._ask(messages.Measure)

    def _ask(self, message: Callable[..., messages.LinkMessage], *fields: int) -> None:
        if self._gone:
            return
        fatal = fields[0] if fields and fields[0] in _FATAL else 0
        # A child that waits for a host, or for its blobs, which may be large, ends at once.
        if fatal and self._start is not None and (self._agent or self._starter).withdraw(self):
            step = "it had a host" if self._agent is None else "it began"
            name = signal.Signals(fatal).name
            self.end(ExitReport(-fatal, f"killed by {name} before {step}"))
        elif self._agent is not None:
            if self.pid is None and fatal:
                self._ended_by = fatal
            self._tell(message(self.number, *fields))

    def _tell(self, message: messages.LinkMessage) -> None:
        if self._unasked is not None:
            self._unasked.append(message)
        elif self._agent is not None and not self._gone:
            self._agent.transmit(message)

    def on_message(self, message: messages.LinkMessage, output: OutputWriter) -> None:
        """Handle a message about this child."""
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
            self.observer.recalled([*message.seqs, *self._take_held()])
        elif isinstance(message, messages.ShownStack):
            self.observer.showed_stack(message.text)
        elif isinstance(message, messages.Measured):
            self.observer.measured(Usage(message.memory, message.milliseconds / 1000))
        elif isinstance(message, messages.ChildOutput):
            self._file = output.write_child(self.name, self.host, message.text, self._file)
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
        missed += [seq for seq, _, _ in self._early] + self._take_held()
        self._early.clear()
        report = report._replace(unread=(*report.unread, *missed))
        if self._agent is not None:
            report = self._agent.explain(report)
        self.observer.exited(report)


class _HeldPacket:
    """Packet to a child that waits for the blobs of which it consists, or for earlier packets."""

    def __init__(
        self,
        seq: int,
        payload: BytesLike,
        buffers: Sequence[memoryview],
        shared: list[tuple[int, Blob]],
    ) -> None:
        self.seq = seq
        self.shared = shared
        """Positions of the buffers that are blobs, and the blobs."""
        self.is_ready = False
        self._payload = payload
        self._buffers = buffers

    def message(self, child: int) -> messages.LinkMessage:
        """Return the message to the child's agent, which has the blobs."""
        if not self.shared:
            return messages.Deliver(child, self.seq, self._payload, self._buffers)
        positions = {at for at, _ in self.shared}
        others = [one for at, one in enumerate(self._buffers) if at not in positions]
        digests = [(at, blob.digest) for at, blob in self.shared]
        return messages.DeliverShared(child, self.seq, digests, self._payload, others)


class RemoteTaskChannel:
    """Task channel of a remote child, for direct use; a ``DirectChannel``.

    Packets pass the loop only.  ``deliver`` is the method of the child.  Each wait makes a new
    lock, which the loop releases: an interrupted wait leaves at most an unused lock.
    """

    def __init__(self, loop: EventLoop, deliver: Callable[..., bool]) -> None:
        self._loop = loop
        self._deliver = deliver
        self._messages: deque[Message] = deque()
        self._waiting: deque[threading.Lock] = deque()
        self._under_way = 0
        """Sequence number of the last packet, until the link has it; then 0."""
        self._ended = False

    # The thread that uses the channel

    def send(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send a packet; BrokenPipeError if the worker is gone."""
        if self._ended:
            raise BrokenPipeError("the worker is gone")
        self._under_way = seq
        self._loop.call_soon(self._send, seq, payload, buffers)

    def receive(self, timeout: float) -> Message | None:
        """Return the next packet, or None after ``timeout`` seconds.

        EOFError: the worker ended.  BrokenPipeError: it ended before the last packet to it left.
        """
        if not self._messages and not self._ended:
            self._wait(timeout)
        try:
            return self._messages.popleft()
        except IndexError:
            if not self._ended:
                return None
        if self._under_way:
            raise BrokenPipeError("the worker ended before the packet to it was sent")
        raise EOFError

    def close(self) -> None:
        """Do nothing: the channel has no descriptor."""

    def _wait(self, timeout: float) -> None:
        lock = threading.Lock()
        lock.acquire()
        self._waiting.append(lock)
        # The loop adds a message first, and then looks for waiting threads.
        if not self._messages and not self._ended:
            lock.acquire(timeout=timeout)

    # The loop thread

    def put(self, message: Message) -> None:
        """Add a packet of the worker."""
        self._messages.append(message)
        self._wake()

    def end(self) -> None:
        """Note that the worker has ended."""
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
