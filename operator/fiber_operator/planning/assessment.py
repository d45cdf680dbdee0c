"""Assessment of a pool: its master, its pods, and how many pods it should have.

``Assessment`` is made once for each plan.  It answers the questions that the plan depends on: is a
master attached and alive, which pods cannot reach it, how many pods are wanted, which have failed,
and may pods be created now.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from fiber_api import names
from fiber_api.names import ConditionType, Reason
from fiber_api.v1alpha1 import FiberPool, PoolCondition
from fiber_operator.planning import failures, manifests, plans
from fiber_operator.planning.documents import items, mapping, past
from fiber_operator.planning.plans import Knowledge
from fiber_operator.planning.pods import PodState, PodView, Trouble

# -- The master


@dataclass(frozen=True)
class MasterState:
    """The master, as far as the operator can tell."""

    attached: bool
    """A master may have given work to the pods, so that only it knows which are idle."""
    alive: bool | None
    """None: there is none, or nobody can tell."""
    lost_since: float | None = None
    """Set while ``alive`` is False."""
    due: float | None = None
    """Time at which the grace of a lost master ends, if it has not ended."""
    missing: bool = False
    """True if there is no Lease of that name, and it is too soon to call the master lost."""
    connected: int | None = None
    """Agents that are linked to it; None: nobody can tell."""
    gone: bool = False
    """The grace is over and this process itself found the Lease expired: ``onLost`` applies."""

    @property
    def grace_is_over(self) -> bool:
        """Tell whether the grace of a lost master is over."""
        return self.alive is False and self.due is None


def judge_master(pool: FiberPool, lease: plans.LeaseVerdict, now: float) -> MasterState:
    """Judge the master by the spec, the Lease and the status together.

    After a restart the operator does not know for a while; it goes by the status meanwhile, if
    that is of this master, and neither deletes for a lost master nor creates for one.
    """
    master = pool.spec.master
    if master is None:
        return MasterState(attached=False, alive=None, connected=0)
    if master.lease_name is None or lease.unreadable:
        return MasterState(attached=True, alive=None)
    before = _condition(pool)
    alive = lease.alive
    if alive is None and before is not None and before.status != "Unknown":
        alive = before.status == "True"
    if alive is not False:
        known = lease.alive is not None
        connected = lease.connected if known else _connected_before(pool)
        return MasterState(attached=True, alive=alive, connected=connected, missing=lease.missing)
    since = _lost_since(pool, before, now)
    due = since + master.lost_grace_seconds
    if now < due:
        return MasterState(attached=True, alive=False, connected=0, lost_since=since, due=due)
    gone = lease.alive is False
    return MasterState(attached=not gone, alive=False, connected=0, lost_since=since, gone=gone)


def awaits_agents(pool: FiberPool) -> bool:
    """Return whether the pool has a master that is not known to be lost."""
    before = _condition(pool)
    return pool.spec.master is not None and not (before and before.status == "False")


@dataclass(frozen=True)
class Idleness:
    """A master that asks for no workers, where ``spec.idle`` says how long that may last."""

    since: float | None = None
    """None: it asks for some, there is none, or nobody minds."""
    due: float | None = None
    """Time at which the master counts as forgotten, if it does not yet."""

    @property
    def forgotten(self) -> bool:
        """True if the master was idle for so long that it no longer holds minReplicas."""
        return self.since is not None and self.due is None


def idleness(pool: FiberPool, master_state: MasterState, now: float) -> Idleness:
    """Judge how long the master has asked for nothing, by the spec and the status.

    One that is lost is not idle: ``onLost`` says what follows.
    """
    idle, master = pool.spec.idle, pool.spec.master
    if idle is None or master is None or pool.spec.replicas or master_state.alive is False:
        return Idleness()
    same = pool.status.master_epoch == master.epoch
    since = (past(pool.status.idle_since, now) if same else None) or float(math.floor(now))
    due = since + idle.timeout_seconds
    return Idleness(since, due if now < due else None)


def _lost_since(pool: FiberPool, before: PoolCondition | None, now: float) -> float:
    if before is not None and before.status == "False":
        known = past(before.last_transition_time, now)
        # The pool may be deleted for it, so it must be a time at which there was one.
        if known is not None and known >= (pool.metadata.creation_timestamp or 0.0):
            return known
    return float(math.floor(now))


def _connected_before(pool: FiberPool) -> int | None:
    """Return the connected agents of this master that the status has from an earlier operator."""
    master, status = pool.spec.master, pool.status
    same = master is not None and status.master_epoch == master.epoch
    return status.connected_replicas if same else None


def _condition(pool: FiberPool) -> PoolCondition | None:
    """Return the condition about this master in the status, also if the spec has changed."""
    if pool.spec.master is None or pool.status.master_epoch != pool.spec.master.epoch:
        return None
    conditions = pool.status.conditions
    return next((c for c in conditions if c.type == ConditionType.MASTER_ALIVE), None)


# -- Pods that cannot reach their master

OUTDATED = "cut-off"
"""Mark in place of a template's hash."""

