"""The events of a plan: what it does, and what was not so when the status was last written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from fiber_api.names import ConditionType, Reason
from fiber_api.v1alpha1 import FiberPoolStatus
from fiber_operator.planning import wording
from fiber_operator.planning.failures import Account
from fiber_operator.planning.plans import Deletion, Event


@dataclass(frozen=True)
class Change:
    """From one status to the next, and what is done between."""

    before: FiberPoolStatus
    after: FiberPoolStatus
    account: Account
    create: int
    delete: Sequence[Deletion]


def events(change: Change, *, told: bool) -> Iterator[Event]:
    """Yield events for actions; then, if the new status is ``told``, for the news in it."""
    yield from _actions(change)
    if told:
        yield from _disruptions(change)
        yield from _problems(change)
        yield from _masters(change)


_DELETIONS = {
    Reason.RELEASED: "Deleting workers that the master released",
    Reason.SCALED_DOWN: "Deleting workers: fewer are wanted",
    Reason.REPLACED: "Deleting workers of an older template",
    Reason.COMPLETED: "Deleting workers that had ended with exit code 0",
    Reason.SUSPENDED: "Deleting workers: the pool is suspended",
}


def _actions(change: Change) -> Iterator[Event]:
    # Without numbers: a look follows the other, and what is told again raises a count.
    reasons = {deletion.reason for deletion in change.delete}
    for reason, said in _DELETIONS.items():
        if reason in reasons:
            yield Event("Normal", reason, said)
    if change.create:
        yield Event("Normal", Reason.SCALED_UP, "Creating workers: more are wanted than are there")


def _disruptions(change: Change) -> Iterator[Event]:
    disrupted = change.account.disrupted
    if not disrupted:
        return
    pod = disrupted[-1]
    others = f" and {len(disrupted) - 1} more" if len(disrupted) > 1 else ""
    words = " ".join(filter(None, (pod.reason, pod.message)))
    message = f"{pod.name}{others} ended through no fault of its own{wording.quoted(words)}"
    yield Event("Normal", Reason.DISRUPTED, f"{message}. A new one takes its place at once")


def _problems(change: Change) -> Iterator[Event]:
    known = {(problem.reason, problem.severity) for problem in change.before.problems}
    failed = {pod.name for pod in change.account.failed}
    for problem in change.after.problems:
        if (problem.reason, problem.severity) not in known or problem.pod in failed:
            yield Event("Warning", problem.reason, _without_output(problem.message))
    if _degraded(change.before) == "True" and _degraded(change.after) == "False":
        yield Event("Normal", Reason.RECOVERED, "What was wrong with the pool is so no more")


def _masters(change: Change) -> Iterator[Event]:
    before, after = change.before, change.after
    if (before.master, before.master_epoch) == (after.master, after.master_epoch):
        return
    if after.master:
        message = f"Workers dial the master at {after.master}, epoch {after.master_epoch}"
    else:
        message = "The master has left; the workers wait for the next"
    yield Event("Normal", Reason.MASTER_CHANGED, message)


def _without_output(message: str) -> str:
    """Less a worker's last lines.

    They may hold what others must not read, and events and this operator's log end up where
    everybody looks; the status and the pod's log are read by whoever may read pools and pods.
    """
    return message.partition(wording.LAST_LINES)[0]


def _degraded(status: FiberPoolStatus) -> str:
    found = (c.status for c in status.conditions if c.type == ConditionType.DEGRADED)
    return next(found, "Unknown")
