"""Problems of a pool, the worst first.  Users read them in the status; the SDK raises them."""

from __future__ import annotations

import ipaddress
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from fiber_api import names
from fiber_api.names import Reason
from fiber_api.status import MAX_COUNT
from fiber_api.times import format_time
from fiber_api.v1alpha1 import FiberPool, Problem
from fiber_operator.planning import messages
from fiber_operator.planning.assessment import MasterState, find_cut_off
from fiber_operator.planning.documents import unless_ahead
from fiber_operator.planning.failures import Account, given_up, in_itself
from fiber_operator.planning.plans import Knowledge
from fiber_operator.planning.pods import PodState, PodView, Trouble

# -- The situation

SECOND_LOOK = 30.0
"""Seconds after which a problem that may pass by itself counts as an error."""

Severity = Literal["Error", "Warning"]


@dataclass(frozen=True)
class Situation:
    """Facts about a pool from which its problems follow."""

    pool: FiberPool
    live: Sequence[PodView]
    ended: Sequence[PodView]
    account: Account
    master_state: MasterState
    knowledge: Knowledge
    template_hash: str
    wants_more: bool
    """True if pods are missing, also if they may not be created now."""
    creates: bool
    """True if pods are created now, or one in a dry run."""
    deletes: bool
    """True if a pod or the pool is deleted now."""
    now: float

    def previous(self, reason: str) -> Problem | None:
        """Return the problem with that reason from the status."""
        found = next((p for p in self.pool.status.problems if p.reason == reason), None)
        if found is None or unless_ahead(found.since, self.now) is not None:
            return found
        return found.model_copy(update={"since": float(math.floor(self.now))})

    def severity(self, reason: str, *, again: bool = False) -> Severity:
        """Return the severity of a problem that may pass: first a warning, ``again`` an error."""
        before = self.previous(reason)
        lasted = before and before.since and self.now - before.since >= SECOND_LOOK
        was_error = before is not None and before.severity == "Error"
        return "Error" if again or lasted or was_error else "Warning"

    def example(self, reason: str, pods: Iterable[PodView]) -> PodView:
        """Return the pod to name: the one that the status names, else the oldest."""
        before = self.previous(reason)
        named = before.pod if before else None
        return min(pods, key=lambda pod: (pod.name != named, pod.created, pod.name))

    def problem(
        self,
        reason: str,
        message: str,
        *,
        severity: Severity = "Error",
        terminal: bool = False,
        count: int = 1,
        pod: str | None = None,
    ) -> Problem:
        """Return a problem, with the time since which it exists."""
        before = self.previous(reason)
        since = before.since if before else None
        return Problem(
            reason=reason,
            severity=severity,
            terminal=terminal,
            count=min(count, MAX_COUNT),
            since=since or float(math.floor(self.now)),
            pod=pod,
            message=message,
        )


# -- All problems

_WORKER_NAME = re.compile(f"[0-9a-f]{{{names.POD_SUFFIX_LENGTH}}}")


def find(situation: Situation) -> tuple[Problem, ...]:
    """Return the problems, the worst first: one for each reason, at most ten."""
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
    yield from pods_no_longer_ready(situation)
    yield from _cut_off(situation)
    yield from _masters(situation)
    yield from _releases(situation)


