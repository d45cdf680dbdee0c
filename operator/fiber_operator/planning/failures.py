"""Failed workers: each is counted once, and replaced after a delay.

*Delay.*  The failures up to the next creation are one wave.  The delay doubles with each wave.  It
starts anew once workers live: when a new worker has been Ready for a minute, or when each worker
that fails now had been.  Only the places of failed workers wait; other missing workers are created
at once.

*Giving up.*  After more than ``backoffLimit`` waves in a row, at none of which half of the wanted
workers had been Ready for a minute, no pod is created until the spec changes.

A worker that ends with exit code 0 without being released waits in the same way, but is no reason
to give up: an agent ends so after it had no master for too long.

All of this is kept in the pool's status and survives a restart of the operator.  ``counted`` names
ended pods that still exist and are already in the sums; it is written before they are deleted.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

from fiber_api.names import Reason
from fiber_api.status import MAX_COUNT
from fiber_api.v1alpha1 import FailurePolicy, Failures
from fiber_operator.planning.pods import BRIEF, PodState, PodView, Trouble

RECOVERY = 60.0
"""Seconds for which a worker must be Ready to prove that workers can live."""

NAMES = 1000
"""Most pods that a status names, because a status that is too large for etcd would stop the pool.
Further failures are counted after named pods are gone."""

AT_ONCE = "CompletedAtOnce"
"""Reason of a worker that ended with exit code 0 before it had worked."""

_JITTER = 0.1
"""Largest share that is added to a delay, so that pools that failed together are spread out."""


def delay(policy: FailurePolicy, waves: int, seed: str) -> float:
    """Return the delay in seconds after so many waves; the same for the same arguments."""
    doubled = policy.backoff_base_seconds * (1 << min(max(waves, 1) - 1, 30))
    digest = hashlib.sha256(f"{seed}/{waves}".encode()).digest()
    jitter = _JITTER * int.from_bytes(digest[:4]) / 2**32
    return min(policy.backoff_max_seconds, doubled) * (1 + jitter)


def given_up(failures: Failures, policy: FailurePolicy) -> bool:
    """Return True if no pod is created until the user changes the spec."""
    return failures.consecutive > policy.backoff_limit


def held_back_until(failures: Failures, now: float) -> float | None:
    """Return the time at which waiting replacements are created; None if none waits."""
    due = failures.next_create_time
    return due if failures.waiting and due is not None and due > now else None


@dataclass(frozen=True)
class Account:
    """Account of failures after one observation of the pods."""

    failures: Failures
    proven: str | None
    """Hash of the last template of which a pod was Ready."""
    failed: tuple[PodView, ...] = ()
    """Failed pods that were counted now, the newest last."""
    disrupted: tuple[PodView, ...] = ()
    held_back: int = 0
    """Number of failed workers that are not to be replaced yet."""
    recovery_at: float | None = None
    """Time at which the waves end if no worker fails until then."""


def account(
    before: Failures,
    proven: str | None,
    pods: Sequence[PodView],
    *,
    expected: Collection[str],
    late: Collection[str],
    desired: int,
    template_hash: str,
    spec_hash: str,
    policy: FailurePolicy,
    seed: str,
    now: float,
) -> Account:
    """Bring the account up to date.

    ``expected`` names pods whose end was requested.  ``late`` names pods that are not Ready in
    time, which counts as a failure.  ``desired`` is the number of wanted workers, without those
    that are missing for other reasons than failures.
    """
    found = _begin(before, pods, late, spec_hash, policy, now)
    ended = [p for p in pods if p.name not in found.counted and p.name not in expected]
    ended.sort(key=lambda pod: (pod.since, pod.name))
    failing = [p for p in ended if p.name in late or _failed(p)]
    failed = failing[: NAMES - len(found.counted)]
    # Pods of a silent node exist for long; they must leave room for failures.
    room = max(0, NAMES // 2 - len(found.counted) - len(failed))
    disrupted = [p for p in ended if p.name not in late and _disrupted(p)][:room]
    found = _with(
        found,
        total=found.total + len(failed),
        disrupted=found.disrupted + len(disrupted),
        waiting=found.waiting + len(failed),
        counted=tuple(sorted({*found.counted, *(p.name for p in (*failed, *disrupted))})),
    )
    lives = sum(_has_lived(p, now) for p in (*(p for p in pods if p.live), *failed))
    works = 2 * lives >= max(1, desired)
    if failed:
        found = _fail(found, failed, works, policy, seed, now)
    if works and not given_up(found, policy):
        found = _with(found, consecutive=0)
    recovery_at = _recovery_time(found, pods, desired, policy, seed)
    if recovery_at is not None and recovery_at <= now:
        found, recovery_at = _with(found, waves=0, waiting=0, next_create_time=None), None
    return Account(
        found,
        _proven(proven, found, pods, failed, template_hash, now),
        tuple(failed),
        tuple(disrupted),
        found.waiting + len(failing) - len(failed),
        recovery_at,
    )


def _with(failures: Failures, **fields: Any) -> Failures:
    """Return failures with other fields.  Sums stay within the limits of a status."""
    held = {key: min(x, MAX_COUNT) if isinstance(x, int) else x for key, x in fields.items()}
    return failures.model_copy(update=held)


def _begin(
    before: Failures,
    pods: Sequence[PodView],
    late: Collection[str],
    spec_hash: str,
    policy: FailurePolicy,
    now: float,
) -> Failures:
    """Return the failures without deleted pods, delays that are over, and waves of another spec."""
    # A late pod that became Ready before its deletion is like any other.
    there = {pod.name for pod in pods if not pod.live or pod.name in late}
    found = _with(before, counted=tuple(name for name in before.counted if name in there))
    if found.spec_hash != spec_hash:
        fresh = {"consecutive": 0, "waves": 0, "waiting": 0, "next_create_time": None}
        return _with(found, spec_hash=spec_hash, **fresh)
    due = found.next_create_time
    if given_up(found, policy) or due is None or due > now + _longest(policy):
        return _with(found, waiting=0, next_create_time=None)
    return found if due > now else _with(found, waiting=0)


def _longest(policy: FailurePolicy) -> float:
    """Return the longest delay.  A later time was not written under this policy."""
    return policy.backoff_max_seconds * (1 + _JITTER) + 1


def _failed(pod: PodView) -> bool:
    return pod.state is PodState.ENDED and pod.trouble is not Trouble.DISRUPTED


def in_itself(pod: PodView) -> bool:
    """Return False if a failed pod exited with 0 after it had worked."""
    return pod.trouble is not Trouble.COMPLETED


def _disrupted(pod: PodView) -> bool:
    return not pod.live and pod.trouble is Trouble.DISRUPTED


def _has_lived(pod: PodView, now: float) -> bool:
    """Return True if a pod is known to have been Ready for long enough."""
    if pod.state is PodState.READY:
        return now - pod.since >= RECOVERY
    return pod.state is PodState.ENDED and pod.was_ready and pod.ran >= RECOVERY


def _fail(
    found: Failures,
    failed: Sequence[PodView],
    works: bool,
    policy: FailurePolicy,
    seed: str,
    now: float,
) -> Failures:
    last = (list(filter(in_itself, failed)) or failed)[-1]
    found = _with(found, last_exit_code=last.exit_code, last_reason=_reason(last))
    if found.next_create_time is not None and found.next_create_time > now:
        return found  # the same wave
    lived = all(_has_lived(pod, now) for pod in failed)
    all_failing = not works and any(map(in_itself, failed))
    waves = 1 if lived else found.waves + 1
    found = _with(found, waves=waves, consecutive=found.consecutive + all_failing)
    if given_up(found, policy):
        return _with(found, waiting=0, next_create_time=None)
    # In whole seconds, as in the status.
    return _with(found, next_create_time=float(math.ceil(now + delay(policy, waves, seed))))


def _reason(pod: PodView) -> str:
    if pod.state is not PodState.ENDED:
        return Reason.STARTUP_TIMEOUT
    if in_itself(pod):
        return AT_ONCE if pod.reason == Reason.COMPLETED else pod.reason
    return Reason.COMPLETED


def _recovery_time(
    found: Failures, pods: Sequence[PodView], desired: int, policy: FailurePolicy, seed: str
) -> float | None:
    """Return the time at which workers will have lived long enough, if none fails until then.

    A worker that became Ready after the start of the last wave must stay Ready for a minute.  If
    all wanted workers are Ready, older ones count too, because no new worker has to come.
    """
    if not found.waves or given_up(found, policy):
        return None
    due = found.next_create_time
    began = 0.0 if due is None else due - delay(policy, found.waves, seed)
    ready = [pod.since for pod in pods if pod.state is PodState.READY]
    starts = [since for since in ready if since >= began]
    if len(ready) >= desired:
        starts.append(max((began, *ready)))
    return min(starts) + RECOVERY if starts else None


def _proven(
    before: str | None,
    found: Failures,
    pods: Sequence[PodView],
    failed: Sequence[PodView],
    template_hash: str,
    now: float,
) -> str | None:
    ready = [p for p in pods if p.template_hash == template_hash and p.state is PodState.READY]
    # Without a readiness probe a worker is Ready for a moment before it fails.  After a failure,
    # Ready must last.
    if any(not found.waves or now - pod.since >= BRIEF for pod in ready):
        return template_hash
    own = (pod for pod in failed if in_itself(pod) and pod.template_hash == template_hash)
    brief = any(pod.ran < BRIEF for pod in own)
    return None if brief and not ready and before == template_hash else before
