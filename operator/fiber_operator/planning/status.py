"""Status of a pool: its conditions, phase and counts, and the events of a plan.

Equal input gives an equal status.  The planner writes a time into the status when something
happens, and keeps it until that happens again.  A field that depends on the present time needs a
time at which the pool is planned again, among those of ``Plan.requeue_at``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from fiber_api import names
from fiber_api.names import ConditionType, Phase, Reason
from fiber_api.signatures import master_statement
from fiber_api.times import format_time
from fiber_api.v1alpha1 import FiberPool, FiberPoolStatus, PoolCondition, Problem
from fiber_operator.planning import manifests, messages
from fiber_operator.planning.assessment import Assessment, MasterState
from fiber_operator.planning.documents import mapping, unless_ahead, whole
from fiber_operator.planning.failures import Account
from fiber_operator.planning.plans import Deletion, Obstacle, PoolEvent
from fiber_operator.planning.pods import PodState, PodView
from fiber_operator.planning.problems import SECOND_LOOK

# -- Conditions

Truth = Literal["True", "False", "Unknown"]


@dataclass(frozen=True)
class PodCounts:
    """Numbers of pods by state."""

    desired: int
    live: int
    ready: int
    joining: int
    """Pods that run and whose agents have not reached a master yet."""
    pending: int
    """Live pods that were never Ready."""
    terminating: int
    updated: int

    @classmethod
    def of(cls, pods: Sequence[PodView], desired: int, template_hash: str) -> PodCounts:
        """Count ``pods`` by their states."""
        live = [pod for pod in pods if pod.live]
        return cls(
            desired=desired,
            live=len(live),
            ready=sum(pod.state is PodState.READY and not pod.joining for pod in live),
            joining=sum(pod.joining for pod in live),
            pending=sum(not pod.was_ready for pod in live),
            terminating=sum(pod.state is PodState.TERMINATING for pod in pods),
            updated=sum(pod.template_hash == template_hash for pod in live),
        )


@dataclass(frozen=True)
class Outlook:
    """Input of the conditions: the pool's state, its problems, and the work of the plan."""

    counts: PodCounts
    problems: tuple[Problem, ...]
    master_state: MasterState
    judged: bool = True
    """False while a dry run of the template is needed."""
    create: int = 0
    delete_live: int = 0
    """Live pods that are deleted now."""
    waits_until: float | None = None
    """Time before which failed workers are not replaced."""
    draining: int = 0
    """Number of surplus workers; only the master knows which are idle."""
    replacing: int = 0
    """Live pods of an older template that will be replaced, now or when they are idle."""
    lease_unreadable: bool = False
    """True if the operator lacks the right to read the master's Lease."""

    @property
    def worst(self) -> Problem | None:
        """First problem with severity Error."""
        return next((p for p in self.problems if p.severity == "Error"), None)

    def problem(self, *reasons: str) -> Problem | None:
        """Return the worst problem with one of these reasons."""
        return next((p for p in self.problems if p.reason in reasons), None)


@dataclass(frozen=True)
class Finding:
    """Condition without its history."""

    type: ConditionType
    status: Truth
    reason: str
    message: str = ""
    since: float | None = None
    """Time of its last transition, if that does not follow from the condition's history."""


def conditions(pool: FiberPool, outlook: Outlook, now: float) -> tuple[PoolCondition, ...]:
    """Return all conditions.  A condition keeps its time while its status is unchanged."""
    before = {condition.type: condition for condition in pool.status.conditions}
    return tuple(
        dated(finding, before.get(finding.type), pool.metadata.generation, now)
        for finding in _findings(pool, outlook)
    )


def dated(
    finding: Finding, before: PoolCondition | None, generation: int, now: float
) -> PoolCondition:
    """Return the condition of a finding, with the time of its last transition."""
    same = before is not None and before.status == finding.status
    since = finding.since
    if since is None and before is not None and same:
        since = unless_ahead(before.last_transition_time, now)
    return PoolCondition(
        type=finding.type,
        status=finding.status,
        reason=finding.reason,
        message=finding.message,
        last_transition_time=since or float(math.floor(now)),
        observed_generation=generation,
    )


