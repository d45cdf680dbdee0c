"""Counting failed workers, each once, and how long to wait after them.

Failures that are one event count once: a *round* is what fails of the pods that were there at its
first failure.  Were each pod counted, a pool of two hundred workers would be past its limit the
first time that all of them run into the same fault.  A failed pod that was created after the last
round began opens the next one.

A worker that ends with exit code 0 and was not released has not failed: an agent ends so when it
was without a master for too long.  But one that does so again and again runs the wrong program,
and its successors wait like those of failures, from the second round on, though without a limit.

The whole record stands in the pool's status, so that it survives the operator; ``counted`` names
the ended pods that still exist and are in the sums already, ``deleting`` those whose end the
operator itself is about to ask for or has asked for.  Both are written before anything is deleted.
They are kept small, for a status that etcd refuses would stop the pool: what has no place in them
waits for the next look.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from fiber_api.names import Reason
from fiber_api.status import MAX_COUNT
from fiber_api.v1alpha1 import FailurePolicy, Failures, FiberPoolStatus
from fiber_operator.planning.documents import past
from fiber_operator.planning.pods import BRIEF, PodView, State, Trouble

RECOVERY = 60.0
"""Seconds that a new pod must stay Ready until the failures before it are forgotten."""

FORGIVEN = 600.0
"""Seconds without a new round after which ends with exit code 0 are no row any more."""

NAMES = 2000
"""Pods that a record names, at most: some thirty kilobytes."""

ROUND = 50
"""Pods that are seen to in one look though no name has a place any more: others may take long to
end, on a node that is silent for instance."""

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
    completed: int = 0
    completions: int = 0
    """Rounds in a row in which workers ended with exit code 0."""
    last_completed: float | None = None
    """When the last of these began."""
    last_exit_code: int | None = None
    last_reason: str | None = None
    last_time: float | None = None
    """When the last failure was counted."""
    next_create_time: float | None = None
    newest_created: float | None = None
    """When the newest pod was created that was there at the beginning of the last round."""
    counted: frozenset[str] = frozenset()
    deleting: frozenset[str] = frozenset()
    spec_hash: str | None = None
    """What the user asked for when this was written; something else begins anew."""
    proven: str | None = None
    """The template hash of which a pod was Ready."""

    @classmethod
    def read(cls, status: FiberPoolStatus, pool: str, now: float) -> Record:
        """What the status of ``pool`` remembers, less times that have not come yet: those are none
        of ours."""
        kept = status.failures
        return cls(
            kept.consecutive,
            kept.total,
            kept.disrupted,
            kept.completed,
            kept.completions,
            past(kept.last_completed, now),
            kept.last_exit_code,
            kept.last_reason,
            past(kept.last_time, now),
            kept.next_create_time,
            past(kept.newest_created, now),
            frozenset(_long(name, pool) for name in kept.counted),
            frozenset(_long(name, pool) for name in kept.deleting),
            kept.spec_hash,
            status.proven_template_hash,
        )

    def failures(self, pool: str) -> Failures:
        """As it stands in the status of ``pool``."""
        return Failures(
            consecutive=self.consecutive,
            total=self.total,
            disrupted=self.disrupted,
            completed=self.completed,
            completions=self.completions,
            last_completed=self.last_completed,
            last_exit_code=self.last_exit_code,
            last_reason=self.last_reason,
            last_time=self.last_time,
            next_create_time=self.next_create_time,
            newest_created=self.newest_created,
            counted=tuple(sorted(_short(name, pool) for name in self.counted)),
            deleting=tuple(sorted(_short(name, pool) for name in self.deleting)),
            spec_hash=self.spec_hash,
        )

    @property
    def room(self) -> int:
        """How many more pods it has a place for."""
        return max(0, NAMES - len(self.counted) - len(self.deleting))

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


def _short(name: str, pool: str) -> str:
    """A pod's name less the pool's, with which nearly all begin: ``-1a2b3c4d5e``."""
    return name.removeprefix(pool) if name.startswith(f"{pool}-") else name


def _long(name: str, pool: str) -> str:
    return f"{pool}{name}" if name.startswith("-") else name


@dataclass(frozen=True)
class Account:
    """What one look at the pods added."""

    record: Record
    failed: tuple[PodView, ...] = ()
    """Newly counted failures, the newest last."""
    disrupted: tuple[PodView, ...] = ()
    completed: tuple[PodView, ...] = ()
    """Newly counted ends with exit code 0, the newest last."""
    again: float | None = None
    """When something will be forgotten: a pod was Ready for long enough, say."""

    @property
    def news(self) -> bool:
        """Whether anything was counted."""
        return bool(self.failed or self.disrupted or self.completed)


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
    record = _begin(record, pods, late, spec_hash)
    record = replace(record, next_create_time=record.next_creation(policy, now))
    uncounted = [p for p in pods if p.name not in record.counted and p.name not in expected]
    uncounted.sort(key=lambda pod: (pod.since, pod.name))
    failed = [p for p in uncounted if _failed(p) or p.name in late][: max(ROUND, record.room)]
    record = _count(record, failed)
    completed = [p for p in uncounted if _completed(p)][: max(ROUND, record.room)]
    record = _count(record, completed)
    disrupted = [p for p in uncounted if p.name not in late and _disrupted(p, record)]
    disrupted = disrupted[: record.room]
    record = _count(record, disrupted)
    record = replace(
        record,
        total=min(record.total + len(failed), MAX_COUNT),
        completed=min(record.completed + len(completed), MAX_COUNT),
        disrupted=min(record.disrupted + len(disrupted), MAX_COUNT),
    )
    if failed:
        record = _fail(record, pods, failed, policy, seed, now)
    if completed:
        record = _complete(record, completed, policy, seed, now)
    again = None if record.exhausted(policy) else _recovery(record, pods, desired)
    if again is not None and again <= now:
        record, again = replace(record, consecutive=0, next_create_time=None), None
    record, forgiven = _forgive(record, now)
    record = _prove(record, pods, failed, template_hash, now)
    times = [time for time in (again, forgiven) if time is not None]
    return Account(
        record, tuple(failed), tuple(disrupted), tuple(completed), min(times, default=None)
    )


def _count(record: Record, pods: Sequence[PodView]) -> Record:
    return replace(record, counted=record.counted.union(pod.name for pod in pods))


def _begin(
    record: Record, pods: Sequence[PodView], late: Collection[str], spec_hash: str
) -> Record:
    # One that was to be deleted and lives, for something came between, is like any other.
    ending = {pod.name for pod in pods if not pod.live or pod.name in late}
    deleted = {pod.name for pod in pods if pod.state is State.TERMINATING}
    record = replace(
        record, counted=record.counted & ending, deleting=record.deleting & deleted - record.counted
    )
    if record.spec_hash == spec_hash:
        return record
    return replace(
        record,
        spec_hash=spec_hash,
        consecutive=0,
        completions=0,
        last_completed=None,
        next_create_time=None,
    )


def _failed(pod: PodView) -> bool:
    return pod.state is State.ENDED and pod.trouble is Trouble.APPLICATION


def _completed(pod: PodView) -> bool:
    return pod.state is State.ENDED and pod.trouble is Trouble.COMPLETED


def _disrupted(pod: PodView, record: Record) -> bool:
    if pod.state is State.TERMINATING:
        return pod.name not in record.deleting
    return pod.state is State.ENDED and pod.trouble is Trouble.DISRUPTED


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


def _complete(
    record: Record, completed: Sequence[PodView], policy: FailurePolicy, seed: str, now: float
) -> Record:
    began = record.last_completed
    if began is not None and all(pod.created <= began for pod in completed):
        return record
    rounds = min(record.completions + 1, MAX_COUNT)
    record = replace(record, completions=rounds, last_completed=float(math.floor(now)))
    if rounds == 1 or record.exhausted(policy):
        return record
    due = float(math.ceil(now + delay(policy, rounds - 1, seed)))
    return replace(record, next_create_time=max(due, record.next_create_time or 0.0))


def _forgive(record: Record, now: float) -> tuple[Record, float | None]:
    """Without a row that is over, and when it will be."""
    if not record.completions:
        return record, None
    due = max(record.last_completed or 0.0, record.next_create_time or 0.0) + FORGIVEN
    if due > now:
        return record, due
    return replace(record, completions=0, last_completed=None), None


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
