"""Children of this program: those that were started and have not ended."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol

from fiber._agent.interface import ChildHandle, ExitReport
from fiber._agent.last_words import SHOW
from fiber._agent.usage import Usage
from fiber._engine.activity import Activity, ChildRecord
from fiber._hub.handles import GrantSet
from fiber._wire.packet import Message

_LONGEST_REASON = 200


class ChildOwner(Protocol):
    """Owner of a child: starts it, and takes the agent's reports about it."""

    record: ChildRecord | None
    """Record of the child, set before ``begin``."""

    @property
    def state(self) -> str:
        """State of the child in one word, as in ``WorkerInfo``."""

    @property
    def busy_since(self) -> float | None:
        """Time since which the child has tasks without an answer; None if it has none."""

    def begin(self, child: ChildHandle) -> None:
        """Keep the child's handle, and start it.  The loop calls this first of all."""

    def started(self, pid: int) -> None:
        """Take note that the child runs as process ``pid``."""

    def received(self, message: Message) -> None:
        """Take a packet that the child sent on its task channel."""

    def recalled(self, seqs: list[int]) -> None:
        """Take the answer to ``recall``: the packets that the child will never read."""

    def draining(self) -> None:
        """Take note that the child's host is about to end: send the child no more tasks."""

    def exited(self, report: ExitReport) -> None:
        """Take note that the child ended or could not be started.  Called once, and last."""


class Child:
    """A child of this program.  It passes on the agent's reports to the child's owner.

    Runs on the loop thread.
    """

    def __init__(self, children: Children, owner: ChildOwner, grants: GrantSet) -> None:
        self.handle: ChildHandle | None = None
        self.owner = owner
        self.received = owner.received
        self.recalled = owner.recalled
        self.draining = owner.draining
        self._children = children
        self._grants = grants
        self._askers: list[Callable[[str], None]] = []
        self._on_measured: list[Callable[[], None]] = []

    def begin(self, handle: ChildHandle) -> None:
        """Start the child."""
        self.handle = handle
        self._children.add(self)
        self.owner.record = self._children.new_record(handle.name)
        self.owner.begin(handle)

    def started(self, pid: int) -> None:
        """Note that the child runs."""
        self._children.started(self, pid)
        self.owner.started(pid)

    def exited(self, report: ExitReport) -> None:
        """Release unused grants, and forget the child."""
        if self._grants:
            self._grants.release()
        self._children.exited(self, report)
        self._answer_measures()
        self.showed_stack(f"It has ended: {report.describe()}.")
        self.owner.exited(report)
        self.handle = None  # it has this object as its observer: a cycle

    def ask_for_stack(self, then: Callable[[str], None]) -> None:
        """Call ``then`` with the Python stacks of the child's threads, or why there are none."""
        assert self.handle is not None
        if self.handle.waiting:
            then("It waits for a host.")
            return
        self._askers.append(then)
        self.handle.signal(SHOW)

    def measure(self, then: Callable[[], None]) -> None:
        """Measure the child; call ``then`` when its record has the answer, or it has ended."""
        assert self.handle is not None
        self._on_measured.append(then)
        self.handle.measure()

    def measured(self, usage: Usage) -> None:
        """Note the child's memory and processor time."""
        if self.owner.record is not None:
            self.owner.record.memory, self.owner.record.cpu = usage
        self._answer_measures()

    def _answer_measures(self) -> None:
        waiting, self._on_measured = self._on_measured, []
        for then in waiting:
            then()

    def showed_stack(self, text: str) -> None:
        """Pass on the stacks to those that asked for them."""
        askers, self._askers = self._askers, []
        for then in askers:
            then(text)


class Children:
    """Children that were started and have not ended.  Runs on the loop thread.

    ``now`` returns the time for their records in the ``activity``.
    """

    def __init__(self, activity: Activity, now: Callable[[], float]) -> None:
        self._children: dict[Child, None] = {}
        self._activity = activity
        self._now = now

    def add(self, child: Child) -> None:
        """Note that a child is being started."""
        self._children[child] = None

    def new_record(self, name: str) -> ChildRecord:
        """Return the record of a child that is being started."""
        return self._activity.add_child(name, self._now())

    def started(self, child: Child, pid: int) -> None:
        """Note that a child runs."""
        handle, record = child.handle, child.owner.record
        if handle is not None and record is not None:
            self._activity.started(record, self._now(), handle.host, handle.node, pid)

    def remove(self, child: Child) -> None:
        """Forget a child."""
        self._children.pop(child, None)

    def exited(self, child: Child, report: ExitReport) -> None:
        """Forget a child that has ended, and complete its record."""
        self.remove(child)
        record = child.owner.record
        if record is not None:
            is_death = report.exitcode and child.owner.state != "leaving"
            reason = report.describe()[:_LONGEST_REASON] if is_death else ""
            record.host = report.host or record.host
            self._activity.ended(record, self._now(), reason)

    def __len__(self) -> int:
        return len(self._children)

    def __iter__(self) -> Iterator[Child]:
        return iter(list(self._children))
