"""Metrics for Prometheus."""

from __future__ import annotations

import collections
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.registry import Collector

from fiber_operator.planning.documents import items, mapping, text, whole
from fiber_operator.planning.pods import PodView
from fiber_operator.workqueue import Key, QueueStatistics

CONTENT_TYPE = CONTENT_TYPE_LATEST
_SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)


@dataclass(frozen=True)
class PoolSample:
    """Numbers of one pool at its last reconcile."""

    desired: int = 0
    pods: Mapping[str, int] = field(default_factory=dict)
    """Pods by state: pending, starting, ready, notready, terminating, ended."""
    problems: Mapping[str, int] = field(default_factory=dict)
    """Problems by reason."""
    failed: int = 0
    disrupted: int = 0

    @classmethod
    def of(cls, status: Mapping[str, Any], pods: Sequence[PodView]) -> PoolSample:
        """Return the sample of a pool with this status, whose fields may have any type."""
        failures = mapping(status, "failures")
        return cls(
            desired=whole(status.get("desiredReplicas")),
            pods=collections.Counter(
                "starting" if pod.joining else pod.state.value.lower() for pod in pods
            ),
            problems={
                text(problem.get("reason")): whole(problem.get("count"), 1)
                for problem in items(status.get("problems"))
            },
            failed=whole(failures.get("total")),
            disrupted=whole(failures.get("disrupted")),
        )


class Metrics:
    """All metrics of one operator."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.pools: dict[Key, PoolSample] = {}
        self.registry.register(_Pools(self.pools))
        ProcessCollector(registry=self.registry)
        self._reconciles = self._counter(
            "reconciles", "Reconciles of pools, by outcome.", "outcome"
        )
        self._reconcile_seconds = self._histogram("reconcile_duration", "Length of a reconcile.")
        self._requests = self._counter(
            "api_requests", "Calls to the API server.", "verb", "resource", "code"
        )
        self._request_seconds = self._histogram(
            "api_request_duration", "Length of a call to the API server.", "verb", "resource"
        )
        self._created = self._counter("pods_created", "Pods created.")
        self._deleted = self._counter("pods_deleted", "Pods deleted, by reason.", "reason")
        self._watch_events = self._counter("watch_events", "Events of watches.", "resource")
        self._watch_restarts = self._counter("watch_restarts", "Times that kopf was started again.")
        self._resync = Gauge(
            "fiber_operator_last_resync_timestamp_seconds",
            "Time at which all pools were last listed.",
            registry=self.registry,
        )

    def _counter(self, name: str, text: str, *labels: str) -> Counter:
        return Counter(f"fiber_operator_{name}_total", text, labels, registry=self.registry)

    def _histogram(self, name: str, text: str, *labels: str) -> Histogram:
        return Histogram(
            f"fiber_operator_{name}_seconds", text, labels, buckets=_SECONDS, registry=self.registry
        )

    def watch_queue(
        self, statistics: Callable[[], QueueStatistics], held: Callable[[], bool]
    ) -> None:
        """Add gauges that Prometheus reads from the queue and from ``held`` (is it the leader?)."""
        gauges: dict[tuple[str, str], Callable[[], float]] = {
            ("pools", "Pools that the operator knows."): lambda: statistics().known,
            ("queue_waiting", "Pools whose reconcile is due."): lambda: statistics().waiting,
            ("queue_running", "Running reconciles."): lambda: statistics().running,
            (
                "queue_longest_wait_seconds",
                "Seconds for which the longest waiting pool is overdue.",
            ): lambda: statistics().longest_wait,
            (
                "queue_longest_run_seconds",
                "Seconds since the oldest running reconcile began.",
            ): lambda: statistics().longest_run,
            ("lease_held", "1 while this operator is the leader."): lambda: float(held()),
        }
        for (name, meaning), value in gauges.items():
            Gauge(f"fiber_operator_{name}", meaning, registry=self.registry).set_function(value)

    def reconciled(self, outcome: str, seconds: float) -> None:
        """Count the end of a reconcile."""
        self._reconciles.labels(outcome).inc()
        self._reconcile_seconds.observe(seconds)

    def requested(self, verb: str, resource: str, code: str, seconds: float) -> None:
        """Count the end of a call to the API server."""
        self._requests.labels(verb, resource, code).inc()
        self._request_seconds.labels(verb, resource).observe(seconds)

    def created(self, pods: int) -> None:
        """Count pods that were created."""
        self._created.inc(pods)

    def deleted(self, reason: str) -> None:
        """Count a pod that was deleted."""
        self._deleted.labels(reason).inc()

    def watched(self, resource: str) -> None:
        """Count an event of a watch."""
        self._watch_events.labels(resource).inc()

    def watch_restarted(self) -> None:
        """Count a new start of kopf."""
        self._watch_restarts.inc()

    def resynced(self, now: float) -> None:
        """Note the time at which all pools were listed."""
        self._resync.set(now)

    def render(self) -> bytes:
        """Return the page of /metrics."""
        return generate_latest(self.registry)


class _Pools(Collector):
    """Metrics of the pools that exist."""

    def __init__(self, pools: Mapping[Key, PoolSample]) -> None:
        self._pools = pools

    def collect(self) -> Iterator[Metric]:
        where = ("namespace", "pool")
        desired = GaugeMetricFamily("fiber_pool_desired_pods", "Workers wanted.", labels=where)
        pods = GaugeMetricFamily("fiber_pool_pods", "Pods, by state.", labels=(*where, "state"))
        problems = GaugeMetricFamily(
            "fiber_pool_problems", "Pods or attempts with a problem.", labels=(*where, "reason")
        )
        ended = CounterMetricFamily(
            "fiber_pool_lost_pods", "Pods lost: failed or disrupted.", labels=(*where, "cause")
        )
        for key, pool in self._pools.items():
            desired.add_metric(key, pool.desired)
            ended.add_metric((*key, "failed"), pool.failed)
            ended.add_metric((*key, "disrupted"), pool.disrupted)
            for state, count in pool.pods.items():
                pods.add_metric((*key, state), count)
            for reason, count in pool.problems.items():
                problems.add_metric((*key, reason), count)
        yield from (desired, pods, problems, ended)
