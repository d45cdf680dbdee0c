"""The only place where it is decided which pods are created and deleted.

::

    pool, pods, memory, now
      │
      ├─ attachment   is a master there, alive, lost for good?
      ├─ scaling      who goes: released, suspended, outdated, too many, ended and looked at
      ├─ failures     who failed since the last look; when their places are taken again
      ├─ scaling      who comes: as many as are missing, a few of a template that never worked
      ├─ problems     what is wrong
      └─ status       what to say of all that, and events what to announce

What with and without a master
------------------------------
While a master is attached (``spec.master`` is set and its Lease is not known to have been expired
for longer than its grace) a Ready worker may be at work.  Under ``ReleasedOnly`` it is deleted
only when released; an outdated one is then replaced by the next creation.  With no master, or one
that is lost for good, no worker is at work: lowering ``replicas`` takes any, and outdated ones are
replaced by themselves, a quarter at a time.  ``suspend`` and ``Recreate`` are a person's order and
stop for nobody.

A master that is lost keeps everything it has until its grace is over; nothing new is created for
it, unless ``onLost`` is ``Retain``.  Then ``Delete`` deletes the FiberPool, ``ScaleToMin`` wants
``minReplicas``, ``Retain`` wants what ``replicas`` says.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from fiber_api.names import Reason
from fiber_api.v1alpha1 import FiberPool, FiberPoolStatus, Problem
from fiber_operator.planning import failures, problems, scaling, status, wording
from fiber_operator.planning.assessment import Assessment
from fiber_operator.planning.conditions import Counts, Outlook
from fiber_operator.planning.documents import items, mapping, text
from fiber_operator.planning.events import Change, events
from fiber_operator.planning.plans import Deletion, Event, Memory, Obstacle, Plan
from fiber_operator.planning.pods import PodView, State, Trouble
from fiber_operator.planning.situation import SECOND_LOOK, Situation

STUCK = 5.0
"""Seconds after which a pod's events are looked at, if its status does not say why it waits."""

_ENDED: Mapping[Trouble | None, Reason] = {
    Trouble.COMPLETED: Reason.COMPLETED,
    Trouble.DISRUPTED: Reason.DISRUPTED,
}


def plan(pool: FiberPool, pods: Sequence[PodView], memory: Memory, now: float) -> Plan:
    """Plan the work that brings the cluster nearer to ``pool``.

    ``pods`` are all pods with the label of the pool's uid, from a fresh list; those that another
    controller owns are ignored.  Pure and total: the same arguments give an equal plan, and
    nothing that can stand in ``pods`` or in the pool's status makes it raise.
    """
    own = sorted(
        (p for p in pods if p.owner == pool.metadata.uid and p.name and p.uid),
        key=lambda pod: (pod.created, pod.name),
    )
    return _Planner(Assessment(pool, own, memory, now)).plan()


def plan_unreadable(
    document: Mapping[str, Any], pods: Sequence[PodView], errors: Sequence[str], now: float
) -> Plan:
    """The plan for a pool whose spec the operator cannot read: say so, touch no pod.

    ``document`` is the resource's JSON, ``errors`` what is wrong, each naming its field.
    """
    return Plan(status=status.describe_unreadable(document, pods, errors, now))


def plan_blind(document: Mapping[str, Any], obstacle: Obstacle, now: float) -> Plan:
    """The plan for a pool whose pods cannot be listed: say so, touch no pod."""
    described = status.describe_blind(document, obstacle, now)
    said = {text(p.get("reason")) for p in items(mapping(document, "status").get("problems"))}
    news = described is not None and obstacle.reason not in said
    event = Event("Warning", obstacle.reason, obstacle.message)
    return Plan(status=described, events=(event,) if news else ())


