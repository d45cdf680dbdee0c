"""The problems of pods that do not start, and of those that are not Ready any more."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from fiber_api.names import Reason
from fiber_api.v1alpha1 import Problem
from fiber_operator.planning import wording
from fiber_operator.planning.pods import PodView, State, Trouble
from fiber_operator.planning.situation import Severity, Situation

_REASONS = {
    "InvalidImageName": Reason.INVALID_IMAGE_NAME,
    "ErrImageNeverPull": Reason.IMAGE_NEVER_PULL,
    "ErrImagePull": Reason.IMAGE_PULL_ERROR,
    "ImagePullBackOff": Reason.IMAGE_PULL_ERROR,
    "ImageInspectError": Reason.IMAGE_PULL_ERROR,
    "RegistryUnavailable": Reason.IMAGE_PULL_ERROR,
    "SignatureValidationFailed": Reason.IMAGE_PULL_ERROR,
    "CreateContainerConfigError": Reason.CONTAINER_CONFIG_ERROR,
    "RunContainerError": Reason.RUN_CONTAINER_ERROR,
    "CrashLoopBackOff": Reason.CONTAINER_FAILED,
}


def pods_that_do_not_start(situation: Situation) -> Iterator[Problem]:
    """Yield a problem for each reason that keeps pods from starting."""
    waiting = [pod for pod in situation.live if not pod.was_ready]
    stuck: dict[Reason, list[PodView]] = {}
    for pod in waiting:
        if pod.trouble is Trouble.CANNOT_START:
            stuck.setdefault(_REASONS.get(pod.reason, Reason.CONTAINER_ERROR), []).append(pod)
    for reason, pods in stuck.items():
        yield _cannot_start(situation, reason, pods)
    yield from _unschedulable(
        situation, [pod for pod in waiting if pod.trouble is Trouble.UNSCHEDULABLE]
    )
    yield from _on_their_way(situation, [pod for pod in waiting if pod.trouble is None])


def _cannot_start(situation: Situation, reason: Reason, pods: Sequence[PodView]) -> Problem:
    pod = situation.example(reason, pods)
    severity: Severity = "Error"
    if reason == Reason.IMAGE_PULL_ERROR:
        again = any(pod.reason == "ImagePullBackOff" for pod in pods)
        severity = situation.severity(reason, again=again)
    message = wording.not_starting(reason, pod)
    before = situation.previous(reason)
    if before and before.pod == pod.name and _says_less(pod.message):
        message = before.message
    hopeless = reason in (Reason.INVALID_IMAGE_NAME, Reason.IMAGE_NEVER_PULL)
    return situation.problem(
        reason,
        message,
        severity=severity,
        terminal=hopeless or wording.wants_root(pod),
        count=len(pods),
        pod=pod.name,
    )


def _says_less(message: str) -> bool:
    # Older kubelets tell the cause at ErrImagePull and only that they wait at ImagePullBackOff.
    return message.startswith("Back-off pulling image") and ": " not in message


def _unschedulable(situation: Situation, pods: Sequence[PodView]) -> Iterator[Problem]:
    if not pods:
        return
    reason = Reason.UNSCHEDULABLE
    pod = situation.example(reason, pods)
    timeout = situation.pool.spec.failure_policy.startup_timeout_seconds
    overdue = situation.now >= min(pod.created for pod in pods) + timeout
    yield situation.problem(
        reason,
        wording.unschedulable(pod),
        severity="Error" if overdue else "Warning",
        count=len(pods),
        pod=pod.name,
    )


def _on_their_way(situation: Situation, pods: Sequence[PodView]) -> Iterator[Problem]:
    """Pods that start, as far as their own status tells."""
    for pod in pods:
        warning = situation.memory.warnings.get(pod.name, "")
        reason = warning.partition(":")[0]
        if reason:
            severity = situation.severity(reason)
            message = wording.stuck(pod, warning)
            yield situation.problem(reason, message, severity=severity, pod=pod.name)
    timeout = situation.pool.spec.failure_policy.startup_timeout_seconds
    overdue = [pod for pod in pods if situation.now >= pod.created + timeout and pod.scheduled]
    if overdue:
        pod = situation.example(Reason.STARTUP_TIMEOUT, overdue)
        message = wording.late(pod, timeout)
        yield situation.problem(Reason.STARTUP_TIMEOUT, message, count=len(overdue), pod=pod.name)


def pods_not_ready_any_more(situation: Situation) -> Iterator[Problem]:
    """Workers that were Ready, while Kubernetes has not given them up."""
    pods = [pod for pod in situation.live if pod.state is State.NOT_READY]
    if pods:
        pod = situation.example(Reason.NOT_READY, pods)
        yield situation.problem(
            Reason.NOT_READY,
            wording.not_ready(pod),
            severity="Warning",
            count=len(pods),
            pod=pod.name,
        )
