"""What Kubernetes' events say of a pod that does not start and whose status does not say why."""

from __future__ import annotations

from collections.abc import Sequence

from fiber_operator.cluster import EVENTS, ApiError, Body, Cluster
from fiber_operator.documents import text
from fiber_operator.pods import PodView
from fiber_operator.worker import Key


async def warnings(
    cluster: Cluster, key: Key, pods: Sequence[str], there: Sequence[PodView]
) -> dict[str, str]:
    """Pod name -> its newest Warning as ``Reason: message``; empty where there is none."""
    uids = {pod.name: pod.uid for pod in there}
    found = {}
    for name in pods:
        try:
            events = await cluster.list(
                EVENTS, key.namespace, _warning, fields=f"involvedObject.uid={uids.get(name)}"
            )
        except ApiError:
            events = []  # it would only have been an explanation
        found[name] = max((event for event in events if event), default=("", ""))[1]
    return found


def _warning(event: Body) -> tuple[str, str] | None:
    if event.get("type") != "Warning":
        return None
    when = text(event.get("lastTimestamp")) or text(event.get("eventTime"))
    return when, f"{text(event.get('reason'))}: {text(event.get('message'))}"