SKEW = 5.0
"""Seconds that the clocks of two API servers may differ by, which date the Secret and the pods."""


@dataclass(frozen=True)
class CutOff:
    """Live pods, by what is wrong with them."""

    by_address: Sequence[PodView]
    by_credentials: Sequence[PodView]


def find_cut_off(pool: FiberPool, live: Sequence[PodView], knowledge: Knowledge) -> CutOff:
    """Find the pods that are cut off."""
    address = None if _names_its_own_address(pool) else knowledge.address
    return CutOff(
        [pod for pod in live if address and pod.address not in ("", address)],
        [pod for pod in live if pod.created + SKEW < knowledge.credentials_made],
    )


def mark_cut_off(pods: Sequence[PodView], cut_off: CutOff, *, attached: bool) -> list[PodView]:
    """``pods``, of which those that are cut off are like those of an older template.

    A master that is attached may hold the old credentials as they do: they are of use to it, and
    new ones are not.
    """
    useless = {pod.name for pod in cut_off.by_address}
    if not attached:
        useless.update(pod.name for pod in cut_off.by_credentials)
    return [replace(pod, template_hash=OUTDATED) if pod.name in useless else pod for pod in pods]


def _names_its_own_address(pool: FiberPool) -> bool:
    """The template says where to dial, and not the Service's address."""
    return any(
        variable.get("name") == names.ENV_ADDRESS
        for container in items(mapping(pool.spec.template, "spec").get("containers"))
        if container.get("name") == pool.spec.worker_container
        for variable in items(container.get("env"))
    )


# -- The assessment

QUOTA_WAIT = 30.0
"""The longest wait until a full quota is tried again: it is freed without a sign."""

ACCOUNT_WAIT = 1.0
"""The same for a ServiceAccount that is not there: in a new namespace it is in a moment."""

_HINDERED = (Trouble.UNSCHEDULABLE, Trouble.CANNOT_START)


