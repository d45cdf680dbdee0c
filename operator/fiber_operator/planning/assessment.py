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
from fiber_operator.planning.documents import items, mapping, unless_ahead
from fiber_operator.planning.plans import Knowledge
from fiber_operator.planning.pods import PodState, PodView, Trouble

# -- The master


@dataclass(frozen=True)
class MasterState:
    """State of the master, as far as the operator knows it."""

    attached: bool
    """True if a master may have given work to pods.  Only the master knows which are idle."""
    alive: bool | None
    """None: there is no master, or its state is not known."""
    lost_since: float | None = None
    """Time since which the master is lost; set while ``alive`` is False."""
    due: float | None = None
    """End of a lost master's grace period; None once it has ended."""
    missing: bool = False
    """True if the Lease does not exist and it is too early to call the master lost."""
    connected: int | None = None
    """Number of agents with a link to the master; None: not known."""
    gone: bool = False
    """True if the grace period is over and this process itself found the Lease expired.

    ``onLost`` applies then."""

    @property
    def grace_is_over(self) -> bool:
        """True if the master is lost and its grace period is over."""
        return self.alive is False and self.due is None


def judge_master(pool: FiberPool, lease: plans.LeaseVerdict, now: float) -> MasterState:
    """Judge the master by the spec, the Lease and the status.

    For a while after its restart the operator does not know about the Lease.  It then relies on the
    status, if that describes this master, and neither deletes nor creates pods for a lost master.
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
    """Return True if the pool has a master that is not known to be lost."""
    before = _condition(pool)
    return pool.spec.master is not None and not (before and before.status == "False")


@dataclass(frozen=True)
class Idleness:
    """Time for which a master has wanted no workers, where ``spec.idle`` limits it."""

    since: float | None = None
    """None: the master wants workers, there is no master, or ``spec.idle`` is absent."""
    due: float | None = None
    """Time at which the master will count as forgotten; None once it does."""

    @property
    def forgotten(self) -> bool:
        """True if the master was idle for so long that it no longer holds minReplicas."""
        return self.since is not None and self.due is None


def idleness(pool: FiberPool, master_state: MasterState, now: float) -> Idleness:
    """Judge by the spec and the status for how long the master has wanted no workers.

    A lost master is not idle: ``onLost`` applies to it.
    """
    idle, master = pool.spec.idle, pool.spec.master
    if idle is None or master is None or pool.spec.replicas or master_state.alive is False:
        return Idleness()
    same = pool.status.master_epoch == master.epoch
    since = (unless_ahead(pool.status.idle_since, now) if same else None) or float(math.floor(now))
    due = since + idle.timeout_seconds
    return Idleness(since, due if now < due else None)


def _lost_since(pool: FiberPool, before: PoolCondition | None, now: float) -> float:
    if before is not None and before.status == "False":
        known = unless_ahead(before.last_transition_time, now)
        # The pool may be deleted because of this time: it must not be before the pool's creation.
        if known is not None and known >= (pool.metadata.creation_timestamp or 0.0):
            return known
    return float(math.floor(now))


def _connected_before(pool: FiberPool) -> int | None:
    """Return this master's number of connected agents, from the status."""
    master, status = pool.spec.master, pool.status
    same = master is not None and status.master_epoch == master.epoch
    return status.connected_replicas if same else None


def _condition(pool: FiberPool) -> PoolCondition | None:
    """Return the condition MasterAlive from the status, if it is about this master."""
    if pool.spec.master is None or pool.status.master_epoch != pool.spec.master.epoch:
        return None
    conditions = pool.status.conditions
    return next((c for c in conditions if c.type == ConditionType.MASTER_ALIVE), None)


# -- Pods that cannot reach their master

OUTDATED = "cut-off"
"""Value in place of the template's hash of a pod that is cut off."""

API_SERVER_SKEW = 5.0
"""Seconds by which the clocks of two API servers may differ.  They date the Secret and the pods."""


@dataclass(frozen=True)
class CutOff:
    """Live pods that cannot reach their master.

    A pod keeps the address and the key that it was created with.  They are useless after the pool's
    Service or Secret was deleted and made anew with another address or key.
    """

    by_address: Sequence[PodView]
    by_credentials: Sequence[PodView]


