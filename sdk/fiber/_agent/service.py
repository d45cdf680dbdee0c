"""The agent's side of its link: obeys the master's messages and reports the children's events.

It also reads the output of remote children by lines.
"""

from __future__ import annotations

import fcntl
import os
import pickle
import signal
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from fiber import config
from fiber._agent.agent import Agent, LocalChild
from fiber._agent.blobs import BlobExchange, BlobLacking, BlobStore
from fiber._agent.interface import Cause, ChildSpec, ExitReport
from fiber._agent.last_words import TELL, signal_masks
from fiber._agent.usage import Usage
from fiber._hub.hub import Hub
from fiber._transport.channels import naming_the_limit
from fiber._transport.link import Link
from fiber._transport.link_protocol import Frame
from fiber._transport.loop import Loop
from fiber._wire import messages, packet
from fiber._wire.blob_messages import Fetch, Forget, KeepBlob, Lacking, Serve
from fiber._wire.descriptor import contents
from fiber._wire.memory_files import BytesLike, pass_on, place_of

_KNOWN_HERE = ExitReport._fields.index("pod")
"""Number of fields of an exit report that an agent sends; the master adds the others."""

_BACKLOG = 4 << 20
"""Bytes of one child's output, or of one of its messages, that may wait for the link.  Above that
the agent stops reading from the child.
"""


class AgentService:
    """Service of one master until the link ends; a ``LinkObserver``.  Runs on the loop thread.

    ``on_end`` gets the reason of the end, and whether the master was lost.  ``reached_at`` is the
    address at which other agents may reach this one, empty if there is none.
    """

    def __init__(
        self,
        loop: Loop,
        link: Link,
        agent: Agent,
        hub: Hub,
        on_end: Callable[[str, bool], None],
        reached_at: str = "",
    ) -> None:
        self._loop = loop
        self._hub = hub
        self._link = link
        self._hub_link = hub.link(None, self._transmit, dialer=True)
        self._agent = agent
        self._on_end = on_end
        self._blobs = BlobStore(config.current().runtime_directory)
        self._exchange = BlobExchange(loop, self._blobs, reached_at, self.send)
        self._children: dict[int, _Observed] = {}
        self._leaving = False
        self._stopping = False
        self._reason = ""
        self._lost = False
        self._ended = False

    def send(
        self, message: messages.LinkMessage, on_left: Callable[[], None] | None = None
    ) -> None:
        """Send a message to the master; call ``on_left`` once the message has left."""
        self._hub_link.flush()
        self._transmit(message, on_left)

    def _transmit(
        self, message: messages.LinkMessage, on_left: Callable[[], None] | None = None
    ) -> None:
        lane = messages.lane(message)
        self._link.send(*messages.pieces(message), lane=lane, on_left=on_left)

    # Frames and events of the link

    def on_frame(self, frame: Frame) -> None:
        """Handle a message of the master."""
        message = messages.decode(frame)
        if isinstance(message, messages.Start):
            self._start(message)
        elif isinstance(message, KeepBlob):
            self._blobs.put(message)
        elif isinstance(message, Serve):
            self._exchange.serve(message)
        elif isinstance(message, Fetch):
            self._exchange.fetch(message)
        elif isinstance(message, Forget):
            self._exchange.forget(message)
            self._blobs.forget(message.digest)
        elif isinstance(message, messages.Shutdown):
            self.stop("the master ended", message.grace)
        elif isinstance(message, messages.HubMessage):
            self._hub_link.on_frame(message)
        elif isinstance(message, messages.ChildRequest):
            child = self._children.get(message.child)
            if child is not None:  # otherwise the child ended while the message travelled
                child.handle(message)

    def on_suspect(self) -> None:
        """Do nothing while the master is silent: work goes on."""

    def on_trusted(self) -> None:
        """Do nothing when the master answers again."""

    def on_lost(self, reason: str) -> None:
        """End the service: the master is lost for good."""
        self._hub.unlink(None, reason)
        self._lost = not (self._stopping or self._leaving)
        self.stop(f"lost the master: {reason}", 0)

    # Children

    def _start(self, message: messages.Start) -> None:
        child = self._children[message.child] = _Observed(self, message.child)
        if self._leaving:
            child.refuse(self._agent.host, "its host is about to go", Cause.DRAINED)
            return
        try:
            with naming_the_limit("starting a process"):
                spec = self._specification(message.process, *pickle.loads(message.spec))
        except BlobLacking as error:
            self.send(Lacking(error.digest))
            child.refuse(self._agent.host, error)
        except OSError as error:
            child.refuse(self._agent.host, error)
        else:
            child.start(self._agent, self._loop, spec)

    def _specification(
        self,
        process: BytesLike,
        name: str,
        method: str,
        tasks: bool,
        digests: tuple[bytes, bytes | None, bytes | None],
    ) -> ChildSpec:
        preparation, program, arguments = digests
        view = memoryview(process)
        pass_on(view)
        place = place_of(view)
        return ChildSpec(
            name,
            method,
            bytes(contents(self._blobs.get(preparation).fileno())),
            bytes(view) if place is None else b"",
            payload_at=None if place is None else (*place, len(view)),
            tasks=tasks,
            program=None if program is None else self._blobs.get(program),
            arguments=None if arguments is None else self._blobs.get(arguments),
        )

    def insert_shared(self, buffers: list[memoryview], shared: Sequence[tuple[int, bytes]]) -> None:
        """Insert the buffers of a packet that are blobs; BlobLacking if one is not here."""
        for position, digest in shared:
            try:
                blob = self._blobs.get(digest)
            except BlobLacking:
                self.send(Lacking(digest))
                raise
            buffers.insert(position, memoryview(contents(blob.fileno())))

    def forget(self, child: int) -> None:
        """Forget a child that is gone; if the agent ends and this was the last child, finish."""
        del self._children[child]
        if (self._stopping or self._leaving) and not self._children:
            self._loop.call_soon(self._end)

    @property
    def leaving(self) -> bool:
        """True once this agent takes no new work."""
        return self._leaving

    def leave(self, reason: str, grace: float) -> None:
        """Take no new work, end after the last child; kill the children after ``grace`` seconds.

        Children that are prepared for SIGTERM get it now, as the first process of a pod does.
        """
        if self._leaving or self._stopping:
            return
        self._leaving, self._reason = True, reason
        self.send(messages.Leave(grace, reason))
        if not self._children:
            self._end()
            return
        for child in self._children.values():
            child.leave()
        self._loop.call_later(grace, self.stop, reason, 0)

    def stop(self, reason: str, grace: float) -> None:
        """End the children, by SIGKILL after ``grace`` seconds, and then the agent."""
        if self._stopping:
            return
        self._stopping = True
        self._reason = reason
        for child in self._children.values():
            child.drained = self._leaving and not self._lost
        if not self._children:
            self._end()
            return
        self._signal_all(signal.SIGTERM if grace else signal.SIGKILL)
        self._loop.call_later(grace, self._signal_all, signal.SIGKILL)
        self._loop.call_later(grace + 5, self._end)

    def _end(self) -> None:
        if self._ended:
            return
        self._ended = True
        self._exchange.close()
        self._on_end(self._reason, self._lost)

    def _signal_all(self, signum: int) -> None:
        for child in self._children.values():
            child.handle(messages.Signal(0, signum))


