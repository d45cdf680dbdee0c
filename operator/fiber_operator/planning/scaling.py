"""Choice of pods to delete, and number of pods to create.

Who may be taken depends on who could be working.  While a master is attached, only it knows which
of its workers are idle: under ``ReleasedOnly`` the operator takes what the master has released and
pods whose worker container does not run yet, nothing else, for an agent dials before its pod is
Ready.  Without a master nobody works, and it may take any.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from fiber_operator.planning.pods import PodView, State, Trouble

CANARIES = 3
"""Pods that try out a template that never worked."""

PATIENCE = 30.0
"""Seconds after which canaries of which nothing bad is known are joined by as many again."""


def outdated_to_replace(
    live: Sequence[PodView],
    *,
    template_hash: str,
    strategy: str,
    attached: bool,
    desired: int,
    proven: bool,
) -> list[PodView]:
    """Pods of an older template that go now.

    ``OnDelete``: none.  ``Recreate``: all, at work or not.  ``OnIdle``: those that do not run yet.
    The others may be at work while a master is attached; it sees ``updatedReplicas`` and releases
    them when they are idle.  Without one those that were never Ready go too, and the others a
    quarter at a time, and no more than there may be canaries until the new template is ``proven``
    to work.
    """
    outdated = [pod for pod in live if pod.template_hash != template_hash]
    if strategy == "OnDelete":
        return []
    if strategy == "Recreate":
        return outdated
    if attached:
        return _idle(outdated)
    fresh = [pod for pod in outdated if not pod.was_ready]
    unready = [pod for pod in outdated if pod.was_ready and pod.state is not State.READY]
    ready = [pod for pod in outdated if pod.state is State.READY]
    missing = desired - sum(pod.state is State.READY for pod in live)
    quarter = max(1, desired // 4)
    spare = max(0, (quarter if proven else min(quarter, CANARIES)) - max(0, missing))
    return fresh + unready + expendable(ready, template_hash)[:spare]


def _idle(pods: Sequence[PodView]) -> list[PodView]:
    """Return the pods that no master can have given work to."""
    return [pod for pod in pods if pod.state is State.PENDING]


def expendable(pods: Sequence[PodView], template_hash: str) -> list[PodView]:
    """The order in which policy ``Any`` takes pods.

    Pending, then outdated, then not ready, then of the lowest deletion cost, then the newest.
    """
    return sorted(
        pods,
        key=lambda pod: (
            pod.state is not State.PENDING,
            pod.template_hash == template_hash,
            pod.state is State.READY,
            pod.deletion_cost,
            -pod.created,
            pod.name,
        ),
    )


def excess_to_delete(
    live: Sequence[PodView], excess: int, *, template_hash: str, free_choice: bool
) -> list[PodView]:
    """Pods that go because fewer are wanted; may be fewer than ``excess``."""
    if free_choice:
        candidates = expendable(live, template_hash)
    else:
        candidates = sorted(_idle(live), key=lambda pod: (-pod.created, pod.name))
    return candidates[: max(0, excess)]


def released_to_delete(
    pods: Sequence[PodView], released: Collection[str], *, floor: int, template_hash: str
) -> list[PodView]:
    """Pods that the master has released, but for those that would be made anew at once.

    A new worker in the place of an idle one would be as idle, and released in turn: the last
    ``floor`` live ones stay.  Those of an older template go, for that is how it is updated.
    """
    named = [pod for pod in pods if pod.name in released]
    current = [pod for pod in named if pod.live and pod.template_hash == template_hash]
    others = [pod for pod in named if pod not in current]
    live = sum(pod.live for pod in pods) - sum(pod.live for pod in others)
    return others + expendable(current, template_hash)[: max(0, live - floor)]


@dataclass(frozen=True)
class Trial:
    """Number of pods of a template that may be added now."""

    room: int | None = None
    """None: as many as are wanted."""
    again: float | None = None
    """Time at which there will be more room, if nothing happens until then."""


def trial(
    current: Sequence[PodView], *, proven: bool, failing: bool, held_back: int, now: float
) -> Trial:
    """Judge whether a template with these ``current`` live pods is still being tried out.

    It is until one of its pods is Ready.  A pod that cannot start, or ``failing`` ones before
    these, leave it at the canaries that there are, the places of failed ones that are ``held_back``
    included.  While nothing is wrong their number doubles each ``PATIENCE``, for an image may take
    long to fetch and fetching it on three nodes does not help the others.  Pods that no node takes
    do not count, and let as many again ask for a node: a cluster autoscaler must see the whole
    demand.
    """
    if proven:
        return Trial()
    if failing or any(pod.trouble is Trouble.CANNOT_START for pod in current):
        return Trial(max(0, CANARIES - len(current) - held_back))
    turned_away = sum(pod.trouble is Trouble.UNSCHEDULABLE for pod in current)
    placed = len(current) - turned_away
    room = max(CANARIES, turned_away) - placed
    if room > 0:
        return Trial(room)
    due = max(pod.created for pod in current) + PATIENCE
    return Trial(placed) if now >= due else Trial(0, due)


KEPT = 3
"""Failed pods that are kept for ``kubectl logs``."""


def ended_to_delete(ended: Sequence[PodView], settled: Collection[str]) -> list[PodView]:
    """Ended pods that are of no more use: all that are ``settled``, which means counted if they
    are to be, but the last that failed.

    A pod whose other containers go on is not kept: it would hold its resources.
    """
    failed = sorted(
        (p for p in ended if p.trouble is Trouble.APPLICATION and not p.lingers),
        key=lambda pod: (pod.since, pod.name),
    )
    kept = {pod.name for pod in failed[-KEPT:]}
    return [pod for pod in ended if pod.name not in kept and pod.name in settled]
