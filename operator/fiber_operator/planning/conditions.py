"""The conditions of a pool, and its phase: what is so, in words for programs and for people."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from fiber_api.names import ConditionType, Phase, Reason
from fiber_api.times import format_time
from fiber_api.v1alpha1 import Condition, FiberPool, Problem
from fiber_operator.planning.attachment import Attachment
from fiber_operator.planning.documents import past
from fiber_operator.planning.pods import PodView, State

Truth = Literal["True", "False", "Unknown"]


@dataclass(frozen=True)
class Counts:
    """Numbers of pods by state."""

    desired: int
    live: int
    ready: int
    joining: int
    """Pods that run, and whose agents have not reached a master yet."""
    pending: int
    """Live and never Ready."""
    terminating: int
    updated: int

    @classmethod
    def of(cls, pods: Sequence[PodView], desired: int, template_hash: str) -> Counts:
        """Count them."""
        live = [pod for pod in pods if pod.live]
        return cls(
            desired=desired,
            live=len(live),
            ready=sum(pod.state is State.READY and not pod.joining for pod in live),
            joining=sum(pod.joining for pod in live),
            pending=sum(not pod.was_ready for pod in live),
            terminating=sum(pod.state is State.TERMINATING for pod in pods),
            updated=sum(pod.template_hash == template_hash for pod in live),
        )


@dataclass(frozen=True)
class Outlook:
    """State of the pool, and what is about to happen."""

    counts: Counts
    problems: tuple[Problem, ...]
    attachment: Attachment
    judged: bool = True
    """True if the API server has judged the template, as far as that matters."""
    create: int = 0
    delete: int = 0
    """Live pods that go now."""
    waits_until: float | None = None
    """Workers that failed are not replaced before this time."""
    draining: int = 0
    """Workers more than wanted, of which only the master may say which are idle."""
    replacing: int = 0
    """Live pods of an older template that are to be replaced, now or when they are idle."""
    lease_unreadable: bool = False
    """True if there is no right to read the master's Lease."""

    @property
    def worst(self) -> Problem | None:
        """The first problem that is an error."""
        return next((p for p in self.problems if p.severity == "Error"), None)

    def problem(self, *reasons: str) -> Problem | None:
        """The worst of these."""
        return next((p for p in self.problems if p.reason in reasons), None)


@dataclass(frozen=True)
class Finding:
    """Condition without its history."""

    type: ConditionType
    status: Truth
    reason: str
    message: str = ""
    since: float | None = None
    """Time since when, if that is known otherwise than from the condition's history."""


def conditions(pool: FiberPool, outlook: Outlook, now: float) -> tuple[Condition, ...]:
    """All of them; a condition keeps its time while its status stays as it is."""
    before = {condition.type: condition for condition in pool.status.conditions}
    return tuple(
        dated(finding, before.get(finding.type), pool.metadata.generation, now)
        for finding in _findings(pool, outlook)
    )


def dated(finding: Finding, before: Condition | None, generation: int, now: float) -> Condition:
    """A finding with the time since when it is so."""
    same = before is not None and before.status == finding.status
    since = finding.since
    if since is None and before is not None and same:
        since = past(before.last_transition_time, now)
    return Condition(
        type=finding.type,
        status=finding.status,
        reason=finding.reason,
        message=finding.message,
        last_transition_time=since or float(math.floor(now)),
        observed_generation=generation,
    )


def phase(pool: FiberPool, found: Sequence[Condition], outlook: Outlook) -> Phase:
    """The conditions in one word."""
    status = {condition.type: condition.status for condition in found}
    if pool.metadata.deletion_timestamp is not None:
        return Phase.TERMINATING
    if status[ConditionType.SUSPENDED] == "True":
        return Phase.SUSPENDED
    if outlook.problem(*_FINAL):
        return Phase.FAILED
    if status[ConditionType.DEGRADED] == "True":
        return Phase.DEGRADED
    if not outlook.judged and not outlook.counts.live:
        return Phase.PENDING
    if status[ConditionType.READY] != "True" or status[ConditionType.PROGRESSING] == "True":
        return Phase.SCALING
    return Phase.READY


_FINAL = (Reason.BACKOFF_LIMIT_EXCEEDED, Reason.INVALID_TEMPLATE)

_UNACCEPTABLE = (
    Reason.INVALID_SPEC,
    Reason.INVALID_TEMPLATE,
    Reason.FORBIDDEN,
    Reason.REQUESTS_MISSING,
    Reason.NAME_TAKEN,
    Reason.INVALID_CREDENTIALS,
)


def _findings(pool: FiberPool, outlook: Outlook) -> Iterator[Finding]:
    yield _accepted(outlook)
    yield _ready(pool, outlook)
    yield _progressing(pool, outlook)
    yield _degraded(outlook)
    yield _master_alive(pool, outlook)
    yield _scaling_limited(pool)
    yield _suspended(pool)


def _accepted(outlook: Outlook) -> Finding:
    kind = ConditionType.ACCEPTED
    problem = outlook.problem(*_UNACCEPTABLE)
    if problem is not None and problem.severity == "Error":
        return Finding(kind, "False", problem.reason, problem.message)
    if not outlook.judged:
        message = "the API server has not said yet whether it takes pods of this template"
        return Finding(kind, "Unknown", Reason.NOT_JUDGED, message)
    return Finding(kind, "True", Reason.AS_EXPECTED)