class _Observed:
    """A child of the master, whose events go to the master; a ``ChildObserver``."""

    def __init__(self, service: AgentService, number: int) -> None:
        self._service = service
        self._number = number
        self._delivered = 0
        self._output = 0
        """Characters of output that wait for the link."""
        self._capture: Capture | None = None
        self._child: LocalChild | None = None
        self.drained = False
        """True if the child is killed because its host has to end."""

    def start(self, agent: Agent, loop: Loop, spec: ChildSpec) -> None:
        """Start the child."""
        try:
            self._capture = Capture(loop, self.wrote, self.busy)
            spec = replace(spec, stdio=self._capture.stdio, passing=True)
            self._child = agent.child(spec, self)
            self._child.start()
        except Exception as error:
            # Every error is reported to the master, which asked for the child.
            self.refuse(agent.host, error)

    def refuse(self, host: str, why: object, cause: Cause = Cause.REFUSED) -> None:
        """Report to the master that the child could not be started."""
        self.exited(ExitReport(1, f"could not be started: {why}", host=host, cause=cause))

    def leave(self) -> None:
        """Take back a worker's tasks that wait, or send SIGTERM to a process prepared for it."""
        child = self._child
        if child is None:
            return
        if child.tasks:
            child.drain()
        elif child.pid is not None and is_expected(child.pid, signal.SIGTERM):
            child.signal(signal.SIGTERM)

    def handle(self, message: messages.ChildRequest) -> None:
        """Do what a message of the master asks of this child."""
        child = self._child
        if child is None:
            return  # the child could not be started, and its report is on the way
        if isinstance(message, messages.Deliver | messages.DeliverShared):
            self._delivered += 1
            buffers = [memoryview(buffer) for buffer in message.buffers]
            for buffer in buffers:
                pass_on(buffer)
            if message.seq and self._service.leaving:
                self.recalled([message.seq])
                return
            try:
                if isinstance(message, messages.DeliverShared):
                    self._service.insert_shared(buffers, message.shared)
                child.deliver(message.seq, message.payload, buffers)
            except (OSError, BlobLacking) as error:
                child.abort(error)
        elif isinstance(message, messages.Signal):
            child.signal(message.signum)
        elif isinstance(message, messages.Measure):
            child.measure()
        else:
            child.recall()

    def started(self, pid: int) -> None:
        """Report to the master that the child runs."""
        if self._capture is not None:
            self._capture.started()
        self._service.send(messages.Started(self._number, pid))

    def received(self, message: packet.Message) -> None:
        """Send the child's packet to the master."""
        size = sum([buffer.nbytes for buffer in message.buffers])
        on_left = None
        if size > _BACKLOG and self._child is not None:
            # Keep the next results in the child, so that they do not fill the memory of this host.
            self._child.pause()
            on_left = self._child.resume
        said = messages.FromChild(self._number, message.payload, message.buffers)
        self._service.send(said, on_left)
        message.release()

    def recalled(self, seqs: list[int]) -> None:
        """Send the answer to a recall to the master."""
        self._service.send(messages.Recalled(self._number, tuple(seqs)))

    def showed_stack(self, text: str) -> None:
        """Send the child's stacks to the master."""
        self._service.send(messages.ShownStack(self._number, text))

    def measured(self, usage: Usage) -> None:
        """Send the child's memory and processor time to the master."""
        milliseconds = round(usage.cpu * 1000)
        self._service.send(messages.Measured(self._number, usage.memory, milliseconds))

    def draining(self) -> None:
        """Do nothing: this agent itself tells the master that its host is about to end."""

    def exited(self, report: ExitReport) -> None:
        """Send the child's last output, then its exit report."""
        if self.drained and report.exitcode == -signal.SIGKILL:
            report = report._replace(cause=Cause.DRAINED)
        log = self._capture.finish() if self._capture is not None else ()
        fields: Any = report._replace(log=log)[:_KNOWN_HERE]
        end = messages.Exited(self._number, self._delivered, *fields)
        self._service.send(end)
        self._service.forget(self._number)

    def wrote(self, text: str) -> None:
        """Send the child's output to the master."""
        self._output += len(text)
        left = partial(self._output_left, len(text))
        self._service.send(messages.ChildOutput(self._number, text), left)

    def busy(self) -> bool:
        """Return whether so much output waits for the link that the agent must stop reading it.

        Output waits behind large results of the same child, but not of other children.
        """
        return self._output > _BACKLOG

    def _output_left(self, size: int) -> None:
        self._output -= size