def phase(pool: FiberPool, found: Sequence[PoolCondition], outlook: Outlook) -> Phase:
    """Return the phase, which sums up the conditions in one word."""
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
        message = "the API server has not accepted a pod of this template yet"
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
            f"surplus workers: {outlook.draining} of {counts.live}; only the master knows which "
            "are idle; they are deleted when it names them in spec.scaleDown.release"
        )
        return Finding(kind, "True", Reason.DRAINING, message)
    if outlook.create:
        return Finding(kind, "True", Reason.CREATING, lack)
    if outlook.waits_until is not None:
        message = f"{lack}; failed ones are not replaced before {format_time(outlook.waits_until)}"
        return Finding(kind, "True", Reason.BACKING_OFF, message)
    if outlook.replacing:
        message = f"workers of an older template: {outlook.replacing}"
        return Finding(kind, "True", Reason.UPDATING, message)
    if counts.pending:
        return Finding(kind, "True", Reason.STARTING, f"workers starting: {counts.pending}")
    if counts.joining:
        message = f"workers without an answer from a master yet: {counts.joining}"
        return Finding(kind, "True", Reason.STARTING, message)
    if ending := counts.terminating + outlook.delete_live:
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
    kind, master_state = ConditionType.MASTER_ALIVE, outlook.master_state
    if master_state.alive is None:
        return _master_unknown(pool, outlook)
    if master_state.alive:
        return Finding(kind, "True", Reason.LEASE_RENEWED)
    lost = outlook.problem(Reason.MASTER_LOST)
    message = lost.message if lost else ""
    # Not the time at which an earlier master was lost: this master has a new grace period.
    return Finding(kind, "False", Reason.MASTER_LOST, message, master_state.lost_since)


def _master_unknown(pool: FiberPool, outlook: Outlook) -> Finding:
    kind, master = ConditionType.MASTER_ALIVE, pool.spec.master
    if master is None:
        return Finding(kind, "Unknown", Reason.NO_MASTER, "the pool waits for a master")
    if master.lease_name is None:
        message = "spec.master.leaseName is absent: the master is not checked"
        return Finding(kind, "Unknown", Reason.LEASE_NOT_CHECKED, message)
    if outlook.lease_unreadable:
        message = f"the operator lacks the right to read the Lease {master.lease_name}"
        return Finding(kind, "Unknown", Reason.FORBIDDEN, message)
    if problem := outlook.problem(Reason.LEASE_NOT_FOUND):
        return Finding(kind, "Unknown", Reason.LEASE_NOT_FOUND, problem.message)
    message = f"the Lease {master.lease_name} has not changed since the operator began to watch it"
    return Finding(kind, "Unknown", Reason.LEASE_NOT_CHECKED, message)


def _scaling_limited(pool: FiberPool) -> Finding:
    kind, spec = ConditionType.SCALING_LIMITED, pool.spec
    if spec.replicas > spec.max_replicas:
        message = f"replicas is {spec.replicas} and maxReplicas is {spec.max_replicas}"
        return Finding(kind, "True", Reason.ABOVE_MAXIMUM, message)
    if 0 < spec.replicas < spec.min_replicas:  # replicas 0 is the normal state of a warm pool
        message = f"replicas is {spec.replicas} and minReplicas is {spec.min_replicas}"
        return Finding(kind, "True", Reason.BELOW_MINIMUM, message)
    return Finding(kind, "False", Reason.WITHIN_BOUNDS)


def _suspended(pool: FiberPool) -> Finding:
    if pool.spec.suspend:
        message = "spec.suspend is true: the pool has no workers"
        return Finding(ConditionType.SUSPENDED, "True", Reason.SUSPENDED, message)
    return Finding(ConditionType.SUSPENDED, "False", Reason.NOT_SUSPENDED)


# -- The status document


def describe(facts: Assessment, outlook: Outlook, account: Account) -> FiberPoolStatus:
    """Return the status that the pool should have.

    ``account`` is that of ``facts``, with the plan's changes.
    """
    pool, knowledge = facts.pool, facts.knowledge
    before, counts, master = pool.status, outlook.counts, pool.spec.master
    found = conditions(pool, outlook, facts.now)
    epoch = master.epoch if master and knowledge.led else 0
    leads_to = names.address_of(master.host, master.port) if master else None
    secret = pool.credentials_secret if knowledge.credentials else None
    return FiberPoolStatus(
        observed_generation=pool.metadata.generation,
        phase=phase(pool, found, outlook),
        desired_replicas=counts.desired,
        replicas=counts.live,
        ready_replicas=counts.ready,
        connected_replicas=_connected(outlook),
        pending_replicas=counts.pending,
        terminating_replicas=counts.terminating,
        updated_replicas=counts.updated,
        selector=manifests.selector(pool),
        endpoint=names.endpoint_of(knowledge.address) if knowledge.address else before.endpoint,
        master=leads_to if knowledge.led else before.master,
        relay=before.relay if knowledge.relay is None else knowledge.relay or None,
        master_epoch=max(epoch, before.master_epoch or 0) or None,
        master_signature=_master_signature(facts),
        public_key=_public_key(facts),
        idle_since=facts.idleness.since,
        credentials_secret=before.credentials_secret if knowledge.credentials is None else secret,
        template_hash=facts.template_hash,
        proven_template_hash=account.proven,
        failures=account.failures,
        problems=outlook.problems,
        conditions=found,
    )


