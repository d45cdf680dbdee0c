"""Meaning of a FiberPool's status for the program that waits for its workers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from fiber.errors import FiberPoolError
from fiber_api.names import ConditionType, Reason
from fiber_api.times import parse_time

Status = Mapping[str, Any]
"""``status``, as the API has it: any part may be absent."""


class PoolName(NamedTuple):
    """Name of a FiberPool."""

    name: str
    namespace: str

    def __str__(self) -> str:
        return f"the FiberPool {self.name!r} in namespace {self.namespace!r}"

    def error(self, message: str, reason: str) -> FiberPoolError:
        """An error of this pool."""
        return FiberPoolError(
            f"{self}: {message}", pool=self.name, namespace=self.namespace, reason=str(reason)
        )


class Way(NamedTuple):
    """Way of agents to this program."""

    address: str
    """``host:port`` that the pool's Service leads to."""
    displaced: str = ""
    """Identity of the lost master that this program took the pool from."""

    @property
    def advice(self) -> str:
        """Reasons why agents do not arrive, and remedies."""
        others = (
            f". Or the pods still serve {self.displaced}, which had this pool before and does not "
            "renew its Lease: end that program"
            if self.displaced
            else ""
        )
        return (
            "Pods cannot connect to that address: it is behind NAT, or a firewall or a "
            "NetworkPolicy is in between. Run the program in a pod of the cluster, or set "
            "listen_host (FIBER_LISTEN_HOST) to an address of this machine that pods reach, or "
            "advertised_host (FIBER_ADVERTISED_HOST) to one that is forwarded to it, or "
            f"allow the connection{others}"
        )


# ---- what to warn of ------------------------------------------------------------------------


def new_problems(pool: PoolName, before: Status, status: Status) -> Iterator[str]:
    """A sentence for each problem that ``before`` did not have, or only as a warning."""
    told = {(problem.get("reason"), problem.get("severity")) for problem in _problems(before)}
    for problem in _problems(status):
        reason = problem.get("reason")
        if not told & {(reason, problem.get("severity")), (reason, "Error")}:
            count = problem.get("count", 1)
            many = f" ({count} pods)" if problem.get("pod") and count > 1 else ""
            yield f"{pool}: {reason}{many}: {problem.get('message', '')}"


# ---- what ends the wait ---------------------------------------------------------------------

_WAITS_FOR_SOMEBODY = frozenset(
    {
        Reason.CONTAINER_CONFIG_ERROR,
        Reason.CONTAINER_ERROR,
        Reason.FORBIDDEN,
        Reason.IMAGE_PULL_ERROR,
        Reason.QUOTA_EXCEEDED,
        Reason.REQUESTS_MISSING,
        Reason.UNSCHEDULABLE,
    }
)
"""Errors that pass when somebody changes something.  Of the others that are not terminal the
operator takes care: it tries again, and says when it gives up."""


def running(status: Status) -> int:
    """Return how many pods run; one whose agent does not arrive is never ready."""
    return max(0, (status.get("replicas") or 0) - (status.get("pendingReplicas") or 0))


def failure(pool: PoolName, status: Status, joined: int) -> FiberPoolError | None:
    """Why nobody will serve the program, with ``joined`` workers there now.

    A pool with workers goes on with them, whatever is wrong with others.
    """
    if joined or running(status):
        return None
    if _is_true(status, ConditionType.SUSPENDED):
        return pool.error(
            "it is suspended (spec.suspend), so that it has no workers. Set that to false, or use "
            "another pool.",
            Reason.SUSPENDED,
        )
    for problem in _problems(status):
        if problem.get("terminal") or _concerns_all(problem, status):
            return pool.error(_told(problem), problem["reason"])
    return None


def overdue(pool: PoolName, status: Status, waited: float, now: float, way: Way) -> FiberPoolError:
    """No worker came in time: what is known of why.  ``now`` is in unix seconds."""
    worst = next(_problems(status), None)
    why = f"{way.advice}." if running(status) else ""
    if not why and worst is not None:
        why = _told(worst)
    return pool.error(
        f"no worker has joined after {waited:g} s: {summary(status, now)}. {why}".rstrip()
        + f" See kubectl describe fiberpool {pool.name} --namespace {pool.namespace}, or allow "
        "more time (pod_timeout).",
        "StartTimeout" if worst is None else worst["reason"],
    )


def unreachable(pool: PoolName, status: Status, waited: float, way: Way) -> FiberPoolError:
    """Return the error for pods that run and whose agents do not arrive."""
    number = running(status)
    pods = f"its {number} running pods" if number != 1 else "its running pod"
    return pool.error(
        f"no agent of {pods} has reached this program at {way.address} within {waited:.0f} s. "
        f"{way.advice}",
        "Unreachable",
    )


def _concerns_all(problem: Mapping[str, Any], status: Status) -> bool:
    """Tell whether a problem is an error of every pod, and needs a person to mend it."""
    if problem.get("severity") != "Error" or problem.get("reason") not in _WAITS_FOR_SOMEBODY:
        return False
    replicas = status.get("replicas") or 0
    return problem.get("count", 1) >= replicas if problem.get("pod") else not replicas


def _told(problem: Mapping[str, Any]) -> str:
    return f"{problem.get('reason')}: {problem.get('message', '')}"


# ---- one line for people --------------------------------------------------------------------

_SCHEDULER = re.compile(r"\d+/\d+ nodes are available: (?:[^.\n]|\.(?! ))+")

_LONGEST_CAUSE = 120


def summary(status: Status, now: float) -> str:
    """Return the number of pods and what keeps the others: ``12 of 50 pods ready, 30 pending:
    0/3 nodes are available: insufficient cpu (for 14 s)``.  ``now`` is in unix seconds.
    """
    if "observedGeneration" not in status:
        return "the operator has not looked at it yet"
    wanted, ready = status.get("desiredReplicas") or 0, status.get("readyReplicas") or 0
    parts = [f"{ready} of {wanted} pods ready"]
    if pending := status.get("pendingReplicas"):
        parts.append(f"{pending} pending")
    worst = next(_problems(status), None)
    return ", ".join(parts) + ("" if worst is None else f": {_cause(worst, now)}")


def _cause(problem: Mapping[str, Any], now: float) -> str:
    message = str(problem.get("message", ""))
    # What the operator says around the scheduler's words is for who has the time to read it.
    scheduler = _SCHEDULER.search(message)
    cause = scheduler[0] if scheduler else f"{problem.get('reason')}: {message}"
    cause = cause.partition("\n")[0].partition(". ")[0].rstrip(".")
    if len(cause) > _LONGEST_CAUSE:
        cause = cause[: _LONGEST_CAUSE - 3] + "..."
    try:
        seconds = max(0.0, now - parse_time(str(problem.get("since"))))
    except ValueError:
        return cause
    return f"{cause} (for {seconds:.0f} s)"


_OF_THE_MASTER = frozenset({Reason.LEASE_NOT_FOUND, Reason.MASTER_LOST})
"""Reasons that do not concern this program, which lives.  It makes and renews the Lease itself: the
operator may have looked between two of its steps, or while it was stopped."""


def _problems(status: Status) -> Iterator[Mapping[str, Any]]:
    """The worst first, as the operator sorted them."""
    for problem in status.get("problems") or ():
        if problem.get("reason") not in _OF_THE_MASTER:
            yield problem


def _is_true(status: Status, kind: ConditionType) -> bool:
    conditions = status.get("conditions") or ()
    return any(c.get("type") == kind and c.get("status") == "True" for c in conditions)
