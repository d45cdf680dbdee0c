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
from fiber_operator.planning import cut_off, failures, problems, revisions, scaling, status, wording
from fiber_operator.planning.attachment import idleness, judge
from fiber_operator.planning.conditions import Counts, Outlook
from fiber_operator.planning.documents import items, mapping, text
from fiber_operator.planning.events import Change, events
from fiber_operator.planning.plans import Deletion, Event, Memory, Obstacle, Plan
from fiber_operator.planning.pods import PodView, State, Trouble
from fiber_operator.planning.situation import SECOND_LOOK, Situation

STUCK = 5.0
"""Seconds after which a pod's events are looked at, if its status does not say why it waits."""

QUOTA_WAIT = 30.0
"""The longest wait until a full quota is tried again: it is freed without a sign."""

ACCOUNT_WAIT = 1.0
"""The same for a ServiceAccount that is not there: in a new namespace it is in a moment."""

_HINDERED = (Trouble.UNSCHEDULABLE, Trouble.CANNOT_START)

_ENDED: Mapping[Trouble | None, Reason] = {
    Trouble.COMPLETED: Reason.COMPLETED,
    Trouble.DISRUPTED: Reason.DISRUPTED,
}


def plan(pool: FiberPool, pods: Sequence[PodView], memory: Memory, now: float) -> Plan:
    """What to do so that the cluster gets nearer to what ``pool`` says.

    ``pods`` are all pods with the label of the pool's uid, from a fresh list; those that another
    controller owns are ignored.  Pure and total: the same arguments give an equal plan, and
    nothing that can stand in ``pods`` or in the pool's status makes it raise.
    """
    own = sorted(
        (p for p in pods if p.owner == pool.metadata.uid and p.name and p.uid),
        key=lambda pod: (pod.created, pod.name),
    )
    return _Planner(pool, own, memory, now).plan()


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
    """One plan.  Everything is worked out from its arguments alone."""

    def __init__(
        self, pool: FiberPool, pods: Sequence[PodView], memory: Memory, now: float
    ) -> None:
        self._pool, self._spec = pool, pool.spec
        self._memory, self._now = memory, now
        self._hash = revisions.template_hash(pool)
        # Whoever has taken that label away has said nothing against the pod.
        pods = [p if p.template_hash else replace(p, template_hash=self._hash) for p in pods]
        self._pods = [self._fairly_judged(pod) for pod in pods]
        self._attachment = judge(pool, memory.master, now)
        self._idleness = idleness(pool, self._attachment, now)
        lost = cut_off.find(pool, [pod for pod in self._pods if pod.live], memory)
        self._pods = cut_off.outdated(self._pods, lost, attached=self._attachment.attached)
        self._ends = pool.metadata.deletion_timestamp is not None
        self._live = [pod for pod in self._pods if pod.live]
        self._ended = [pod for pod in self._pods if pod.state is State.ENDED]
        self._late = self._not_ready_in_time()
        self._desired = self._wanted()
        self._expected = self._asked_to_end()
        self._refused = self._refused_until()
        self._account = self._count()
        self._may_create = self._can_make_pods()
        self._deletions: dict[str, Deletion] = {}

    def plan(self) -> Plan:
        """The whole of it."""
        if self._attachment.gone and self._spec.on_lost == "Delete" and not self._ends:
            return self._delete_pool()
        if not self._ends:
            self._delete()
        held_back = self._hold_back()
        dry_run = self._may_create and not self._accepted and not self._spec.suspend
        create, trial_ends = self._creations(held_back)
        found = problems.find(self._situation())
        after = self._status(found, create, judged=not dry_run)
        document = status.patch(self._pool, after)
        deletions = tuple(self._deletions.values())
        change = Change(self._pool.status, after, self._account, create, deletions)
        return Plan(
            create=create,
            batch_limit=self._spec.scale_up.max_in_flight,
            delete=deletions,
            dry_run=dry_run,
            template_hash=self._hash,
            status=document,
            events=tuple(events(change, told=document is not None)),
            inspect=tuple(self._to_inspect())[:1],
            requeue_at=self._requeue_at(found, trial_ends),
        )

    def _delete_pool(self) -> Plan:
        assert self._attachment.lost_since is not None
        message = wording.master_lost(self._pool, self._attachment.lost_since, self._memory.master)
        event = Event("Warning", Reason.MASTER_LOST, message)
        after = self._status(problems.find(self._situation(deletes=True)), 0, judged=self._accepted)
        return Plan(
            delete_pool=True,
            template_hash=self._hash,
            status=status.patch(self._pool, after),
            events=(event,),
        )

    # What is so

    def _fairly_judged(self, pod: PodView) -> PodView:
        """An agent whose master is lost ends with 0, however soon that is."""
        master, brief = self._spec.master, pod.state is State.ENDED and pod.exit_code == 0
        if master is None or not brief or pod.trouble is not Trouble.APPLICATION:
            return pod
        # The cluster's times are whole seconds.
        waited = pod.ran > 0 and pod.ran >= master.lost_grace_seconds - 1
        return replace(pod, trouble=Trouble.COMPLETED) if waited else pod

    def _not_ready_in_time(self) -> list[PodView]:
        """Workers that run and do not get Ready: they failed, only that they do not end."""
        if self._ends or self._spec.suspend:
            return []
        limit = self._now - self._spec.failure_policy.startup_timeout_seconds
        return [pod for pod in self._live if pod.state is State.STARTING and pod.since <= limit]

    def _asked_to_end(self) -> frozenset[str]:
        if self._ends or self._spec.suspend:
            return frozenset(pod.name for pod in self._pods)
        return frozenset(self._spec.scale_down.release)

    def _count(self) -> failures.Account:
        return failures.account(
            self._pool.status.failures,
            self._pool.status.proven_template_hash,
            self._pods,
            expected=self._expected,
            late={pod.name for pod in self._late},
            desired=self._desired - self._hindered(),
            template_hash=self._hash,
            spec_hash=revisions.spec_hash(self._pool),
            policy=self._spec.failure_policy,
            seed=self._pool.metadata.uid,
            now=self._now,
        )

    def _hindered(self) -> int:
        """Workers that are wanted and not there for other reasons than that workers fail."""
        missing = max(0, self._desired - len(self._live)) if self._refused else 0
        return missing + sum(pod.trouble in _HINDERED for pod in self._live)

    def _wanted(self) -> int:
        attachment = self._attachment
        if self._spec.suspend or self._idleness.forgotten:
            return 0
        if self._spec.on_lost != "ScaleToMin" or not attachment.grace_is_over:
            return self._pool.wanted
        floor = self._spec.min_replicas
        # Not yet confirmed by this process: keep what there is.
        return floor if attachment.gone else min(self._pool.wanted, max(floor, len(self._live)))

    @property
    def _floor(self) -> int:
        """How many minReplicas keeps of those that the master does not want."""
        spec, forgotten = self._spec, self._idleness.forgotten
        return spec.min_replicas if spec.replicas < spec.min_replicas and not forgotten else 0

    @property
    def _accepted(self) -> bool:
        """The API server takes pods of this template, or did."""
        return self._hash in (self._memory.accepted, self._account.proven)

    def _refused_until(self) -> float | None:
        refused = self._memory.refusal
        if refused is None or refused.template_hash != self._hash:
            return None
        wait = failures.delay(self._spec.failure_policy, refused.count, self._pool.metadata.uid)
        if problems.refusal_reason(refused) == Reason.QUOTA_EXCEEDED:
            wait = min(wait, QUOTA_WAIT)
        if problems.lacks_account(refused):
            wait = min(wait, ACCOUNT_WAIT)
        return refused.at + wait

    def _can_make_pods(self) -> bool:
        memory, policy = self._memory, self._spec.failure_policy
        return not (
            self._ends
            or memory.address is None
            or memory.obstacles
            or self._is_orphaned()
            or failures.given_up(self._account.failures, policy)
            or (self._refused is not None and self._now < self._refused)
        )

    def _is_orphaned(self) -> bool:
        """Its master is lost and what follows from that has not happened yet."""
        attachment = self._attachment
        if self._spec.on_lost == "Retain":
            return False
        return attachment.alive is False and not attachment.gone

    # Who goes

    def _delete(self) -> None:
        spec, attached = self._spec, self._attachment.attached
        if spec.suspend:
            self._take(self._live + self._ended, Reason.SUSPENDED)
        released = scaling.released_to_delete(
            self._live + self._ended,
            spec.scale_down.release,
            floor=self._floor,
            template_hash=self._hash,
        )
        self._take(released, Reason.RELEASED)
        late = [pod for pod in self._late if pod.name in self._account.failures.counted]
        self._take(late, Reason.STARTUP_TIMEOUT, guarded=True)
        if self._accepted and self._may_create:
            self._take(self._outdated(), Reason.REPLACED, guarded=attached)
        free = spec.scale_down.policy == "Any" or not attached
        excess = scaling.excess_to_delete(
            self._remaining,
            len(self._remaining) - self._desired,
            template_hash=self._hash,
            free_choice=free,
        )
        self._take(excess, Reason.SCALED_DOWN, guarded=not free)
        settled = self._expected.union(self._account.failures.counted)
        for pod in scaling.ended_to_delete(self._ended, settled):
            self._take([pod], _ENDED.get(pod.trouble, Reason.CONTAINER_FAILED))

    def _outdated(self) -> list[PodView]:
        return scaling.outdated_to_replace(
            self._remaining,
            template_hash=self._hash,
            strategy=self._spec.update.strategy,
            attached=self._attachment.attached,
            desired=self._desired,
            proven=self._account.proven == self._hash,
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
        return [pod for pod in self._live if pod.name not in self._deletions]

    # Who comes

    def _hold_back(self) -> int:
        """Places of workers that failed, which are not to be taken yet and are still wanted."""
        missing = max(0, self._desired - len(self._remaining))
        found = self._account.failures
        if found.waiting > missing:
            found = found.model_copy(update={"waiting": missing})
            self._account = replace(self._account, failures=found)
        return min(self._account.held_back, missing)

    def _creations(self, held_back: int) -> tuple[int, float | None]:
        """How many now, and when more may follow if that is not all."""
        missing = self._desired - len(self._remaining) - held_back
        if missing <= 0 or not self._may_create or not self._accepted:
            return 0, None
        current = [pod for pod in self._remaining if pod.template_hash == self._hash]
        trial = scaling.trial(
            current,
            proven=self._account.proven == self._hash,
            failing=self._is_complained_of(current),
            held_back=held_back,
            now=self._now,
        )
        return missing if trial.room is None else min(missing, trial.room), trial.again

    def _is_complained_of(self, pods: Sequence[PodView]) -> bool:
        complained = any(self._memory.warnings.get(pod.name) for pod in pods)
        return complained or self._account.failures.waves > 0

    # What to say

    def _situation(self, *, deletes: bool = False) -> Situation:
        missing = len(self._remaining) < self._desired
        return Situation(
            pool=self._pool,
            live=self._remaining,
            ended=self._ended,
            account=self._account,
            attachment=self._attachment,
            memory=self._memory,
            template_hash=self._hash,
            wants_more=missing,
            creates=self._may_create and (missing or not self._accepted),
            deletes=deletes or bool(self._deletions),
            now=self._now,
        )

    def _status(self, found: tuple[Problem, ...], create: int, *, judged: bool) -> FiberPoolStatus:
        missing = self._desired - len(self._remaining)
        outlook = Outlook(
            Counts.of(self._pods, self._desired, self._hash),
            found,
            self._attachment,
            judged=judged,
            create=create,
            delete=len(self._live) - len(self._remaining),
            waits_until=failures.held_back_until(self._account.failures, self._now),
            draining=0 if self._ends else max(0, -missing),
            replacing=self._to_be_replaced(),
            lease_unreadable=bool(self._memory.master.unreadable),
        )
        return status.describe(
            self._pool,
            outlook,
            self._account,
            address=self._memory.address,
            led=self._memory.led,
            credentials=self._memory.credentials,
            idle_since=self._idleness.since,
            template_hash=self._hash,
            now=self._now,
        )

    def _to_be_replaced(self) -> int:
        if self._spec.update.strategy == "OnDelete":
            return 0
        return sum(pod.template_hash != self._hash for pod in self._live)

    def _to_inspect(self) -> Iterator[str]:
        """Whose events may say more: what failed though it runs, for it goes now; then others."""
        yield from (p.name for p in self._account.failed[-1:] if p.state is not State.ENDED)
        yield from (p.name for p in self._silent() if self._now >= p.created + STUCK)

    def _silent(self) -> list[PodView]:
        """Pods with a node that do not get Ready and whose status does not say why."""
        return [p for p in self._remaining if not p.was_ready and p.scheduled and not p.trouble]

    def _next_inspection(self, pod: PodView) -> float:
        """Less and less often: a large image can take long."""
        age = STUCK
        while pod.created + age <= self._now:
            age *= 2
        return pod.created + age

    def _requeue_at(self, found: Sequence[Problem], trial_ends: float | None) -> float | None:
        timeout = self._spec.failure_policy.startup_timeout_seconds
        times = [
            trial_ends,
            self._account.recovers,
            self._attachment.due,
            self._idleness.due,
            self._refused,
            failures.held_back_until(self._account.failures, self._now),
            *(self._next_inspection(pod) for pod in self._silent()[:1]),
            *(pod.created + timeout for pod in self._remaining if not pod.was_ready),
            *(pod.since + timeout for pod in self._remaining if pod.state is State.STARTING),
            *(p.since + SECOND_LOOK for p in found if p.severity == "Warning" and p.since),
        ]
        return min((time for time in times if time is not None and time > self._now), default=None)