def _public_key(facts: Assessment) -> str | None:
    if (secret := facts.knowledge.secret) is None:
        return None if facts.knowledge.credentials is False else facts.pool.status.public_key
    return secret.signer.public_key.hex() if secret.signer else None


def _master_signature(facts: Assessment) -> str | None:
    """Return the signature for the master that the EndpointSlice leads to, if it asks for one."""
    master, secret, before = facts.pool.spec.master, facts.knowledge.secret, facts.pool.status
    if master is None or master.certificate is None:
        return None
    if facts.knowledge.credentials is False:
        return None
    if secret is None or not facts.knowledge.led:
        return before.master_signature if before.master_epoch == master.epoch else None
    if secret.signer is None:
        return None
    statement = master_statement(master.epoch, bytes.fromhex(master.certificate))
    return secret.signer.sign(statement).hex()


def _connected(outlook: Outlook) -> int | None:
    # The number in a Lease may be older than the end of a pod, and a program wrote it.
    known = outlook.master_state.connected
    return None if known is None else min(known, outlook.counts.live)


def patch(pool: FiberPool, status: FiberPoolStatus) -> dict[str, Any] | None:
    """Return the patch of the status, with None for fields to remove; None if nothing changes.

    Fields of the old status that could not be read are written over.
    """
    if status == pool.status and not pool.unread:
        return None
    return status.model_dump(mode="json", by_alias=True)


def describe_unreadable(
    document: Mapping[str, Any], pods: Sequence[PodView], errors: Sequence[str], now: float
) -> dict[str, Any] | None:
    """Return the status of a pool with an invalid spec: the old status and the problem."""
    before, unread = FiberPoolStatus.salvage(document.get("status") or {})
    message = (
        f"The operator cannot read this FiberPool: {'; '.join(errors)}. Correct what is named; "
        "until then nothing is created or deleted."
    )
    generation = whole(mapping(document, "metadata").get("generation"))
    kept = [c for c in before.conditions if c.type not in _UNREADABLE]
    replaced = [
        dated(
            Finding(kind, truth, Reason.INVALID_SPEC, message),
            next((c for c in before.conditions if c.type == kind), None),
            generation,
            now,
        )
        for kind, truth in _UNREADABLE.items()
    ]
    counts = PodCounts.of(pods, before.desired_replicas or 0, before.template_hash or "")
    known = next((p for p in before.problems if p.reason == Reason.INVALID_SPEC), None)
    problem = Problem(
        reason=Reason.INVALID_SPEC,
        severity="Error",
        terminal=True,
        since=(unless_ahead(known.since, now) if known else None) or float(math.floor(now)),
        message=message,
    )
    after = before.model_copy(
        update={
            "observed_generation": generation,
            "phase": Phase.FAILED,
            "replicas": counts.live,
            "ready_replicas": counts.ready,
            "pending_replicas": counts.pending,
            "terminating_replicas": counts.terminating,
            "problems": (problem,),
            "conditions": (*replaced, *kept),
        }
    )
    if after == before and not unread:
        return None
    return after.model_dump(mode="json", by_alias=True)


def describe_blind(
    document: Mapping[str, Any], obstacle: Obstacle, now: float
) -> dict[str, Any] | None:
    """Return the status of a pool whose pods cannot be listed: the old status and the problem.

    ``observedGeneration`` stays, because changes since then are not carried out.
    """
    before, unread = FiberPoolStatus.salvage(document.get("status") or {})
    problem = _lasting(obstacle, before, now)
    others = [p for p in before.problems if p.reason != problem.reason]
    update: dict[str, Any] = {
        "phase": before.phase or Phase.PENDING,
        "problems": (problem, *others)[: names.MAX_PROBLEMS],
    }
    if problem.severity == "Error":
        generation = whole(mapping(document, "metadata").get("generation"))
        known = {condition.type: condition for condition in before.conditions}
        replaced = [
            dated(Finding(kind, truth, problem.reason, problem.message), found, generation, now)
            for kind, truth in _BLIND.items()
            for found in [known.pop(kind, None)]
        ]
        update["conditions"] = (*replaced, *known.values())
        if before.phase not in (Phase.TERMINATING, Phase.SUSPENDED, Phase.FAILED):
            update["phase"] = Phase.DEGRADED
    after = before.model_copy(update=update)
    if after == before and not unread:
        return None
    return after.model_dump(mode="json", by_alias=True)