def find_cut_off(pool: FiberPool, live: Sequence[PodView], knowledge: Knowledge) -> CutOff:
    """Find the pods that are cut off."""
    address = None if _names_its_own_address(pool) else knowledge.address
    secret_made = knowledge.secret.made if knowledge.secret else 0.0
    return CutOff(
        [pod for pod in live if address and pod.address not in ("", address)],
        [pod for pod in live if pod.created + API_SERVER_SKEW < secret_made],
    )


def mark_cut_off(pods: Sequence[PodView], cut_off: CutOff, *, attached: bool) -> list[PodView]:
    """Return ``pods``, with those that are cut off marked as outdated.

    An attached master may hold the old credentials, too.  Then only pods with the old credentials
    are of use to it, and these are not marked.
    """
    useless = {pod.name for pod in cut_off.by_address}
    if not attached:
        useless.update(pod.name for pod in cut_off.by_credentials)
    return [replace(pod, template_hash=OUTDATED) if pod.name in useless else pod for pod in pods]


def _names_its_own_address(pool: FiberPool) -> bool:
    """Return True if the template sets the address that agents dial."""
    return any(
        variable.get("name") == names.ENV_ADDRESS
        for container in items(mapping(pool.spec.template, "spec").get("containers"))
        if container.get("name") == pool.spec.worker_container
        for variable in items(container.get("env"))
    )


# -- The assessment

QUOTA_WAIT = 30.0
"""Longest delay in seconds of the next try after a full quota.  No event says that it is free."""

ACCOUNT_WAIT = 1.0
"""The same delay for a missing ServiceAccount.  In a new namespace it appears in a moment."""

_HINDERED = (Trouble.UNSCHEDULABLE, Trouble.CANNOT_START)


class Assessment:
    """Facts that a plan follows from.  They depend on the arguments alone."""

    def __init__(
        self, pool: FiberPool, pods: Sequence[PodView], knowledge: Knowledge, now: float
    ) -> None:
        """Assess a pool with ``pods``, which are the pool's own, the oldest first."""
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
            # Agents without a living master wait for the next one, and are not late.
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
        """Names of pods whose end was requested and is no failure."""
        self.refused_until = self._refused_until()
        self.account = self._count()
        self.may_create = self._can_make_pods()

    def _fairly_judged(self, pod: PodView) -> PodView:
        """Return ``pod``; one that ended with 0 after the grace period did not fail.

        An agent ends so when its master is lost, even soon after its start.
        """
        master, brief = self.spec.master, pod.state is PodState.ENDED and pod.exit_code == 0
        if master is None or not brief or pod.trouble is not Trouble.APPLICATION:
            return pod
        # The cluster's times are in whole seconds.
        waited = pod.ran > 0 and pod.ran >= master.lost_grace_seconds - 1
        return replace(pod, trouble=Trouble.COMPLETED) if waited else pod

    def _not_ready_in_time(self) -> list[PodView]:
        """Return workers that run and did not become Ready in time: they count as failed."""
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
        """Return how many wanted workers are missing for other reasons than failures."""
        missing = max(0, self.desired - len(self.live)) if self.refused_until else 0
        return missing + sum(pod.trouble in _HINDERED for pod in self.live)

    def _wanted(self) -> int:
        master_state = self.master_state
        if self.spec.suspend or self.idleness.forgotten:
            return 0
        if self.spec.on_lost != "ScaleToMin" or not master_state.grace_is_over:
            return self.pool.wanted
        floor = self.spec.min_replicas
        # This process has not confirmed the loss yet: keep the pods that exist.
        return floor if master_state.gone else min(self.pool.wanted, max(floor, len(self.live)))

    @property
    def floor(self) -> int:
        """``minReplicas`` if the master wants fewer workers than that, else 0."""
        spec, forgotten = self.spec, self.idleness.forgotten
        return spec.min_replicas if spec.replicas < spec.min_replicas and not forgotten else 0

    @property
    def accepted(self) -> bool:
        """True if the API server accepts, or has accepted, pods of this template."""
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
        """Return True if the master is lost and the pool was not scaled down for it yet."""
        master_state = self.master_state
        if self.spec.on_lost == "Retain":
            return False
        return master_state.alive is False and not master_state.gone