class Assessment:
    """All that a plan follows from.  Worked out from its arguments alone."""

    def __init__(
        self, pool: FiberPool, pods: Sequence[PodView], knowledge: Knowledge, now: float
    ) -> None:
        """``pods`` are the pool's own, the oldest first."""
        self.pool, self.spec = pool, pool.spec
        self.knowledge, self.now = knowledge, now
        self.template_hash = manifests.template_hash(pool)
        # A missing label says nothing against the pod.
        pods = [
            p if p.template_hash else replace(p, template_hash=self.template_hash) for p in pods
        ]
        self.pods = [self._fairly_judged(pod) for pod in pods]
        self.master_state = judge_master(pool, knowledge.master, now)
        if self.spec.master is None or self.master_state.alive is False:
            # Those whose master has gone before they reached it wait for the next on purpose.
            self.pods = [replace(pod, joining=False) for pod in self.pods]
        self.idleness = idleness(pool, self.master_state, now)
        lost = find_cut_off(pool, [pod for pod in self.pods if pod.live], knowledge)
        self.pods = mark_cut_off(self.pods, lost, attached=self.master_state.attached)
        self.ends = pool.metadata.deletion_timestamp is not None
        self.live = [pod for pod in self.pods if pod.live]
        self.ended = [pod for pod in self.pods if pod.state is PodState.ENDED]
        self.late = self._not_ready_in_time()
        self.desired = self._wanted()
        self.expected = self._asked_to_end()
        """Names of pods whose end is nobody's failure."""
        self.refused_until = self._refused_until()
        self.account = self._count()
        self.may_create = self._can_make_pods()

    def _fairly_judged(self, pod: PodView) -> PodView:
        """An agent whose master is lost ends with 0, however soon that is."""
        master, brief = self.spec.master, pod.state is PodState.ENDED and pod.exit_code == 0
        if master is None or not brief or pod.trouble is not Trouble.APPLICATION:
            return pod
        # The cluster's times are whole seconds.
        waited = pod.ran > 0 and pod.ran >= master.lost_grace_seconds - 1
        return replace(pod, trouble=Trouble.COMPLETED) if waited else pod

    def _not_ready_in_time(self) -> list[PodView]:
        """Workers that run and do not get Ready: they failed, only that they do not end."""
        if self.ends or self.spec.suspend:
            return []
        limit = self.now - self.spec.failure_policy.startup_timeout_seconds
        return [pod for pod in self.live if pod.state is PodState.STARTING and pod.since <= limit]

    def _asked_to_end(self) -> frozenset[str]:
        if self.ends or self.spec.suspend:
            return frozenset(pod.name for pod in self.pods)
        return frozenset(self.spec.scale_down.release)

    def _count(self) -> failures.Account:
        return failures.account(
            self.pool.status.failures,
            self.pool.status.proven_template_hash,
            self.pods,
            expected=self.expected,
            late={pod.name for pod in self.late},
            desired=self.desired - self._hindered(),
            template_hash=self.template_hash,
            spec_hash=manifests.spec_hash(self.pool),
            policy=self.spec.failure_policy,
            seed=self.pool.metadata.uid,
            now=self.now,
        )

    def _hindered(self) -> int:
        """Workers that are wanted and not there for other reasons than that workers fail."""
        missing = max(0, self.desired - len(self.live)) if self.refused_until else 0
        return missing + sum(pod.trouble in _HINDERED for pod in self.live)

    def _wanted(self) -> int:
        master_state = self.master_state
        if self.spec.suspend or self.idleness.forgotten:
            return 0
        if self.spec.on_lost != "ScaleToMin" or not master_state.grace_is_over:
            return self.pool.wanted
        floor = self.spec.min_replicas
        # Not yet confirmed by this process: keep what there is.
        return floor if master_state.gone else min(self.pool.wanted, max(floor, len(self.live)))

    @property
    def floor(self) -> int:
        """Number of pods that minReplicas keeps and the master does not want."""
        spec, forgotten = self.spec, self.idleness.forgotten
        return spec.min_replicas if spec.replicas < spec.min_replicas and not forgotten else 0

    @property
    def accepted(self) -> bool:
        """The API server takes pods of this template, or did."""
        return self.template_hash in (self.knowledge.accepted, self.account.proven)

    def _refused_until(self) -> float | None:
        refused = self.knowledge.refusal
        if refused is None or refused.template_hash != self.template_hash:
            return None
        wait = failures.delay(self.spec.failure_policy, refused.count, self.pool.metadata.uid)
        if refused.reason == Reason.QUOTA_EXCEEDED:
            wait = min(wait, QUOTA_WAIT)
        if refused.lacks_account:
            wait = min(wait, ACCOUNT_WAIT)
        return refused.at + wait

    def _can_make_pods(self) -> bool:
        knowledge, policy = self.knowledge, self.spec.failure_policy
        return not (
            self.ends
            or knowledge.address is None
            or knowledge.obstacles
            or self._is_orphaned()
            or failures.given_up(self.account.failures, policy)
            or (self.refused_until is not None and self.now < self.refused_until)
        )

    def _is_orphaned(self) -> bool:
        """Tell whether the master is lost, and the pool does not show that yet."""
        master_state = self.master_state
        if self.spec.on_lost == "Retain":
            return False
        return master_state.alive is False and not master_state.gone
