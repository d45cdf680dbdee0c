"""The problems of pods that failed."""

from __future__ import annotations

from collections.abc import Iterator

from fiber_api.names import Reason
from fiber_api.v1alpha1 import Problem
from fiber_operator.planning import wording
from fiber_operator.planning.pods import PodView, State, Trouble
from fiber_operator.planning.situation import Situation


def failed_pods(situation: Situation) -> Iterator[Problem]:
    """What is wrong as long as failures are not forgotten."""
    record = situation.account.record
    if not record.consecutive:
        return
    last = _last_failure(situation)
    policy = situation.pool.spec.failure_policy
    if record.exhausted(policy):
        yield situation.problem(
            Reason.BACKOFF_LIMIT_EXCEEDED,
            wording.limit_exceeded(situation.pool, record, last.message),
            terminal=True,
            count=record.consecutive,
            pod=last.pod,
        )
    yield last


def completed_pods(situation: Situation) -> Iterator[Problem]:
    """Workers that end of themselves again and again."""
    record, reason = situation.account.record, Reason.COMPLETED
    if record.completions < 2:
        return
    before, newly = situation.previous(reason), situation.account.completed[-1:]
    if before and before.severity == "Warning" and not newly:
        yield before
        return
    message = wording.completed(situation.pool, record, newly[0] if newly else None)
    yield situation.problem(
        reason,
        message,
        severity="Warning",
        count=record.completions,
        pod=newly[0].name if newly else None,
    )


_FAILURES = (
    Reason.CONTAINER_FAILED,
    Reason.OOM_KILLED,
    Reason.COMPLETED,
    Reason.RUN_CONTAINER_ERROR,
    Reason.STARTUP_TIMEOUT,
)


def _last_failure(situation: Situation) -> Problem:
    record, pool = situation.account.record, situation.pool
    newly = situation.account.failed[-1:]
    late = [pod for pod in newly if pod.state is not State.ENDED]
    failed = [pod for pod in situation.ended if pod.trouble is Trouble.APPLICATION]
    newest = max(late or failed, key=lambda pod: (pod.since, pod.name), default=None)
    was_late = record.last_reason == Reason.STARTUP_TIMEOUT and not late
    if newest is None or was_late:
        # The pods are gone; what the status said of them is all that is left.
        kinds = (Reason.STARTUP_TIMEOUT,) if was_late else _FAILURES
        before = next(filter(None, map(situation.previous, kinds)), None)
        return before or situation.problem(kinds[0], wording.forgotten_failure(pool, record))
    reason = failure_reason(newest)
    before = situation.previous(reason)
    if late:
        warning = situation.memory.warnings.get(newest.name, "")
        message = wording.late_failure(pool, record, newest, warning)
    else:
        message = wording.failure(pool, record, reason, newest)
    return situation.problem(
        reason,
        message,
        terminal=_hopeless(newest),
        count=max(1, (before.count if before else 0) + len(situation.account.failed)),
        pod=newest.name,
    )


def failure_reason(pod: PodView) -> Reason:
    """Which problem a failed worker is."""
    if pod.state is not State.ENDED:
        return Reason.STARTUP_TIMEOUT
    if pod.reason == "OOMKilled":
        return Reason.OOM_KILLED
    if pod.reason in ("StartError", "ContainerCannotRun"):
        return Reason.RUN_CONTAINER_ERROR
    return Reason.COMPLETED if pod.exit_code == 0 else Reason.CONTAINER_FAILED


_NO_PROGRAM = ("executable file not found", "no such file or directory", "exec format error")


def _hopeless(pod: PodView) -> bool:
    """Whether the image has no such program: no second attempt will find it."""
    start_failed = failure_reason(pod) == Reason.RUN_CONTAINER_ERROR
    return start_failed and any(words in pod.message for words in _NO_PROGRAM)
