"""Plan of a reconcile: which pods are created and deleted.

::

    pool, pods, knowledge, now
      |
      +- assessment   is a master there, alive, lost for good?  which pods failed?
      +- deletions    released, suspended, outdated, surplus, ended and counted
      +- creations    missing pods; at first only a few pods of a template that never worked
      +- problems     what is wrong
      +- status       conditions, counts and events

With and without a master
-------------------------
A master is attached while ``spec.master`` is set and its Lease has not been expired for longer
than its grace period.  Only the attached master knows which workers are idle.  Under
``ReleasedOnly`` the operator then deletes a running worker only if the master released it; this is
also how outdated workers are replaced.  A pod whose worker container does not run yet may always be
deleted.  Without a master no worker has work: the operator may delete any of them, and it replaces
outdated ones by itself, a quarter at a time.  ``suspend`` and ``Recreate`` apply in both cases.

A lost master keeps its pods until its grace period ends, but no pod is created for it unless
``onLost`` is ``Retain``.  When the grace period ends, ``Delete`` deletes the FiberPool,
``ScaleToMin`` wants ``minReplicas``, and ``Retain`` wants what ``replicas`` says.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from fiber_api.names import Reason
from fiber_api.v1alpha1 import FiberPool, FiberPoolStatus, Problem
from fiber_operator.planning import failures, messages, problems, status
from fiber_operator.planning.assessment import Assessment
from fiber_operator.planning.documents import items, mapping, text
from fiber_operator.planning.plans import Deletion, Knowledge, Obstacle, Plan, PoolEvent
from fiber_operator.planning.pods import PodState, PodView, Trouble
from fiber_operator.planning.problems import SECOND_LOOK, Situation
from fiber_operator.planning.status import Change, Outlook, PodCounts, events

# -- Choice of pods

CANARIES = 3
"""Pods that try out a template of which no pod was ever Ready."""

PATIENCE = 30.0
"""Seconds after which as many canaries again are created if none has a known problem."""


def outdated_to_replace(
    live: Sequence[PodView],
    *,
    template_hash: str,
    strategy: str,
    attached: bool,
    desired: int,
    proven: bool,
) -> list[PodView]:
    """Return the pods of an older template to delete now.

    ``OnDelete``: none.  ``Recreate``: all, with or without work.  ``OnIdle`` with an attached
    master: those that do not run yet; the master sees ``updatedReplicas`` and releases the others
    when they are idle.  ``OnIdle`` without a master: also those that were never Ready, and of the
    Ready ones a quarter at a time.  Until the new template is ``proven`` to work, these are at
    most as many as there are canaries.
    """
    outdated = [pod for pod in live if pod.template_hash != template_hash]
    if strategy == "OnDelete":
        return []
    if strategy == "Recreate":
        return outdated
    if attached:
        return _idle(outdated)
    fresh = [pod for pod in outdated if not pod.was_ready]
    unready = [pod for pod in outdated if pod.was_ready and pod.state is not PodState.READY]
    ready = [pod for pod in outdated if pod.state is PodState.READY]
    missing = desired - sum(pod.state is PodState.READY for pod in live)
    quarter = max(1, desired // 4)
    spare = max(0, (quarter if proven else min(quarter, CANARIES)) - max(0, missing))
    return fresh + unready + expendable(ready, template_hash)[:spare]


def _idle(pods: Sequence[PodView]) -> list[PodView]:
    """Return the pods that cannot have got work from a master."""
    return [pod for pod in pods if pod.state is PodState.PENDING]


def expendable(pods: Sequence[PodView], template_hash: str) -> list[PodView]:
    """Return ``pods`` in the order in which policy ``Any`` deletes them.

    Pending ones first, then outdated, not ready, those with the lowest deletion cost, the newest.
    """
    return sorted(
        pods,
        key=lambda pod: (
            pod.state is not PodState.PENDING,
            pod.template_hash == template_hash,
            pod.state is PodState.READY,
            pod.deletion_cost,
            -pod.created,
            pod.name,
        ),
    )


def excess_to_delete(
    live: Sequence[PodView], excess: int, *, template_hash: str, free_choice: bool
) -> list[PodView]:
    """Return the pods to delete because fewer are wanted.  They may be fewer than ``excess``."""
    if free_choice:
        candidates = expendable(live, template_hash)
    else:
        candidates = sorted(_idle(live), key=lambda pod: (-pod.created, pod.name))
    return candidates[: max(0, excess)]


def released_to_delete(
    pods: Sequence[PodView], released: Collection[str], *, floor: int, template_hash: str
) -> list[PodView]:
    """Return the released pods, except those that would be created again at once.

    The last ``floor`` live pods stay: a new worker in place of an idle one would be as idle, and
    released in turn.  Released pods of an older template are deleted, because that updates them.
    """
    named = [pod for pod in pods if pod.name in released]
    current = [pod for pod in named if pod.live and pod.template_hash == template_hash]
    others = [pod for pod in named if pod not in current]
    live = sum(pod.live for pod in pods) - sum(pod.live for pod in others)
    return others + expendable(current, template_hash)[: max(0, live - floor)]


@dataclass(frozen=True)
class Trial:
    """Number of pods of an unproven template that may be created now."""

    room: int | None = None
    """None: no limit."""
    again: float | None = None
    """Time at which more may be created if no pod changes until then."""


def assess_trial(
    current: Sequence[PodView], *, proven: bool, failing: bool, held_back: int, now: float
) -> Trial:
    """Return how many pods may join the ``current`` live pods of a template.

    A template is tried out until one of its pods is Ready.  If a pod cannot start, or if earlier
    ones are ``failing``, no more than ``CANARIES`` exist, including the failed ones that are
    ``held_back``.  Otherwise their number doubles every ``PATIENCE`` seconds, because an image may
    take long to fetch, and fetching it on three nodes does not help the others.  Unschedulable
    pods do not count.  While there are more of them than other pods, more pods are created, because
    a cluster autoscaler must see the whole demand.
    """
    if proven:
        return Trial()
    if failing or any(pod.trouble is Trouble.CANNOT_START for pod in current):
        return Trial(max(0, CANARIES - len(current) - held_back))
    turned_away = sum(pod.trouble is Trouble.UNSCHEDULABLE for pod in current)
    placed = len(current) - turned_away
    room = max(CANARIES, turned_away) - placed
    if room > 0:
        return Trial(room)
    due = max(pod.created for pod in current) + PATIENCE
    return Trial(placed) if now >= due else Trial(0, due)


KEPT = 3
"""Number of failed pods that are kept for ``kubectl logs``."""


def ended_to_delete(ended: Sequence[PodView], settled: Collection[str]) -> list[PodView]:
    """Return the ended pods to delete: the ``settled`` ones except the last that failed.

    A settled pod has been counted or need not be.  A pod whose other containers still run is not
    kept, because it would hold its resources.
    """
    failed = sorted(
        (p for p in ended if p.trouble is Trouble.APPLICATION and not p.lingers),
        key=lambda pod: (pod.since, pod.name),
    )
    kept = {pod.name for pod in failed[-KEPT:]}
    return [pod for pod in ended if pod.name not in kept and pod.name in settled]


# -- The plan

STUCK = 5.0
"""Seconds after which a pod's events are read if its status does not say why it waits."""

