"""Workers that cannot reach their master: what they were given when they were made is of no use.

Somebody has deleted the pool's Service, whose old address could not be had again, or its Secret,
the new one of which has another key.  A pod keeps what it was made with.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from fiber_api import names
from fiber_api.names import Reason
from fiber_api.times import format_time
from fiber_api.v1alpha1 import FiberPool, Problem
from fiber_operator.planning.documents import items, mapping
from fiber_operator.planning.plans import Memory
from fiber_operator.planning.pods import PodView
from fiber_operator.planning.situation import Situation

OUTDATED = "cut-off"
"""Mark in place of a template's hash."""

SKEW = 5.0
"""Seconds that the clocks of two API servers may differ by, which date the Secret and the pods."""


@dataclass(frozen=True)
class CutOff:
    """Live pods, by what is wrong with them."""

    by_address: Sequence[PodView]
    by_credentials: Sequence[PodView]


def find(pool: FiberPool, live: Sequence[PodView], memory: Memory) -> CutOff:
    """Find the pods that are cut off."""
    address = None if _names_its_own_address(pool) else memory.address
    return CutOff(
        [pod for pod in live if address and pod.address not in ("", address)],
        [pod for pod in live if pod.created + SKEW < memory.credentials_made],
    )


def outdated(pods: Sequence[PodView], cut_off: CutOff, *, attached: bool) -> list[PodView]:
    """``pods``, of which those that are cut off are like those of an older template.

    A master that is attached may hold the old credentials as they do: they are of use to it, and
    new ones are not.
    """
    useless = {pod.name for pod in cut_off.by_address}
    if not attached:
        useless.update(pod.name for pod in cut_off.by_credentials)
    return [replace(pod, template_hash=OUTDATED) if pod.name in useless else pod for pod in pods]


def problems(situation: Situation) -> Iterator[Problem]:
    """Yield the problems of pods that are cut off, but for those that go now."""
    found = find(situation.pool, situation.live, situation.memory)
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


def _names_its_own_address(pool: FiberPool) -> bool:
    """The template says where to dial, whatever the Service's address is."""
    return any(
        variable.get("name") == names.ENV_ADDRESS
        for container in items(mapping(pool.spec.template, "spec").get("containers"))
        if container.get("name") == pool.spec.worker_container
        for variable in items(container.get("env"))
    )


def _address_changed(situation: Situation, pod: PodView) -> str:
    pool = situation.pool.metadata
    return (
        f"Workers dial {pod.address}, which was the address of the Service "
        f"{names.service_name(pool.name)} until somebody deleted it; it is "
        f"{situation.memory.address} now, since the old one could not be had again. They reach no "
        f"master any more than they have. {_REPLACED[situation.pool.spec.update.strategy]} To "
        f"have new ones at once: {_delete(situation)}."
    )


def _credentials_changed(situation: Situation) -> str:
    pool = situation.pool.metadata
    made = format_time(situation.memory.credentials_made)
    first, fate = "Delete the workers", _REPLACED[situation.pool.spec.update.strategy]
    if situation.attachment.attached:
        first, fate = "Restart the master, which may hold the old ones too, and delete them", ""
    return " ".join(
        filter(
            None,
            (
                f"The Secret {names.secret_name(pool.name)} was made anew at {made}, after "
                "somebody had deleted it: workers hold keys of the old one, and a master "
                "with the new ones refuses them.",
                fate,
                f"{first}, to have new ones at once: {_delete(situation)}.",
            ),
        )
    )


def _delete(situation: Situation) -> str:
    pool = situation.pool.metadata
    return f"kubectl -n {pool.namespace} delete pods -l {names.LABEL_POOL}={pool.name}"


_REPLACED = {
    "OnIdle": "Those that are not at work are replaced a few at a time.",
    "Recreate": "They are replaced now.",
    "OnDelete": "They stay until somebody deletes them (update.strategy is OnDelete).",
}
