"""Why a pod ended, in Kubernetes' words, from its document."""

from __future__ import annotations

import signal
from collections.abc import Mapping
from typing import Any, NamedTuple

from fiber_api import names


class PodEnd(NamedTuple):
    """The end of a pod, as an ``ExitReport`` and a ``WorkerDied`` tell it."""

    reason: str
    """Reason in one word, a colon, and details: ``OOMKilled: its memory limit is 512Mi``."""
    node: str
    """Empty if it never had one."""
    exitcode: int | None = None
    """Exit code as in multiprocessing; None if no program ended, or it is not known how."""
    disrupted: bool = False
    """True if the cluster ended the pod, and not its programs."""


def pod_end(pod: Mapping[str, Any], container: str = names.WORKER_CONTAINER) -> PodEnd | None:
    """Return how ``pod`` ended or is about to; None if it is well, as far as Kubernetes knows.

    What ended it comes before what became of its programs for that.
    """
    status = pod.get("status") or {}
    worker = _ended(status, container)
    own = _out_of_memory(pod, worker, container)
    disruption = None if own else _disruption(pod) or _deletion(pod) or _lost_container(worker)
    reason = own or disruption or _own_end(status, worker)
    if reason is None:
        return None
    return PodEnd(reason, node_of(pod), _exitcode(worker), disruption is not None)


def node_of(pod: Mapping[str, Any]) -> str:
    """The name of its node; empty while it has none."""
    return str((pod.get("spec") or {}).get("nodeName") or "")


def _ended(status: Mapping[str, Any], container: str) -> Mapping[str, Any]:
    """The end of the container of that name; empty while it goes on."""
    for found in status.get("containerStatuses") or ():
        if found.get("name") == container:
            return (found.get("state") or {}).get("terminated") or {}
    return {}


def _out_of_memory(pod: Mapping[str, Any], worker: Mapping[str, Any], container: str) -> str | None:
    if worker.get("reason") != "OOMKilled":
        return None
    limit = None
    for found in (pod.get("spec") or {}).get("containers") or ():
        if found.get("name") == container:
            limit = ((found.get("resources") or {}).get("limits") or {}).get("memory")
    # Without a limit of its own it was the node that had no more.
    return f"OOMKilled: its memory limit is {limit}" if limit else "OOMKilled: it has no limit"


_DISRUPTIONS = {
    "DeletionByPodGC": "NodeLost",
    "DeletionByTaintManager": "NodeLost",
    "EvictionByEvictionAPI": "Evicted",
    "PreemptionByScheduler": "Preempted",
    # In the status itself, by the kubelet.
    "Evicted": "Evicted",
    "NodeLost": "NodeLost",
    "NodeShutdown": "NodeLost",
    "Preempting": "Preempted",
    "Shutdown": "NodeLost",
    "Terminated": "NodeLost",
}
"""Kubernetes' words for why it ended a pod, and what people call it."""


def _disruption(pod: Mapping[str, Any]) -> str | None:
    status = pod.get("status") or {}
    conditions = status.get("conditions") or ()
    for told in (status, *(c for c in conditions if c.get("type") == "DisruptionTarget")):
        word = _DISRUPTIONS.get(str(told.get("reason")))
        if word and told.get("status") != "False":
            return _sentence(word, str(told.get("message") or ""))
    return None


_LOST_CONTAINERS = ("ContainerStatusUnknown", "Unknown")
"""Reasons of containers that a node lost sight of, for example in a restart.  Their exit code is
made up."""


def _deletion(pod: Mapping[str, Any]) -> str | None:
    if not (pod.get("metadata") or {}).get("deletionTimestamp"):
        return None
    return "Deleted: somebody deleted the pod"


def _lost_container(worker: Mapping[str, Any]) -> str | None:
    lost = worker.get("reason") in _LOST_CONTAINERS
    return "NodeLost: its node lost sight of it" if lost else None


def _own_end(status: Mapping[str, Any], worker: Mapping[str, Any]) -> str | None:
    reason, message = str(status.get("reason") or ""), str(status.get("message") or "")
    exitcode = _exitcode(worker)
    if exitcode is not None:
        word = reason or str(worker.get("reason") or "Error")
        return _sentence(word, f"its agent {_ending(exitcode)}")
    if reason or status.get("phase") in ("Failed", "Succeeded"):
        return _sentence(reason or str(status["phase"]), message)
    return None


def _sentence(word: str, rest: str) -> str:
    rest = rest.strip().rstrip(".")
    return f"{word}: {rest}" if rest else word


def _exitcode(worker: Mapping[str, Any]) -> int | None:
    code = worker.get("exitCode")
    if not isinstance(code, int) or worker.get("reason") in _LOST_CONTAINERS:
        return None
    return 128 - code if code > 128 else code  # runtimes add 128 to a signal


def _ending(exitcode: int) -> str:
    if exitcode >= 0:
        return f"ended with exit status {exitcode}"
    try:
        return f"was killed by {signal.Signals(-exitcode).name}"
    except ValueError:
        return f"was killed by signal {-exitcode}"
