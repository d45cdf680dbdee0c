"""Interface between the master, which wants children, and the agents, which run them.

The master asks through ``ChildHandle`` and gets answers through ``ChildObserver``.  Both a child of
this process (``LocalChild``) and one behind a link (``fiber._backends``) have a
``ChildHandle``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple, Protocol

from fiber._agent.usage import Usage
from fiber._wire.descriptor import Descriptor
from fiber._wire.memory_files import Blob, BytesLike
from fiber._wire.packet import Message
from fiber.resources import Resources

UNKNOWN = 255
"""Exit code of a child whose real one is unknown, as in multiprocessing."""


class Cause(IntEnum):
    """Part of the system that caused a child's end."""

    CHILD = 0
    """The child: it ended, or was killed."""
    REFUSED = 1
    """The host, which had no room for the child.  The child never existed."""
    AGENT_LOST = 2
    """The agent or its link, which was lost."""
    NO_HOST = 3
    """The lack of a host: there is none for the child, and none will come."""
    DRAINED = 4
    """The host, which is about to end.  It killed the child or never started it."""


OUT_OF_MEMORY = "OOMKilled"
"""First word of the reason of a child that exceeded the memory limit of its host."""


class ExitReport(NamedTuple):
    """Report of how a child ended."""

    exitcode: int
    """Exit status, or minus the signal, as in multiprocessing."""
    reason: str
    """Cause in words: "killed by SIGKILL", "exit status 3", "agent lost: …"."""
    unread: tuple[int, ...] = ()
    """Sequence numbers of delivered packets that the child never read."""
    running: tuple[int, int] | None = None
    """Sequence number of the batch that the child was running, and the task's index in it."""
    log: tuple[str, ...] = ()
    """Last lines that the child wrote, if its output is captured."""
    host: str = ""
    cause: int = Cause.CHILD
    stack: str = ""
    """Python stacks of the child's threads, if it crashed or was asked to write them."""
    pod: str = ""
    """Pod that the child ran in, and the node of that pod; empty if there is none."""
    node: str = ""
    disrupted: bool = False
    """True if the cluster ended the child, for instance by a drain, an eviction or a lost node."""

    def describe(self) -> str:
        """Return the reason, and the pod and node if the child was in a pod."""
        if not self.pod:
            return self.reason
        return f"{self.reason}, in pod {self.pod}" + (f" on node {self.node}" if self.node else "")


@dataclass(frozen=True, slots=True)
class ChildSpec:
    """Description of a child to start."""

    name: str
    method: str
    """``fork`` from the zygote or ``spawn`` a new interpreter."""
    preparation: bytes
    """Pickled dict that says what the child sets up before it unpickles the user's objects.

    Many children share the same dict.  Values of one child alone are in the other fields.
    """
    payload: bytes
    """The pickled Process object."""
    fds: tuple[Descriptor, ...] = ()
    """Descriptors that the payload refers to by index; only for an agent on the same host.  They
    are closed once the child has duplicates, or cannot be started."""
    tasks: bool = False
    """True for a pool worker, which has a channel for tasks."""
    passing: bool = False
    """True if the child's packets are passed on to another host (see ``packet.receive``)."""
    executable: str | None = None
    stdio: tuple[int, int] | None = field(default=None)
    """Descriptors for the child's stdout and stderr; None for those of the agent's process."""
    program: Blob | None = None
    """Files of the program, for an agent that does not share the program's file system."""
    payload_at: tuple[Descriptor, int, int] | None = None
    """Place of a large payload, used instead of ``payload``: descriptor, offset and size."""
    arguments: Blob | None = None
    """Pickled arguments of the Process, if they are not in the payload."""
    resources: Resources = field(default=Resources())
    """Resources that the child asks for; used by backends that make hosts for children."""

    def close(self) -> None:
        """Close ``fds``."""
        for owner in self.fds:
            owner.close()