def _obstacles(situation: Situation) -> Iterator[Problem]:
    knowledge = situation.knowledge
    hindered = (
        *knowledge.obstacles,
        knowledge.creation if situation.creates else None,
        knowledge.deletion if situation.deletes else None,
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
    refused = situation.knowledge.refusal
    if refused is None or refused.template_hash != situation.template_hash:
        return
    if refused.namespace_ends:
        return  # the namespace deletes its pods before the pool, which follows
    reason = refused.reason
    if situation.wants_more or reason == Reason.INVALID_TEMPLATE:
        yield situation.problem(
            reason,
            messages.refusal(reason, refused),
            severity=situation.severity(reason) if refused.lacks_account else "Error",
            terminal=refused.terminal,
        )


def _masters(situation: Situation) -> Iterator[Problem]:
    pool, knowledge, master_state = situation.pool, situation.knowledge, situation.master_state
    if master_state.lost_since is not None:
        message = messages.master_lost(pool, master_state.lost_since, knowledge.master)
        yield situation.problem(Reason.MASTER_LOST, message)
    if master_state.missing:
        severity = situation.severity(Reason.LEASE_NOT_FOUND)
        message = messages.no_lease(pool)
        yield situation.problem(Reason.LEASE_NOT_FOUND, message, severity=severity)
    if pool.spec.master and knowledge.master.unreadable:
        message = messages.unreadable_lease(pool, knowledge.master.unreadable)
        yield situation.problem(Reason.FORBIDDEN, message, severity="Warning")
    direct = pool.spec.master and not pool.spec.relay
    if direct and knowledge.address and _families_differ(pool, knowledge.address):
        message = messages.wrong_family(pool, knowledge.address)
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
        message = messages.foreign_releases(situation.pool, foreign)
        yield situation.problem(
            Reason.INVALID_RELEASE, message, severity="Warning", count=len(foreign)
        )


# -- Pods that do not start

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
    message = messages.not_starting(reason, pod)
    before = situation.previous(reason)
    if before and before.pod == pod.name and _says_less(pod.message):
        message = before.message
    hopeless = reason in (Reason.INVALID_IMAGE_NAME, Reason.IMAGE_NEVER_PULL)
    return situation.problem(
        reason,
        message,
        severity=severity,
        terminal=hopeless or messages.wants_root(pod),
        count=len(pods),
        pod=pod.name,
    )


def _says_less(message: str) -> bool:
    # Older kubelets state the cause with ErrImagePull, but not with ImagePullBackOff.
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
        messages.unschedulable(pod),
        severity="Error" if overdue else "Warning",
        count=len(pods),
        pod=pod.name,
    )


def _on_their_way(situation: Situation, pods: Sequence[PodView]) -> Iterator[Problem]:
    """Yield the problems of pods that are starting according to their status."""
    for pod in pods:
        warning = situation.knowledge.warnings.get(pod.name, "")
        reason = warning.partition(":")[0]
        if reason:
            severity = situation.severity(reason)
            message = messages.stuck(pod, warning)
            yield situation.problem(reason, message, severity=severity, pod=pod.name)
    timeout = situation.pool.spec.failure_policy.startup_timeout_seconds
    overdue = [pod for pod in pods if situation.now >= pod.created + timeout and pod.scheduled]
    if overdue:
        pod = situation.example(Reason.STARTUP_TIMEOUT, overdue)
        message = messages.late(pod, timeout)
        yield situation.problem(Reason.STARTUP_TIMEOUT, message, count=len(overdue), pod=pod.name)


def pods_no_longer_ready(situation: Situation) -> Iterator[Problem]:
    """Yield the problem of workers that were Ready and are not now."""
    pods = [pod for pod in situation.live if pod.state is PodState.NOT_READY]
    if pods:
        pod = situation.example(Reason.NOT_READY, pods)
        yield situation.problem(
            Reason.NOT_READY,
            messages.not_ready(pod),
            severity="Warning",
            count=len(pods),
            pod=pod.name,
        )


# -- Pods that failed


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
            messages.limit_exceeded(situation.pool, failures, last.message if last else ""),
            terminal=True,
            count=failures.consecutive,
            pod=last.pod if last else None,
        )
    if last:
        yield last