_ENDED: Mapping[Trouble | None, Reason] = {
    Trouble.COMPLETED: Reason.COMPLETED,
    Trouble.DISRUPTED: Reason.DISRUPTED,
}


def plan(pool: FiberPool, pods: Sequence[PodView], knowledge: Knowledge, now: float) -> Plan:
    """Plan the work that brings the cluster nearer to ``pool``.

    ``pods`` are all pods with the label of the pool's uid, from the informer; those that another
    controller owns are ignored.  Pure and total: the same arguments give an equal plan, and
    nothing that can stand in ``pods`` or in the pool's status makes it raise.
    """
    own = sorted(
        (p for p in pods if p.owner == pool.metadata.uid and p.name and p.uid),
        key=lambda pod: (pod.created, pod.name),
    )
    return _Planner(Assessment(pool, own, knowledge, now)).plan()


def plan_unreadable(
    document: Mapping[str, Any], pods: Sequence[PodView], errors: Sequence[str], now: float
) -> Plan:
    """Return the plan for a pool with an invalid spec: write a status, change no pod.

    ``document`` is the resource's JSON.  Each of ``errors`` names a field and says what is wrong.
    """
    return Plan(status=status.describe_unreadable(document, pods, errors, now))


def plan_blind(document: Mapping[str, Any], obstacle: Obstacle, now: float) -> Plan:
    """Return the plan for a pool whose pods cannot be listed: write a status, change no pod."""
    described = status.describe_blind(document, obstacle, now)
    said = {text(p.get("reason")) for p in items(mapping(document, "status").get("problems"))}
    news = described is not None and obstacle.reason not in said
    event = PoolEvent("Warning", obstacle.reason, obstacle.message)
    return Plan(status=described, events=(event,) if news else ())


