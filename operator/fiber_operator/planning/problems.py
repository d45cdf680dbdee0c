"""Problems of a pool, worst first, as users read them and the SDK raises them."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator

from fiber_api import names
from fiber_api.names import Reason
from fiber_api.v1alpha1 import FiberPool, Problem
from fiber_operator.planning import cut_off, error_conditions, wording
from fiber_operator.planning.failed_pods import failed_pods
from fiber_operator.planning.situation import Situation
from fiber_operator.planning.starting_pods import pods_not_ready_any_more, pods_that_do_not_start

_WORKER_NAME = re.compile(f"[0-9a-f]{{{names.POD_SUFFIX_LENGTH}}}")


def find(situation: Situation) -> tuple[Problem, ...]:
    """Worst first, one of a kind, at most ten."""
    kinds: dict[str, Problem] = {}
    for problem in _all(situation):
        kinds.setdefault(problem.reason, problem)
    ranked = sorted(
        kinds.values(), key=lambda p: (not p.terminal, p.severity != "Error", -p.count, p.reason)
    )
    return tuple(ranked[: names.MAX_PROBLEMS])


def _all(situation: Situation) -> Iterator[Problem]:
    yield from _obstacles(situation)
    yield from _refusals(situation)
    yield from failed_pods(situation)
    yield from pods_that_do_not_start(situation)
    yield from pods_not_ready_any_more(situation)
    yield from cut_off.problems(situation)
    yield from _masters(situation)
    yield from _releases(situation)


def _obstacles(situation: Situation) -> Iterator[Problem]:
    memory = situation.memory
    hindered = (
        *memory.obstacles,
        memory.creation if situation.creates else None,
        memory.deletion if situation.deletes else None,
    )
    for obstacle in filter(None, hindered):
        passing = obstacle.reason == Reason.API_UNAVAILABLE
        yield situation.problem(
            obstacle.reason,
            obstacle.message,
            severity=situation.severity(obstacle.reason) if passing else "Error",
            terminal=obstacle.terminal,
        )


def _refusals(situation: Situation) -> Iterator[Problem]:
    refused = situation.memory.refusal
    if refused is None or refused.template_hash != situation.template_hash:
        return
    if refused.namespace_ends:
        return  # its pods went before the pool, which goes next
    reason = refused.reason
    if situation.wants_more or reason == Reason.INVALID_TEMPLATE:
        yield situation.problem(
            reason,
            wording.refusal(reason, refused),
            severity=situation.severity(reason) if refused.lacks_account else "Error",
            terminal=reason != Reason.QUOTA_EXCEEDED and not refused.may_pass,
        )


def _masters(situation: Situation) -> Iterator[Problem]:
    pool, memory, attachment = situation.pool, situation.memory, situation.attachment
    if attachment.lost_since is not None:
        message = wording.master_lost(pool, attachment.lost_since, memory.master)
        yield situation.problem(Reason.MASTER_LOST, message)
    if attachment.missing:
        severity = situation.severity(Reason.LEASE_NOT_FOUND)
        message = wording.no_lease(pool)
        yield situation.problem(Reason.LEASE_NOT_FOUND, message, severity=severity)
    if pool.spec.master and memory.master.unreadable:
        message = error_conditions.with_lease(pool, memory.master.unreadable)
        yield situation.problem(Reason.FORBIDDEN, message, severity="Warning")
    if pool.spec.master and memory.address and _families_differ(pool, memory.address):
        message = wording.wrong_family(pool, memory.address)
        yield situation.problem(Reason.INVALID_SPEC, message, terminal=True)


def _families_differ(pool: FiberPool, address: str) -> bool:
    assert pool.spec.master is not None
    hosts = [one.rpartition(":")[0].strip("[]") for one in address.split(",")]
    try:
        families = {ipaddress.ip_address(host).version for host in hosts}
    except ValueError:
        return False
    return ipaddress.ip_address(pool.spec.master.host).version not in families


def _releases(situation: Situation) -> Iterator[Problem]:
    prefix = f"{situation.pool.metadata.name}-"
    foreign = [
        name
        for name in situation.pool.spec.scale_down.release
        if not (name.startswith(prefix) and _WORKER_NAME.fullmatch(name.removeprefix(prefix)))
    ]
    if foreign:
        message = wording.foreign_releases(situation.pool, foreign)
        yield situation.problem(
            Reason.INVALID_RELEASE, message, severity="Warning", count=len(foreign)
        )
