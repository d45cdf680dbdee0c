"""Prerequisites that must be in the cluster before a measurement, and the running operator."""

from __future__ import annotations

import contextlib
import http.client
import threading
import time
from collections.abc import Iterator
from typing import Any

from benchmarks.operator_scale import counters
from benchmarks.operator_scale.cases import FAKE_KEY, FAKE_VALUE, Body
from benchmarks.operator_scale.results import Curve

from e2e.kube import Kube, Refused, path_of
from e2e.pools import is_ready
from fiber_api import names

MEMORY = "process_resident_memory_bytes"
PROCESSOR = "process_cpu_seconds_total"
_STARTED = "process_start_time_seconds"
_SELECTOR = "app.kubernetes.io/component=operator,app.kubernetes.io/part-of=fiber"
_PAUSE = 0.5
"""Seconds between two looks at the operator's memory."""


class CannotMeasure(Exception):
    """Missing prerequisite: the message says what is missing, why it is needed, and what to do."""


class Operator:
    """Cluster's one operator."""

    def __init__(self, kube: Kube, pod: Body) -> None:
        self._kube = kube
        self._pod = pod

    @property
    def image(self) -> str:
        """Image that it runs."""
        return str(self._container["image"])

    def page(self) -> str:
        """Return its metrics now."""
        metadata = self._pod["metadata"]
        # By number: a pod's proxy, unlike a Service's, knows no names of ports.
        ports = {port["name"]: port["containerPort"] for port in self._container["ports"]}
        place = f"{metadata['name']}:{ports['metrics']}"
        return self._kube.text(path_of("pods", metadata["namespace"], place, "proxy/metrics"))

    @property
    def _container(self) -> Body:
        containers: list[Body] = self._pod["spec"]["containers"]
        return next(each for each in containers if each["name"] == "operator")

    def born(self, page: str) -> float:
        """Identity that tells a process from the one that took its place."""
        return counters.value(page, _STARTED)

    @contextlib.contextmanager
    def memory(self, since: float) -> Iterator[Curve]:
        """Record its resident memory while the block runs, by a clock that was 0 at `since`."""
        curve: Curve = []
        ended = threading.Event()
        thread = threading.Thread(target=self._watch, args=(curve, since, ended), daemon=True)
        thread.start()
        try:
            yield curve
        finally:
            ended.set()
            thread.join()

    def _watch(self, curve: Curve, since: float, ended: threading.Event) -> None:
        while not ended.wait(_PAUSE):
            try:
                size = counters.value(self.page(), MEMORY)
            except (OSError, http.client.HTTPException, Refused, KeyError):
                continue  # away for a moment; the end shows if another took its place
            curve.append([time.monotonic() - since, size])


def find_operator(kube: Kube) -> Operator:
    """Return the operator, which must be installed, the only one, and ready."""
    if kube.get(path_of("customresourcedefinitions", name=names.CRD_NAME)) is None:
        raise CannotMeasure(
            f"the cluster does not know FiberPools (no {names.CRD_NAME}): install the chart "
            "(helm install fiber-operator charts/fiber-operator), or let --set-up do it"
        )
    pods = [pod for pod in kube.items("/api/v1/pods", labelSelector=_SELECTOR) if is_ready(pod)]
    if not pods:
        raise CannotMeasure(
            f"no ready pod of the operator is in the cluster (labels {_SELECTOR}): install the "
            "chart (helm install fiber-operator charts/fiber-operator), or let --set-up do it; "
            "where it is installed, its pod's log says why it is not ready"
        )
    if len(pods) > 1:
        places = ", ".join(f"{p['metadata']['namespace']}/{p['metadata']['name']}" for p in pods)
        raise CannotMeasure(
            f"there is more than one operator ({places}), and it could be either that makes the "
            "pods: uninstall all releases but one"
        )
    return Operator(kube, pods[0])


def check_nodes(kube: Kube, pods: int) -> int:
    """Return the number of pretended nodes; together they must take so many pods."""
    nodes = kube.items("/api/v1/nodes", labelSelector=f"{FAKE_KEY}={FAKE_VALUE}")
    fit = [node for node in nodes if is_ready(node)]
    room = sum(int(node["status"]["allocatable"]["pods"]) for node in fit)
    if room < pods:
        found = (
            f"room for {room:,} on {len(fit)} that are ready, of {len(nodes)}" if nodes else "none"
        )
        raise CannotMeasure(
            f"{pods:,} pods need nodes that only pretend to run them (KWOK's, with label and taint "
            f"{FAKE_KEY}={FAKE_VALUE}), and there is {found}: PYTHONPATH=tests python -m cluster "
            f"fake-nodes {-(-pods // 500)} makes them on the cluster of tests/cluster"
        )
    return len(nodes)


def server_version(kube: Kube) -> str:
    """Return the API server's version."""
    found: dict[str, Any] = kube.call("GET", "/version")
    return str(found["gitVersion"])