def _ready(pool: FiberPool, outlook: Outlook) -> Finding:
    kind, counts = ConditionType.READY, outlook.counts
    if pool.spec.suspend:
        return Finding(kind, "False", Reason.SUSPENDED)
    if counts.desired == 0:
        return Finding(kind, "True", Reason.SCALED_TO_ZERO, "no workers are wanted")
    message = f"workers ready: {counts.ready} of {counts.desired}"
    if counts.ready >= counts.desired:
        return Finding(kind, "True", Reason.AS_EXPECTED, message)
    if worst := outlook.worst:
        return Finding(kind, "False", worst.reason, message)
    if outlook.waits_until is not None:
        reason = Reason.BACKING_OFF
    else:
        reason = Reason.CREATING if counts.live < counts.desired else Reason.STARTING
    return Finding(kind, "False", reason, message)


def _progressing(pool: FiberPool, outlook: Outlook) -> Finding:
    kind, counts = ConditionType.PROGRESSING, outlook.counts
    missing = max(0, counts.desired - counts.live)
    lack = f"workers missing: {missing} of {counts.desired}"
    if pool.metadata.deletion_timestamp is not None:
        return Finding(kind, "True", Reason.TERMINATING, "the pool is being deleted")
    if outlook.draining:
        message = (
            f"workers not wanted any more: {outlook.draining} of {counts.live}; only the master "
            "knows which are idle, and they go when it names them in spec.scaleDown.release"
        )
        return Finding(kind, "True", Reason.DRAINING, message)
    if outlook.create:
        return Finding(kind, "True", Reason.CREATING, lack)
    if outlook.waits_until is not None:
        message = (
            f"{lack}; those that failed are not replaced before {format_time(outlook.waits_until)}"
        )
        return Finding(kind, "True", Reason.BACKING_OFF, message)
    if outlook.replacing:
        message = f"workers of an older template: {outlook.replacing}"
        return Finding(kind, "True", Reason.UPDATING, message)
    if counts.pending:
        return Finding(kind, "True", Reason.STARTING, f"workers starting: {counts.pending}")
    if counts.joining:
        message = f"workers that no master has answered yet: {counts.joining}"
        return Finding(kind, "True", Reason.STARTING, message)
    if ending := counts.terminating + outlook.delete:
        return Finding(kind, "True", Reason.DELETING, f"workers ending: {ending}")
    if missing and (worst := outlook.worst):
        return Finding(kind, "False", worst.reason, lack)
    return Finding(kind, "False", Reason.AS_EXPECTED)


def _degraded(outlook: Outlook) -> Finding:
    kind = ConditionType.DEGRADED
    if worst := outlook.worst:
        return Finding(kind, "True", worst.reason, worst.message)
    return Finding(kind, "False", Reason.AS_EXPECTED)


def _master_alive(pool: FiberPool, outlook: Outlook) -> Finding:
    kind, attachment = ConditionType.MASTER_ALIVE, outlook.attachment
    if attachment.alive is None:
        return _master_unknown(pool, outlook)
    if attachment.alive:
        return Finding(kind, "True", Reason.LEASE_RENEWED)
    lost = outlook.problem(Reason.MASTER_LOST)
    message = lost.message if lost else ""
    # Not the time at which an earlier master was lost: this one has its own grace.
    return Finding(kind, "False", Reason.MASTER_LOST, message, attachment.lost_since)


def _master_unknown(pool: FiberPool, outlook: Outlook) -> Finding:
    kind, master = ConditionType.MASTER_ALIVE, pool.spec.master
    if master is None:
        return Finding(kind, "Unknown", Reason.NO_MASTER, "the pool waits for a master")
    if master.lease_name is None:
        message = "spec.master.leaseName is absent: nobody checks it"
        return Finding(kind, "Unknown", Reason.LEASE_NOT_CHECKED, message)
    if outlook.lease_unreadable:
        message = f"the operator may not read the Lease {master.lease_name}"
        return Finding(kind, "Unknown", Reason.FORBIDDEN, message)
    if problem := outlook.problem(Reason.LEASE_NOT_FOUND):
        return Finding(kind, "Unknown", Reason.LEASE_NOT_FOUND, problem.message)
    message = f"the Lease {master.lease_name} was not seen to change yet"
    return Finding(kind, "Unknown", Reason.LEASE_NOT_CHECKED, message)


def _scaling_limited(pool: FiberPool) -> Finding:
    kind, spec = ConditionType.SCALING_LIMITED, pool.spec
    if spec.replicas > spec.max_replicas:
        message = f"{spec.replicas} workers are asked for and maxReplicas is {spec.max_replicas}"
        return Finding(kind, "True", Reason.ABOVE_MAXIMUM, message)
    if 0 < spec.replicas < spec.min_replicas:  # nobody who asks for none is told that some are
        message = f"{spec.replicas} workers are asked for and minReplicas is {spec.min_replicas}"
        return Finding(kind, "True", Reason.BELOW_MINIMUM, message)
    return Finding(kind, "False", Reason.WITHIN_BOUNDS)


def _suspended(pool: FiberPool) -> Finding:
    if pool.spec.suspend:
        message = "spec.suspend is true: the pool has no workers"
        return Finding(ConditionType.SUSPENDED, "True", Reason.SUSPENDED, message)
    return Finding(ConditionType.SUSPENDED, "False", Reason.NOT_SUSPENDED)
