"""Kubernetes' events about a pod that does not start and whose status does not say why."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from fiber_operator.cluster import EVENTS, ApiError, Body, Cluster
from fiber_operator.planning.documents import mapping, seconds, text
from fiber_operator.planning.pods import PodView
from fiber_operator.workqueue import Key

_NO_NEWS = frozenset(
    {
        # Said before it had a node.
        "FailedScheduling",
        "NotTriggerScaleUp",
        "Scheduled",
        "TriggeredScaleUp",
        # Normal events that go along with a trouble and do not end it.
        "BackOff",
        "Killing",
        "SandboxChanged",
        # A notice of a kubelet that starts the pod all the same.
        "MissingClusterDNS",
    }
)
"""Reasons of events that say nothing of what a pod with a node waits for."""


class _Said(NamedTuple):
    """Event; the greatest is the newest."""

    second: int
    """Kubernetes tells most times no better than that."""
    written: int
    warning: str


async def warnings(
    cluster: Cluster, key: Key, pods: Sequence[str], there: Sequence[PodView]
) -> dict[str, str]:
    """Pod name -> its newest event as ``Reason: message`` if that is a Warning, else empty.

    A Warning that something newer follows is over: the volume is mounted at last, the image is
    being pulled.
    """
    uids = {pod.name: pod.uid for pod in there}
    found = {}
    for name in pods:
        try:
            events = await cluster.list(
                EVENTS, key.namespace, _said, fields=f"involvedObject.uid={uids.get(name)}"
            )
        except ApiError:
            events = []  # it would only have been an explanation
        newest = max((event for event in events if event is not None), default=None)
        found[name] = newest.warning if newest else ""
    return found


def _said(event: Body) -> _Said | None:
    reason = text(event.get("reason"))
    if reason in _NO_NEWS:
        return None
    warning = f"{reason}: {text(event.get('message'))}" if event.get("type") == "Warning" else ""
    return _Said(int(_last_time(event)), _version(event), warning)


def _version(event: Body) -> int:
    """Return a number that is greater for the later of two events of one second."""
    try:
        return int(text(mapping(event, "metadata").get("resourceVersion")))
    except ValueError:
        return 0


def _last_time(event: Body) -> float:
    """Return when an event happened last: a repeated one is the same object with another time."""
    stamps = (
        mapping(event, "series").get("lastObservedTime"),
        event.get("lastTimestamp"),
        event.get("eventTime"),
        mapping(event, "metadata").get("creationTimestamp"),
    )
    return next(filter(None, map(seconds, stamps)), 0.0)
