"""The problems of pods that failed."""

from __future__ import annotations

from collections.abc import Iterator

from fiber_api.names import Reason
from fiber_api.v1alpha1 import Problem
from fiber_operator.planning import wording
from fiber_operator.planning.failures import given_up, in_itself
from fiber_operator.planning.pods import PodView, State, Trouble
from fiber_operator.planning.situation import Situation


def failed_pods(situation: Situation) -> Iterator[Problem]:
    """Yield the problems of failed pods, until the failures are forgotten."""
    failures = situation.account.failures
    if not failures.waves:
        return
    has_failed = failures.last_reason != Reason.COMPLETED
    last = _last_failure(situation) if has_failed else _last_completed(situation)
    if given_up(failures, situation.pool.spec.failure_policy):
        yield situation.problem(
            Reason.BACKOFF_LIMIT_EXCEEDED,
            wording.limit_exceeded(situation.pool, failures, last.message if last else ""),
            terminal=True,
            count=failures.consecutive,
            pod=last.pod if last else None,
        )
    if last:
        yield last


def _last_completed(situation: Situation) -> Problem | None:
    """Workers that end of themselves again and again."""
    waves, newly = situation.account.failures.waves, situation.account.failed[-1:]
    if not newly or waves < 2:
        return situation.previous(Reason.COMPLETED)
    message = wording.completed(situation.pool, situation.account.failures, newly[0])
    return situation.problem(
        Reason.COMPLETED, message, severity="Warning", count=waves, pod=newly[0].name
    )


_FAILURES = (
    Reason.CONTAINER_FAILED,
    Reason.OOM_KILLED,
    Reason.COMPLETED,
    Reason.RUN_CONTAINER_ERROR,
    Reason.STARTUP_TIMEOUT,
)


def _last_failure(situation: Situation) -> Problem:
    failures, pool = situation.account.failures, situation.pool
    newly = list(filter(in_itself, situation.account.failed))[-1:]
    late = [pod for pod in newly if pod.state is not State.ENDED]
    failed = [pod for pod in situation.ended if pod.trouble is Trouble.APPLICATION]
    newest = max(late or failed, key=lambda pod: (pod.since, pod.name), default=None)
    was_late = failures.last_reason == Reason.STARTUP_TIMEOUT and not late
    if newest is None or was_late:
        # The pods are gone; what the status said of them is all that is left.
        kinds = (Reason.STARTUP_TIMEOUT,) if was_late else _FAILURES
        before = next(filter(None, map(situation.previous, kinds)), None)
        return before or situation.problem(kinds[0], wording.forgotten_failure(pool, failures))
    reason = failure_reason(newest)
    before = situation.previous(reason)
    if late:
        warning = situation.memory.warnings.get(newest.name, "")
        message = wording.late_failure(pool, failures, newest, warning)
    else:
        message = wording.failure(pool, failures, reason, newest)
    return situation.problem(
        reason,
        message,
        terminal=_hopeless(newest),
        count=max(1, (before.count if before else 0) + len(situation.account.failed)),
        pod=newest.name,
    )


def failure_reason(pod: PodView) -> Reason:
    """Return the reason of the problem for a failed worker."""
    if pod.state is not State.ENDED:
        return Reason.STARTUP_TIMEOUT
    if pod.reason == "OOMKilled":
        return Reason.OOM_KILLED
    if pod.reason in ("StartError", "ContainerCannotRun"):
        return Reason.RUN_CONTAINER_ERROR
    return Reason.COMPLETED if pod.exit_code == 0 else Reason.CONTAINER_FAILED


_NO_PROGRAM = ("executable file not found", "no such file or directory", "exec format error")


def _hopeless(pod: PodView) -> bool:
    """Tell whether the image lacks the program, so that no later attempt can succeed."""
    start_failed = failure_reason(pod) == Reason.RUN_CONTAINER_ERROR
    return start_failed and any(words in pod.message for words in _NO_PROGRAM)