LAST_LINES = 20
"""Lines kept to explain a death."""

_CHUNK = 1 << 16
_LONGEST = 1 << 13
"""Bytes after which a line without an end is passed on in pieces."""


class Capture:
    """Pipe for one child's stdout and stderr.  Runs on the loop thread."""

    def __init__(self, loop: Loop, write: Callable[[str], None], busy: Callable[[], bool]) -> None:
        self._loop = loop
        self._write = write
        self._busy = busy
        with naming_the_limit("capturing the output of a process"):
            self._reader, self._writer = os.pipe2(os.O_CLOEXEC)
        os.set_blocking(self._reader, False)
        self._rest = b""
        self._lines: deque[str] = deque(maxlen=LAST_LINES)
        self._closed = False
        loop.register(self._reader, self._readable)

    @property
    def stdio(self) -> tuple[int, int]:
        """Descriptors for the child's stdout and stderr."""
        return self._writer, self._writer

    def started(self) -> None:
        """Close the writing end: the child has its own now."""
        if self._writer >= 0:
            os.close(self._writer)
            self._writer = -1

    def finish(self) -> tuple[str, ...]:
        """Read the rest of a dead child's output; return its last lines."""
        if not self._closed:
            self._closed = True
            self._loop.unregister(self._reader)
            # No more than the pipe's size: a process that the child started may write for ever.
            left = fcntl.fcntl(self._reader, fcntl.F_GETPIPE_SZ)
            while left > 0 and (size := self._read()):
                left -= size
            self._pass_on(b"\n" if self._rest else b"")
            os.close(self._reader)
            self.started()
        return tuple(self._lines)

    def _readable(self) -> None:
        if self._busy():
            # The link is behind: let the child wait for room in the pipe, as at a slow terminal.
            self._loop.unregister(self._reader)
            self._loop.call_later(0.05, self._resume)
        else:
            self._read()

    def _resume(self) -> None:
        if not self._closed:
            self._loop.register(self._reader, self._readable)

    def _read(self) -> int:
        try:
            data = os.read(self._reader, _CHUNK)
        except BlockingIOError:
            return 0
        if data:
            self._pass_on(data)
        elif not self._closed:
            # All writers have closed the pipe, though the child may still run.
            self._loop.unregister(self._reader)
        return len(data)

    def _pass_on(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        while len(self._rest) > _LONGEST:
            lines.append(self._rest[:_LONGEST])
            self._rest = self._rest[_LONGEST:]
        if lines:
            texts = [line.decode(errors="replace").removesuffix("\r") for line in lines]
            self._lines.extend(texts)
            self._write("\n".join(texts))


def is_expected(pid: int, signum: int) -> bool:
    """Return whether process ``pid`` handles, blocks or ignores ``signum``.

    False if the signal would end the process, if the process cannot be inspected, and for a child
    that still has its zygote's handlers, recognized by TELL, which zygotes ignore.
    """
    try:
        caught, blocked, ignored = signal_masks(pid)
    except (OSError, KeyError, ValueError):
        return False
    if ignored >> (TELL - 1) & 1:
        return False
    return bool((caught | blocked | ignored) >> (signum - 1) & 1)