class _Planner:
    """Planner of one plan."""

    def __init__(self, facts: Assessment) -> None:
        self._facts = facts
        self._spec = facts.spec
        self._account = facts.account
        self._deletions: dict[str, Deletion] = {}

    def plan(self) -> Plan:
        """Return the plan."""
        if (
            self._facts.master_state.gone
            and self._spec.on_lost == "Delete"
            and not self._facts.ends
        ):
            return self._delete_pool()
        if not self._facts.ends:
            self._delete()
        held_back = self._hold_back()
        dry_run = self._facts.may_create and not self._facts.accepted and not self._spec.suspend
        create, trial_ends = self._creations(held_back)
        found = problems.find(self._situation())
        after = self._status(found, create, judged=not dry_run)
        document = status.patch(self._facts.pool, after)
        deletions = tuple(self._deletions.values())
        change = Change(self._facts.pool.status, after, self._account, create, deletions)
        return Plan(
            create=create,
            batch_limit=self._spec.scale_up.max_in_flight,
            delete=deletions,
            dry_run=dry_run,
            template_hash=self._facts.template_hash,
            status=document,
            events=tuple(events(change, status_changes=document is not None)),
            inspect=tuple(self._to_inspect())[:1],
            requeue_at=self._requeue_at(found, trial_ends),
        )

    def _delete_pool(self) -> Plan:
        facts = self._facts
        assert facts.master_state.lost_since is not None
        message = messages.master_lost(
            facts.pool, facts.master_state.lost_since, facts.knowledge.master
        )
        event = PoolEvent("Warning", Reason.MASTER_LOST, message)
        after = self._status(problems.find(self._situation(deletes=True)), 0, judged=facts.accepted)
        return Plan(
            delete_pool=True,
            template_hash=facts.template_hash,
            status=status.patch(facts.pool, after),
            events=(event,),
        )

    # Deletions

    def _delete(self) -> None:
        facts, spec, attached = self._facts, self._spec, self._facts.master_state.attached
        if spec.suspend:
            self._take(facts.live + facts.ended, Reason.SUSPENDED)
        released = released_to_delete(
            facts.live + facts.ended,
            spec.scale_down.release,
            floor=facts.floor,
            template_hash=facts.template_hash,
        )
        self._take(released, Reason.RELEASED)
        late = [pod for pod in facts.late if pod.name in self._account.failures.counted]
        self._take(late, Reason.STARTUP_TIMEOUT, guarded=True)
        if facts.accepted and facts.may_create:
            self._take(self._outdated(), Reason.REPLACED, guarded=attached)
        free = spec.scale_down.policy == "Any" or not attached
        excess = excess_to_delete(
            self._remaining,
            len(self._remaining) - facts.desired,
            template_hash=facts.template_hash,
            free_choice=free,
        )
        self._take(excess, Reason.SCALED_DOWN, guarded=not free)
        settled = facts.expected.union(self._account.failures.counted)
        for pod in ended_to_delete(facts.ended, settled):
            self._take([pod], _ENDED.get(pod.trouble, Reason.CONTAINER_FAILED))

    def _outdated(self) -> list[PodView]:
        return outdated_to_replace(
            self._remaining,
            template_hash=self._facts.template_hash,
            strategy=self._spec.update.strategy,
            attached=self._facts.master_state.attached,
            desired=self._facts.desired,
            proven=self._account.proven == self._facts.template_hash,
        )

    def _take(self, pods: Sequence[PodView], reason: Reason, *, guarded: bool = False) -> None:
        for pod in pods:
            version = (pod.resource_version if guarded and not pod.was_ready else None) or None
            may_work = pod.live and version is None and reason != Reason.RELEASED
            self._deletions.setdefault(
                pod.name, Deletion(pod.name, pod.uid, version, reason, may_work)
            )

    @property
    def _remaining(self) -> list[PodView]:
        return [pod for pod in self._facts.live if pod.name not in self._deletions]

    # Creations

    def _hold_back(self) -> int:
        """Return how many failed workers are still wanted and not to be replaced yet."""
        missing = max(0, self._facts.desired - len(self._remaining))
        counted = self._account.failures
        if counted.waiting > missing:
            counted = counted.model_copy(update={"waiting": missing})
            self._account = replace(self._account, failures=counted)
        return min(self._account.held_back, missing)

    def _creations(self, held_back: int) -> tuple[int, float | None]:
        """Return how many pods to create now, and the time at which more may follow."""
        missing = self._facts.desired - len(self._remaining) - held_back
        if missing <= 0 or not self._facts.may_create or not self._facts.accepted:
            return 0, None
        current = [pod for pod in self._remaining if pod.template_hash == self._facts.template_hash]
        trial = assess_trial(
            current,
            proven=self._account.proven == self._facts.template_hash,
            failing=self._is_complained_of(current),
            held_back=held_back,
            now=self._facts.now,
        )
        return missing if trial.room is None else min(missing, trial.room), trial.again

    def _is_complained_of(self, pods: Sequence[PodView]) -> bool:
        complained = any(self._facts.knowledge.warnings.get(pod.name) for pod in pods)
        return complained or self._account.failures.waves > 0

    # Status

    def _situation(self, *, deletes: bool = False) -> Situation:
        facts, missing = self._facts, len(self._remaining) < self._facts.desired
        return Situation(
            pool=facts.pool,
            live=self._remaining,
            ended=facts.ended,
            account=self._account,
            master_state=facts.master_state,
            knowledge=facts.knowledge,
            template_hash=facts.template_hash,
            wants_more=missing,
            creates=facts.may_create and (missing or not facts.accepted),
            deletes=deletes or bool(self._deletions),
            now=facts.now,
        )

    def _status(self, found: tuple[Problem, ...], create: int, *, judged: bool) -> FiberPoolStatus:
        facts = self._facts
        outlook = Outlook(
            PodCounts.of(facts.pods, facts.desired, facts.template_hash),
            found,
            facts.master_state,
            judged=judged,
            create=create,
            delete_live=len(facts.live) - len(self._remaining),
            waits_until=failures.held_back_until(self._account.failures, facts.now),
            draining=0 if facts.ends else max(0, len(self._remaining) - facts.desired),
            replacing=self._to_be_replaced(),
            lease_unreadable=bool(facts.knowledge.master.unreadable),
        )
        return status.describe(facts, outlook, self._account)

    def _to_be_replaced(self) -> int:
        if self._spec.update.strategy == "OnDelete":
            return 0
        return sum(pod.template_hash != self._facts.template_hash for pod in self._facts.live)

    def _to_inspect(self) -> Iterator[str]:
        """Yield the pods whose events may explain a problem, most important first.

        Those that count as failed though they run come first, because they are deleted now.
        """
        yield from (p.name for p in self._account.failed[-1:] if p.state is not PodState.ENDED)
        yield from (p.name for p in self._silent() if self._facts.now >= p.created + STUCK)

    def _silent(self) -> list[PodView]:
        """Return pods that have a node and are not Ready, and whose status does not say why."""
        return [p for p in self._remaining if not p.was_ready and p.scheduled and not p.trouble]

    def _next_inspection(self, pod: PodView) -> float:
        """Return the time of the next look at a pod's events; the intervals double."""
        age = STUCK
        while pod.created + age <= self._facts.now:
            age *= 2
        return pod.created + age

    def _requeue_at(self, found: Sequence[Problem], trial_ends: float | None) -> float | None:
        timeout = self._spec.failure_policy.startup_timeout_seconds
        times = [
            trial_ends,
            self._account.recovery_at,
            self._facts.master_state.due,
            self._facts.idleness.due,
            self._facts.refused_until,
            failures.held_back_until(self._account.failures, self._facts.now),
            *(self._next_inspection(pod) for pod in self._silent()[:1]),
            *(pod.created + timeout for pod in self._remaining if not pod.was_ready),
            *(pod.since + timeout for pod in self._remaining if pod.state is PodState.STARTING),
            *(p.since + SECOND_LOOK for p in found if p.severity == "Warning" and p.since),
        ]
        return min(
            (time for time in times if time is not None and time > self._facts.now), default=None
        )