def _last_completed(situation: Situation) -> Problem | None:
    """Return the problem of workers that end by themselves again and again."""
    waves, newly = situation.account.failures.waves, situation.account.failed[-1:]
    if not newly or waves < 2:
        return situation.previous(Reason.COMPLETED)
    message = messages.completed(situation.pool, situation.account.failures, newly[0])
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
    late = [pod for pod in newly if pod.state is not PodState.ENDED]
    failed = [pod for pod in situation.ended if pod.trouble is Trouble.APPLICATION]
    newest = max(late or failed, key=lambda pod: (pod.since, pod.name), default=None)
    was_late = failures.last_reason == Reason.STARTUP_TIMEOUT and not late
    if newest is None or was_late:
        # The pods are gone: the problem comes from the status.
        kinds = (Reason.STARTUP_TIMEOUT,) if was_late else _FAILURES
        before = next(filter(None, map(situation.previous, kinds)), None)
        return before or situation.problem(kinds[0], messages.forgotten_failure(pool, failures))
    reason = failure_reason(newest)
    before = situation.previous(reason)
    if late:
        warning = situation.knowledge.warnings.get(newest.name, "")
        message = messages.late_failure(pool, failures, newest, warning)
    else:
        message = messages.failure(pool, failures, reason, newest)
    return situation.problem(
        reason,
        message,
        terminal=_hopeless(newest),
        count=max(1, (before.count if before else 0) + len(situation.account.failed)),
        pod=newest.name,
    )


def failure_reason(pod: PodView) -> Reason:
    """Return the reason of the problem for a failed worker."""
    if pod.state is not PodState.ENDED:
        return Reason.STARTUP_TIMEOUT
    if pod.reason == "OOMKilled":
        return Reason.OOM_KILLED
    if pod.reason in ("StartError", "ContainerCannotRun"):
        return Reason.RUN_CONTAINER_ERROR
    return Reason.COMPLETED if pod.exit_code == 0 else Reason.CONTAINER_FAILED


_NO_PROGRAM = ("executable file not found", "no such file or directory", "exec format error")


def _hopeless(pod: PodView) -> bool:
    """Return True if the image lacks the program, so that no later attempt can succeed."""
    start_failed = failure_reason(pod) == Reason.RUN_CONTAINER_ERROR
    return start_failed and any(words in pod.message for words in _NO_PROGRAM)


# -- Pods that cannot reach their master


def _cut_off(situation: Situation) -> Iterator[Problem]:
    """Yield the problems of pods that are cut off and not deleted now."""
    found = find_cut_off(situation.pool, situation.live, situation.knowledge)
    if pods := found.by_address:
        pod = situation.example(Reason.ADDRESS_CHANGED, pods)
        yield situation.problem(
            Reason.ADDRESS_CHANGED, _address_changed(situation, pod), count=len(pods), pod=pod.name
        )
    if pods := found.by_credentials:
        pod = situation.example(Reason.CREDENTIALS_CHANGED, pods)
        yield situation.problem(
            Reason.CREDENTIALS_CHANGED,
            _credentials_changed(situation),
            count=len(pods),
            pod=pod.name,
        )


def _address_changed(situation: Situation, pod: PodView) -> str:
    pool = situation.pool.metadata
    return (
        f"Workers dial {pod.address}, which was the address of the Service "
        f"{names.service_name(pool.name)} until it was deleted. It is "
        f"{situation.knowledge.address} now, because the old one is taken. These workers "
        f"cannot connect to a master again. {_REPLACED[situation.pool.spec.update.strategy]} To "
        f"get new ones at once: {_delete(situation)}."
    )


def _credentials_changed(situation: Situation) -> str:
    pool = situation.pool.metadata
    secret = situation.knowledge.secret
    made = format_time(secret.made if secret else 0.0)
    first, fate = "Delete the workers", _REPLACED[situation.pool.spec.update.strategy]
    if situation.master_state.attached:
        first, fate = (
            "Restart the master, which may hold the old keys, too, and delete the workers",
            "",
        )
    return " ".join(
        filter(
            None,
            (
                f"The Secret {names.secret_name(pool.name)} was made anew at {made}, "
                "because it was deleted. Workers hold keys of the old one, and a master with "
                "keys of the new one refuses them.",
                fate,
                f"{first} to get new ones at once: {_delete(situation)}.",
            ),
        )
    )


def _delete(situation: Situation) -> str:
    pool = situation.pool.metadata
    return f"kubectl -n {pool.namespace} delete pods -l {names.LABEL_POOL}={pool.name}"


_REPLACED = {
    "OnIdle": "Idle ones are replaced a few at a time.",
    "Recreate": "They are replaced now.",
    "OnDelete": "They stay until they are deleted (update.strategy is OnDelete).",
}
