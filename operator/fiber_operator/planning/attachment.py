"""Attachment of a master to the pool: whether it uses the pool, what follows if it is lost, and how
long a master that asks for nothing holds the pool.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from fiber_api.names import ConditionType
from fiber_api.v1alpha1 import Condition, FiberPool
from fiber_operator.planning import plans
from fiber_operator.planning.documents import past


@dataclass(frozen=True)
class Attachment:
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


def judge(pool: FiberPool, lease: plans.LeaseVerdict, now: float) -> Attachment:
    """Judge the master by the spec, the Lease and the status together.

    After a restart the operator does not know for a while; it goes by the status meanwhile, if
    that is of this master, and neither deletes for a lost master nor creates for one.
    """
    master = pool.spec.master
    if master is None:
        return Attachment(attached=False, alive=None, connected=0)
    if master.lease_name is None or lease.unreadable:
        return Attachment(attached=True, alive=None)
    before = _condition(pool)
    alive = lease.alive
    if alive is None and before is not None and before.status != "Unknown":
        alive = before.status == "True"
    if alive is not False:
        known = lease.alive is not None
        connected = lease.connected if known else _connected_before(pool)
        return Attachment(attached=True, alive=alive, connected=connected, missing=lease.missing)
    since = _lost_since(pool, before, now)
    due = since + master.lost_grace_seconds
    if now < due:
        return Attachment(attached=True, alive=False, connected=0, lost_since=since, due=due)
    gone = lease.alive is False
    return Attachment(attached=not gone, alive=False, connected=0, lost_since=since, gone=gone)


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


def idleness(pool: FiberPool, attachment: Attachment, now: float) -> Idleness:
    """Judge how long the master has asked for nothing, by the spec and the status.

    One that is lost is not idle: ``onLost`` says what follows.
    """
    idle, master = pool.spec.idle, pool.spec.master
    if idle is None or master is None or pool.spec.replicas or attachment.alive is False:
        return Idleness()
    same = pool.status.master_epoch == master.epoch
    since = (past(pool.status.idle_since, now) if same else None) or float(math.floor(now))
    due = since + idle.timeout_seconds
    return Idleness(since, due if now < due else None)


def _lost_since(pool: FiberPool, before: Condition | None, now: float) -> float:
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


def _condition(pool: FiberPool) -> Condition | None:
    """Return the condition about this master in the status, also if the spec has changed."""
    if pool.spec.master is None or pool.status.master_epoch != pool.spec.master.epoch:
        return None
    conditions = pool.status.conditions
    return next((c for c in conditions if c.type == ConditionType.MASTER_ALIVE), None)
