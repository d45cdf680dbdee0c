"""The seam between whoever wants children and whoever runs them.

The master asks through ``ChildHandle`` and hears through ``ChildObserver``.  A child of this very
process (``local_child.py``) and one behind a link (``fiber._backends``) both are one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple, Protocol

from fiber._wire.blob import Blob
from fiber._wire.descriptor import Descriptor
from fiber._wire.packet import BytesLike, Message
from fiber.resources import Resources

UNKNOWN = 255
"""Exit code of a child of which it is not known, as in multiprocessing."""


class Cause(IntEnum):
    """What a child's end says something of."""

    CHILD = 0
    """The child: it ended, or was killed."""
    REFUSED = 1
    """Its host: the system had no room for it, and it never was."""
    AGENT_LOST = 2
    """The way to its host."""
    NO_HOST = 3
    """There is no host for it, and none will come."""
    DRAINED = 4
    """Its host, which is about to go: it was killed, or never started."""


class ExitReport(NamedTuple):
    """How a child ended."""

    exitcode: int
    """As multiprocessing has it: the status, or minus the signal."""
    reason: str
    """The same for a person: "killed by SIGKILL", "exit status 3", "agent lost: …"."""
    unread: tuple[int, ...] = ()
    """Sequence numbers of packets that were delivered and that the child never read."""
    running: tuple[int, int] | None = None
    """Sequence number and index of the task that it was running."""
    log: tuple[str, ...] = ()
    """The last lines that it wrote, where its output is captured."""
    host: str = ""
    cause: int = Cause.CHILD
    stack: str = ""
    """The Python stacks of its threads, if it crashed or was told to write them."""
    pod: str = ""
    """The pod that it ran in, and that pod's node, where there is one."""
    node: str = ""
    disrupted: bool = False
    """Whether the cluster ended it, by a drain, an eviction or a lost node for instance."""

    def describe(self) -> str:
        """The reason, and where that was if it was in a pod."""
        if not self.pod:
            return self.reason
        return f"{self.reason}, in pod {self.pod}" + (f" on node {self.node}" if self.node else "")


@dataclass(frozen=True, slots=True)
class ChildSpec:
    """What to start."""

    name: str
    method: str
    """``fork`` from the zygote or ``spawn`` a new interpreter."""
    preparation: bytes
    """Pickled dict: what a child sets up before it unpickles anything of the user's.

    The same for many children: what is this child's own has a field of its own.
    """
    payload: bytes
    """The pickled Process object."""
    fds: tuple[Descriptor, ...] = ()
    """What the payload refers to by index, closed once the child has its own or will never be; only
    for an agent on the same host."""
    tasks: bool = False
    """Whether it is a pool worker, with a channel for tasks."""
    passing: bool = False
    """Whether what comes from there is passed on to another host (see ``packet.receive``)."""
    executable: str | None = None
    stdio: tuple[int, int] | None = field(default=None)
    """Descriptors for its stdout and stderr; None: those of the agent's process."""
    program: Blob | None = None
    """The program's files, for an agent that has not the program's own file system."""
    payload_at: tuple[Descriptor, int, int] | None = None
    """Place of a large payload, used instead: a descriptor, the offset in it, and its size."""
    arguments: Blob | None = None
    """The pickled arguments of the Process, where they are not in the payload."""
    resources: Resources = field(default=Resources())
    """What it wishes of its host, heeded where hosts are made for children."""

    def close(self) -> None:
        """Close ``fds``."""
        for owner in self.fds:
            owner.close()


class ChildObserver(Protocol):
    """Hears what becomes of one child.  Called on the loop's thread; must not block."""

    def started(self, pid: int) -> None:
        """It exists."""

    def received(self, message: Message) -> None:
        """It sent a packet on its task channel."""

    def recalled(self, seqs: list[int]) -> None:
        """These packets it will never see: the answer to ``recall``."""

    def draining(self) -> None:
        """Its host is about to go: give it nothing more to do."""

    def exited(self, report: ExitReport) -> None:
        """It is gone, or never came to be.  Exactly once, and last."""


class DirectChannel(Protocol):
    """The task channel of a pool worker, lent to the threads of the master."""

    def send(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send a packet, as ``ChildHandle.deliver`` does; OSError if nothing was sent."""

    def receive(self, timeout: float) -> Message | None:
        """The next packet that it sends; None after ``timeout`` seconds, EOFError at its end.

        BrokenPipeError: the end came before what was sent last was on its way.  OSError: a packet
        came, and the system had no room for it: the worker will be killed.
        """

    def close(self) -> None:
        """Let go of it."""


class ChildHandle(Protocol):
    """What the master holds of one child.  Nothing blocks; ``signal`` and ``recall`` come from
    anywhere, the rest from the loop's thread.
    """

    name: str
    host: str
    """Where it is; empty while it waits for a host."""
    pid: int | None
    start_error: Exception | None
    """What kept it from being started, where that is not only told by its report."""

    @property
    def node(self) -> str:
        """The node of its pod; empty where there is none, or while that is not known."""

    @property
    def waiting(self) -> bool:
        """Whether it waits for a host."""

    @property
    def leaving(self) -> str:
        """Why its host takes no new work and is about to go; empty if the host stays."""

    def start(self) -> None:
        """Start it; what becomes of that, the observer hears.  Once, on the loop's thread."""

    def deliver(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send a packet to its task channel, ``seq`` (eight bytes) in front.

        False: the child is gone and never saw it, and no report names it among the unread.
        """

    def lend(self) -> DirectChannel | None:
        """Its task channel for direct use by one thread at a time, until ``reclaim``.

        None if it is gone or cannot be lent.  On the loop's thread; the observer hears nothing that
        it says until then, but of its end.
        """

    def reclaim(self) -> None:
        """Hear what it says again.  On the loop's thread."""

    def recall(self) -> None:
        """Recall the packets that it has not read; the observer hears which."""

    def signal(self, signum: int) -> None:
        """Send it a signal; nothing if it is gone."""