class _Planner:
    """Planner of one plan."""

    def __init__(self, facts: Assessment) -> None:
        self._facts = facts
        self._spec = facts.spec
        self._account = facts.account
        self._deletions: dict[str, Deletion] = {}

    def plan(self) -> Plan:
        """The whole of it."""
        if self._facts.attachment.gone and self._spec.on_lost == "Delete" and not self._facts.ends:
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
            events=tuple(events(change, told=document is not None)),
            inspect=tuple(self._to_inspect())[:1],
            requeue_at=self._requeue_at(found, trial_ends),
        )

    def _delete_pool(self) -> Plan:
        facts = self._facts
        assert facts.attachment.lost_since is not None
        message = wording.master_lost(facts.pool, facts.attachment.lost_since, facts.memory.master)
        event = Event("Warning", Reason.MASTER_LOST, message)
        after = self._status(problems.find(self._situation(deletes=True)), 0, judged=facts.accepted)
        return Plan(
            delete_pool=True,
            template_hash=facts.template_hash,
            status=status.patch(facts.pool, after),
            events=(event,),
        )

    # Who goes

    def _delete(self) -> None:
        facts, spec, attached = self._facts, self._spec, self._facts.attachment.attached
        if spec.suspend:
            self._take(facts.live + facts.ended, Reason.SUSPENDED)
        released = scaling.released_to_delete(
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
        excess = scaling.excess_to_delete(
            self._remaining,
            len(self._remaining) - facts.desired,
            template_hash=facts.template_hash,
            free_choice=free,
        )
        self._take(excess, Reason.SCALED_DOWN, guarded=not free)
        settled = facts.expected.union(self._account.failures.counted)
        for pod in scaling.ended_to_delete(facts.ended, settled):
            self._take([pod], _ENDED.get(pod.trouble, Reason.CONTAINER_FAILED))

    def _outdated(self) -> list[PodView]:
        return scaling.outdated_to_replace(
            self._remaining,
            template_hash=self._facts.template_hash,
            strategy=self._spec.update.strategy,
            attached=self._facts.attachment.attached,
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

    # Who comes

    def _hold_back(self) -> int:
        """Places of workers that failed, which are not to be taken yet and are still wanted."""
        missing = max(0, self._facts.desired - len(self._remaining))
        found = self._account.failures
        if found.waiting > missing:
            found = found.model_copy(update={"waiting": missing})
            self._account = replace(self._account, failures=found)
        return min(self._account.held_back, missing)

    def _creations(self, held_back: int) -> tuple[int, float | None]:
        """Return how many pods to create now, and when more may follow."""
        missing = self._facts.desired - len(self._remaining) - held_back
        if missing <= 0 or not self._facts.may_create or not self._facts.accepted:
            return 0, None
        current = [pod for pod in self._remaining if pod.template_hash == self._facts.template_hash]
        trial = scaling.trial(
            current,
            proven=self._account.proven == self._facts.template_hash,
            failing=self._is_complained_of(current),
            held_back=held_back,
            now=self._facts.now,
        )
        return missing if trial.room is None else min(missing, trial.room), trial.again

    def _is_complained_of(self, pods: Sequence[PodView]) -> bool:
        complained = any(self._facts.memory.warnings.get(pod.name) for pod in pods)
        return complained or self._account.failures.waves > 0

    # What to say

    def _situation(self, *, deletes: bool = False) -> Situation:
        facts, missing = self._facts, len(self._remaining) < self._facts.desired
        return Situation(
            pool=facts.pool,
            live=self._remaining,
            ended=facts.ended,
            account=self._account,
            attachment=facts.attachment,
            memory=facts.memory,
            template_hash=facts.template_hash,
            wants_more=missing,
            creates=facts.may_create and (missing or not facts.accepted),
            deletes=deletes or bool(self._deletions),
            now=facts.now,
        )

    def _status(self, found: tuple[Problem, ...], create: int, *, judged: bool) -> FiberPoolStatus:
        facts = self._facts
        outlook = Outlook(
            Counts.of(facts.pods, facts.desired, facts.template_hash),
            found,
            facts.attachment,
            judged=judged,
            create=create,
            delete=len(facts.live) - len(self._remaining),
            waits_until=failures.held_back_until(self._account.failures, facts.now),
            draining=0 if facts.ends else max(0, len(self._remaining) - facts.desired),
            replacing=self._to_be_replaced(),
            lease_unreadable=bool(facts.memory.master.unreadable),
        )
        return status.describe(facts, outlook, self._account)

    def _to_be_replaced(self) -> int:
        if self._spec.update.strategy == "OnDelete":
            return 0
        return sum(pod.template_hash != self._facts.template_hash for pod in self._facts.live)

    def _to_inspect(self) -> Iterator[str]:
        """Whose events may say more: what failed though it runs, for it goes now; then others."""
        yield from (p.name for p in self._account.failed[-1:] if p.state is not State.ENDED)
        yield from (p.name for p in self._silent() if self._facts.now >= p.created + STUCK)

    def _silent(self) -> list[PodView]:
        """Pods with a node that do not get Ready and whose status does not say why."""
        return [p for p in self._remaining if not p.was_ready and p.scheduled and not p.trouble]

    def _next_inspection(self, pod: PodView) -> float:
        """Less and less often: a large image can take long."""
        age = STUCK
        while pod.created + age <= self._facts.now:
            age *= 2
        return pod.created + age

    def _requeue_at(self, found: Sequence[Problem], trial_ends: float | None) -> float | None:
        timeout = self._spec.failure_policy.startup_timeout_seconds
        times = [
            trial_ends,
            self._account.recovers,
            self._facts.attachment.due,
            self._facts.idleness.due,
            self._facts.refused_until,
            failures.held_back_until(self._account.failures, self._facts.now),
            *(self._next_inspection(pod) for pod in self._silent()[:1]),
            *(pod.created + timeout for pod in self._remaining if not pod.was_ready),
            *(pod.since + timeout for pod in self._remaining if pod.state is State.STARTING),
            *(p.since + SECOND_LOOK for p in found if p.severity == "Warning" and p.since),
        ]
        return min(
            (time for time in times if time is not None and time > self._facts.now), default=None
        )