class ChildObserver(Protocol):
    """Receiver of one child's events.  Called on the loop thread; must not block."""

    def started(self, pid: int) -> None:
        """Take note that the child runs as process ``pid``."""

    def received(self, message: Message) -> None:
        """Take a packet that the child sent on its task channel."""

    def recalled(self, seqs: list[int]) -> None:
        """Take the answer to ``recall``: the packets that the child will never read."""

    def showed_stack(self, text: str) -> None:
        """Take the Python stacks of the child, which got the signal ``last_words.SHOW``."""

    def measured(self, usage: Usage) -> None:
        """Take the answer to ``measure``."""

    def draining(self) -> None:
        """Take note that the child's host is about to end: send the child no more tasks."""

    def exited(self, report: ExitReport) -> None:
        """Take note that the child ended or could not be started.  Called once, and last."""


class DirectChannel(Protocol):
    """Task channel of a pool worker, for direct use by threads of the master."""

    def send(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send a packet, as ``ChildHandle.deliver`` does.  OSError: the packet was not sent."""

    def receive(self, timeout: float) -> Message | None:
        """Return the worker's next packet, or None after ``timeout`` seconds.

        EOFError: the worker ended.  BrokenPipeError: it ended before the last packet to it left.
        OSError: the system had no room for the packet that came, and the worker will be killed.
        """

    def close(self) -> None:
        """Close this end of the channel."""


class ChildHandle(Protocol):
    """Handle by which the master controls one child.  No method blocks.

    Any thread may call ``signal`` and ``recall``.  The others run on the loop thread.
    """

    name: str
    host: str
    """Host of the child; empty while the child waits for one."""
    pid: int | None
    start_error: Exception | None
    """Error to raise for a child that could not start, where the exit report is not enough."""

    @property
    def node(self) -> str:
        """Node of the child's pod; empty if there is none, or while it is unknown."""

    @property
    def waiting(self) -> bool:
        """True while the child waits for a host."""

    @property
    def leaving(self) -> str:
        """Reason why the host takes no new work and is about to end; empty if the host stays."""

    def start(self) -> None:
        """Start the child; the observer gets the outcome.  Called once, on the loop thread."""

    def deliver(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send a packet to the child's task channel, with ``seq`` (eight bytes) in front.

        False: the child is gone and never got the packet.  ``ExitReport.unread`` does not name it.
        """

    def lease_channel(self) -> DirectChannel | None:
        """Return the task channel for direct use by one thread at a time, until ``reclaim``.

        None: the child is gone, or its channel cannot be used directly.  Until ``reclaim`` the
        observer gets no packets, only the child's end.  Runs on the loop thread.
        """

    def reclaim(self) -> None:
        """End the direct use: the observer gets the packets again.  Runs on the loop thread."""

    def recall(self) -> None:
        """Take back the packets that the child has not read; ``recalled`` says which."""

    def signal(self, signum: int) -> None:
        """Send the child a signal, unless it is gone."""

    def measure(self) -> None:
        """Measure the child, if it runs; ``measured`` gets the answer.  Runs on the loop thread."""


class Backend(Protocol):
    """Owner of the agents of one program."""

    name: str
    same_host: bool
    """True if the agents run on the program's host, so that descriptors can be handed over."""

    same_pids: bool
    """True if the pids of the children are those of this host and this PID namespace."""

    elastic: bool
    """True if hosts are made for children.  Starting a child does not wait for its host."""

    @property
    def sends_program(self) -> bool:
        """True if the agents need the program's files for their children."""

    @property
    def passes_on(self) -> bool:
        """True if agents pass large blobs on to each other, so that it pays to make blobs."""

    def child(self, spec: ChildSpec, observer: ChildObserver) -> ChildHandle:
        """Return a child, not started yet; raise errors that are known already.  Any thread."""

    def close(self) -> None:
        """End all agents and their children.  Must not be called on the loop thread."""