def _lasting(obstacle: Obstacle, before: FiberPoolStatus, now: float) -> Problem:
    known = next((p for p in before.problems if p.reason == obstacle.reason), None)
    since = (unless_ahead(known.since, now) if known else None) or float(math.floor(now))
    was_error = known is not None and known.severity == "Error"
    lasts = was_error or now - since >= SECOND_LOOK or obstacle.reason != Reason.API_UNAVAILABLE
    return Problem(
        reason=obstacle.reason,
        severity="Error" if lasts else "Warning",
        since=since,
        message=obstacle.message,
    )


_BLIND: Mapping[ConditionType, Truth] = {
    ConditionType.READY: "Unknown",
    ConditionType.DEGRADED: "True",
}
"""Conditions that change while the operator cannot list the pods.  Others keep their values."""

_UNREADABLE: Mapping[ConditionType, Truth] = {
    ConditionType.ACCEPTED: "False",
    ConditionType.DEGRADED: "True",
}
"""Conditions that change while the operator cannot read the spec.  Others keep their values."""


# -- Events of a plan


@dataclass(frozen=True)
class Change:
    """Change from one status to the next, and the work between them."""

    before: FiberPoolStatus
    after: FiberPoolStatus
    account: Account
    create: int
    delete: Sequence[Deletion]


def events(change: Change, *, status_changes: bool) -> Iterator[PoolEvent]:
    """Yield events for the work and, if ``status_changes``, for the news in it."""
    yield from _actions(change)
    if status_changes:
        yield from _disruptions(change)
        yield from _problems(change)
        yield from _masters(change)
        yield from _relays(change)


_DELETIONS = {
    Reason.RELEASED: "Deleting workers that the master released",
    Reason.SCALED_DOWN: "Deleting workers: fewer are wanted",
    Reason.REPLACED: "Deleting workers of an older template",
    Reason.COMPLETED: "Deleting workers that had ended with exit code 0",
    Reason.SUSPENDED: "Deleting workers: the pool is suspended",
}


def _actions(change: Change) -> Iterator[PoolEvent]:
    # Without numbers: a repeated event with equal words only raises a count.
    reasons = {deletion.reason for deletion in change.delete}
    for reason, said in _DELETIONS.items():
        if reason in reasons:
            yield PoolEvent("Normal", reason, said)
    if change.create:
        yield PoolEvent("Normal", Reason.SCALED_UP, "Creating workers: more are wanted")


def _disruptions(change: Change) -> Iterator[PoolEvent]:
    disrupted = change.account.disrupted
    if not disrupted:
        return
    pod = disrupted[-1]
    others = f" and {len(disrupted) - 1} more" if len(disrupted) > 1 else ""
    words = " ".join(filter(None, (pod.reason, pod.message)))
    message = f"The cluster ended {pod.name}{others}{messages.quoted(words)}"
    yield PoolEvent("Normal", Reason.DISRUPTED, f"{message}. A new worker replaces it at once")


def _problems(change: Change) -> Iterator[PoolEvent]:
    known = {(problem.reason, problem.severity) for problem in change.before.problems}
    failed = {pod.name for pod in change.account.failed}
    for problem in change.after.problems:
        if (problem.reason, problem.severity) not in known or problem.pod in failed:
            yield PoolEvent("Warning", problem.reason, _without_output(problem.message))
    if _was_degraded(change.before) == "True" and _was_degraded(change.after) == "False":
        yield PoolEvent("Normal", Reason.RECOVERED, "The pool has no problem now")


def _masters(change: Change) -> Iterator[PoolEvent]:
    before, after = change.before, change.after
    if (before.master, before.master_epoch) == (after.master, after.master_epoch):
        return
    if after.master:
        way = " through a relay" if after.relay else ""
        message = f"Workers dial the master at {after.master}, epoch {after.master_epoch}{way}"
    else:
        message = "The master has left; the workers wait for the next one"
    yield PoolEvent("Normal", Reason.MASTER_CHANGED, message)


def _relays(change: Change) -> Iterator[PoolEvent]:
    before, after = change.before.relay, change.after.relay
    if after and not before:
        message = f"Workers dial the relay {after}, since pods cannot reach the master"
        yield PoolEvent("Normal", Reason.RELAY_STARTED, message)
    elif before and not after:
        yield PoolEvent("Normal", Reason.RELAY_REMOVED, f"The relay {before} was removed")


def _without_output(message: str) -> str:
    """Return ``message`` without a worker's last lines.

    These may be confidential.  Events and the operator's log have more readers than the status and
    the pod's log, for which a reader needs the right to read pools and pods.
    """
    return message.partition(messages.LAST_LINES)[0]


def _was_degraded(status: FiberPoolStatus) -> str:
    found = (c.status for c in status.conditions if c.type == ConditionType.DEGRADED)
    return next(found, "Unknown")
