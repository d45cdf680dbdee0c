"""The status document.  Equal input gives an equal document, with no time that moves by itself."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from fiber_api import names
from fiber_api.names import ConditionType, Phase, Reason
from fiber_api.v1alpha1 import FiberPool, FiberPoolStatus, Problem
from fiber_operator.planning import manifests
from fiber_operator.planning.assessment import Assessment
from fiber_operator.planning.conditions import (
    Counts,
    Finding,
    Outlook,
    Truth,
    conditions,
    dated,
    phase,
)
from fiber_operator.planning.documents import mapping, past, whole
from fiber_operator.planning.failures import Account
from fiber_operator.planning.plans import Obstacle
from fiber_operator.planning.pods import PodView
from fiber_operator.planning.situation import SECOND_LOOK


def describe(facts: Assessment, outlook: Outlook, account: Account) -> FiberPoolStatus:
    """The status that the pool should have.  ``account`` is that of ``facts``, or what the plan
    has made of it.
    """
    pool, memory = facts.pool, facts.memory
    before, counts, master = pool.status, outlook.counts, pool.spec.master
    found = conditions(pool, outlook, facts.now)
    epoch = master.epoch if master and memory.led else 0
    leads_to = names.address_of(master.host, master.port) if master else None
    secret = pool.credentials_secret if memory.credentials else None
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
        endpoint=names.endpoint_of(memory.address) if memory.address else before.endpoint,
        master=leads_to if memory.led else before.master,
        master_epoch=max(epoch, before.master_epoch or 0) or None,
        idle_since=facts.idleness.since,
        credentials_secret=before.credentials_secret if memory.credentials is None else secret,
        template_hash=facts.template_hash,
        proven_template_hash=account.proven,
        failures=account.failures,
        problems=outlook.problems,
        conditions=found,
    )


def _connected(outlook: Outlook) -> int | None:
    # What a Lease says may be older than the end of a pod, and is the word of a program.
    known = outlook.attachment.connected
    return None if known is None else min(known, outlook.counts.live)


def patch(pool: FiberPool, status: FiberPoolStatus) -> dict[str, Any] | None:
    """Return the patch of the status, with None for fields to remove; None if nothing changes.

    What could not be read in the old status is not known to be right and is written over.
    """
    if status == pool.status and not pool.unread:
        return None
    return status.model_dump(mode="json", by_alias=True)


def describe_unreadable(
    document: Mapping[str, Any], pods: Sequence[PodView], errors: Sequence[str], now: float
) -> dict[str, Any] | None:
    """The status of a pool whose spec cannot be understood: what it was, and what is wrong."""
    before, unread = FiberPoolStatus.salvage(document.get("status") or {})
    message = (
        f"The operator cannot read this FiberPool: {'; '.join(errors)}. Correct what is named; "
        "until then nothing is created or deleted."
    )
    generation = whole(mapping(document, "metadata").get("generation"))
    kept = [c for c in before.conditions if c.type not in _TOLD]
    told = [
        dated(
            Finding(kind, truth, Reason.INVALID_SPEC, message),
            next((c for c in before.conditions if c.type == kind), None),
            generation,
            now,
        )
        for kind, truth in _TOLD.items()
    ]
    counts = Counts.of(pods, before.desired_replicas or 0, before.template_hash or "")
    known = next((p for p in before.problems if p.reason == Reason.INVALID_SPEC), None)
    problem = Problem(
        reason=Reason.INVALID_SPEC,
        severity="Error",
        terminal=True,
        since=(past(known.since, now) if known else None) or float(math.floor(now)),
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
            "conditions": (*told, *kept),
        }
    )
    if after == before and not unread:
        return None
    return after.model_dump(mode="json", by_alias=True)


def describe_blind(
    document: Mapping[str, Any], obstacle: Obstacle, now: float
) -> dict[str, Any] | None:
    """The status of a pool whose pods cannot be listed: what it was, and why it says no more.

    The generation that it was of stays: what changed since is not carried out.
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
        told = [
            dated(Finding(kind, truth, problem.reason, problem.message), found, generation, now)
            for kind, truth in _BLIND.items()
            for found in [known.pop(kind, None)]
        ]
        update["conditions"] = (*told, *known.values())
        if before.phase not in (Phase.TERMINATING, Phase.SUSPENDED, Phase.FAILED):
            update["phase"] = Phase.DEGRADED
    after = before.model_copy(update=update)
    if after == before and not unread:
        return None
    return after.model_dump(mode="json", by_alias=True)


def _lasting(obstacle: Obstacle, before: FiberPoolStatus, now: float) -> Problem:
    known = next((p for p in before.problems if p.reason == obstacle.reason), None)
    since = (past(known.since, now) if known else None) or float(math.floor(now))
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

_TOLD: Mapping[ConditionType, Truth] = {
    ConditionType.ACCEPTED: "False",
    ConditionType.DEGRADED: "True",
}
