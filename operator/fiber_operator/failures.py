"""Counting failed workers, each once, and how long to wait after them.

Failures that are one event count once: a *round* is what fails of the pods that were there at its
first failure.  Were each pod counted, a pool of two hundred workers would be past its limit the
first time that all of them run into the same fault.  A failed pod that was created after the last
round began opens the next one.

The whole record stands in the pool's status, so that it survives the operator; ``counted`` names
the ended pods that still exist and are in the sums already.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from fiber_api.names import Reason
from fiber_api.status import MAX_COUNT
from fiber_api.v1alpha1 import FailurePolicy, Failures, FiberPoolStatus
from fiber_operator.documents import past
from fiber_operator.pods import BRIEF, PodView, State, Trouble

RECOVERY = 60.0
"""Seconds that a new pod must stay Ready until the failures before it are forgotten."""

_JITTER = 0.1
"""How much longer than its due a wait may be, so that pools which fail together come apart."""


def delay(policy: FailurePolicy, rounds: int, seed: str) -> float:
    """Seconds to wait after so many rounds in a row; the same for the same arguments."""
    doubled = policy.backoff_base_seconds * (1 << min(max(rounds, 1) - 1, 30))
    digest = hashlib.sha256(f"{seed}/{rounds}".encode()).digest()
    jitter = _JITTER * int.from_bytes(digest[:4]) / 2**32
    return min(policy.backoff_max_seconds, doubled) * (1 + jitter)


@dataclass(frozen=True)
class Record:
    """``status.failures``, and the template that was proven to work."""

    consecutive: int = 0
    """Rounds in a row."""
    total: int = 0
    disrupted: int = 0
    last_exit_code: int | None = None
    last_reason: str | None = None
    last_time: float | None = None
    """When the last failure was counted."""
    next_create_time: float | None = None
    newest_created: float | None = None
    """When the newest pod was created that was there at the beginning of the last round."""
    counted: frozenset[str] = frozenset()
    spec_hash: str | None = None
    """What the user asked for when this was written; something else begins anew."""
    proven: str | None = None
    """The template hash of which a pod was Ready."""

    @classmethod
    def read(cls, status: FiberPoolStatus, now: float) -> Record:
        """What the status remembers, less times that have not come yet: those are none of ours."""
        kept = status.failures
        return cls(
            kept.consecutive,
            kept.total,
            kept.disrupted,
            kept.last_exit_code,
            kept.last_reason,
            past(kept.last_time, now),
            kept.next_create_time,
            past(kept.newest_created, now),
            frozenset(kept.counted),
            kept.spec_hash,
            status.proven_template_hash,
        )

    def failures(self) -> Failures:
        """As it stands in the status."""
        return Failures(
            consecutive=self.consecutive,
            total=self.total,
            disrupted=self.disrupted,
            last_exit_code=self.last_exit_code,
            last_reason=self.last_reason,
            last_time=self.last_time,
            next_create_time=self.next_create_time,
            newest_created=self.newest_created,
            counted=tuple(sorted(self.counted)),
            spec_hash=self.spec_hash,
        )

    def next_creation(self, policy: FailurePolicy, now: float) -> float | None:
        """``next_create_time`` if it can be ours.

        One that is further away than the policy allows is not, nor is one past the limit.
        """
        longest = policy.backoff_max_seconds * (1 + _JITTER) + 1
        due = self.next_create_time
        return None if due is None or due > now + longest or self.exhausted(policy) else due

    def waits_until(self, policy: FailurePolicy, now: float) -> float | None:
        """When the next pod may be created; None for at once."""
        due = self.next_creation(policy, now)
        return due if due is not None and due > now else None

    def exhausted(self, policy: FailurePolicy) -> bool:
        """Whether nothing more is created until the user changes something."""
        return self.consecutive > policy.backoff_limit


@dataclass(frozen=True)
class Account:
    """What one look at the pods added."""

    record: Record
    failed: tuple[PodView, ...] = ()
    """Newly counted failures, the newest last."""
    disrupted: tuple[PodView, ...] = ()
    again: float | None = None
    """When a pod will have been Ready for long enough."""

    @property
    def news(self) -> bool:
        """Whether anything was counted."""
        return bool(self.failed or self.disrupted)


def account(
    record: Record,
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
    """Bring the record up to date.

    ``expected`` names pods whose end was asked for; ``late`` names pods that are not Ready in
    time, which counts as a failure; ``desired`` is how many are wanted.
    """
    record = _begin(record, pods, spec_hash)
    record = replace(record, next_create_time=record.next_creation(policy, now))
    uncounted = [p for p in pods if p.name not in record.counted and p.name not in expected]
    failed = sorted(
        (p for p in uncounted if _failed(p) or p.name in late), key=lambda p: (p.since, p.name)
    )
    disrupted = [p for p in uncounted if p.name not in late and _disrupted(p)]
    record = replace(
        record,
        total=min(record.total + len(failed), MAX_COUNT),
        disrupted=min(record.disrupted + len(disrupted), MAX_COUNT),
        counted=record.counted.union(p.name for p in (*failed, *disrupted)),
    )
    if failed:
        record = _fail(record, pods, failed, policy, seed, now)
    again = None if record.exhausted(policy) else _recovery(record, pods, desired)
    if again is not None and again <= now:
        record, again = replace(record, consecutive=0, next_create_time=None), None
    record = _prove(record, pods, failed, template_hash, now)
    return Account(record, tuple(failed), tuple(disrupted), again)


def _begin(record: Record, pods: Sequence[PodView], spec_hash: str) -> Record:
    names = {pod.name for pod in pods}
    record = replace(record, counted=record.counted & names)
    if record.spec_hash == spec_hash:
        return record
    return replace(record, spec_hash=spec_hash, consecutive=0, next_create_time=None)


def _failed(pod: PodView) -> bool:
    return pod.state is State.ENDED and pod.trouble is Trouble.APPLICATION


def _disrupted(pod: PodView) -> bool:
    ended = pod.state is State.ENDED and pod.trouble is Trouble.DISRUPTED
    return ended or pod.state is State.TERMINATING


def _fail(
    record: Record,
    pods: Sequence[PodView],
    failed: Sequence[PodView],
    policy: FailurePolicy,
    seed: str,
    now: float,
) -> Record:
    last = failed[-1]
    ended = last.state is State.ENDED
    record = replace(
        record,
        last_exit_code=last.exit_code,
        last_reason=last.reason if ended else Reason.STARTUP_TIMEOUT,
        last_time=float(math.floor(now)),
    )
    if record.consecutive and all(pod.created <= (record.newest_created or 0.0) for pod in failed):
        return record
    rounds = min(record.consecutive + 1, MAX_COUNT)
    record = replace(record, consecutive=rounds, newest_created=max(pod.created for pod in pods))
    # In whole seconds, so that what is created then is newer than what is there now.
    due = math.ceil(now + delay(policy, rounds, seed))
    return replace(record, next_create_time=None if record.exhausted(policy) else float(due))


def _recovery(record: Record, pods: Sequence[PodView], desired: int) -> float | None:
    """When the failures in a row are forgotten, if nothing happens until then.

    That is when a pod that became Ready after them has stayed so for a minute, or when all that
    are wanted have: where fewer are wanted than there were, no new one need ever come.
    """
    if not record.consecutive:
        return None
    last = record.last_time or 0.0
    newest = record.newest_created or 0.0
    ready = [pod for pod in pods if pod.state is State.READY]
    starts = [pod.since for pod in ready if pod.created > newest or pod.since >= last]
    if len(ready) >= desired:
        starts.append(max((last, *(pod.since for pod in ready))))
    return min(starts) + RECOVERY if starts else None


def _prove(
    record: Record,
    pods: Sequence[PodView],
    failed: Sequence[PodView],
    template_hash: str,
    now: float,
) -> Record:
    current = [pod for pod in pods if pod.template_hash == template_hash]
    ready = [pod for pod in current if pod.state is State.READY]
    # Without a readiness probe a worker is Ready for a moment before it fails.  Once that has
    # happened, Ready has to last.
    if any(not record.consecutive or now - pod.since >= BRIEF for pod in ready):
        return replace(record, proven=template_hash)
    brief = any(pod.template_hash == template_hash and pod.ran < BRIEF for pod in failed)
    if brief and not ready and record.proven == template_hash:
        return replace(record, proven=None)
    return record
