"""Process of the operator: makes its parts, connects and runs them.

::

    watches ───► work queue ──► controller ──► cluster
    resync  ────►   ▲  ▲           │  ▲ ▲         ▲
    master leases ──┘  │           ▼  │ │         │ permit
                       │         planning │      leader election (may this process act?)
    informer of pods ──┴──────────────────┘
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable
from typing import Protocol

from fiber_api import names
from fiber_operator.cluster import WRITE_TIMEOUT, Cluster, Permit, load_configuration
from fiber_operator.controller import Controller
from fiber_operator.creation import Draw, draw_suffix
from fiber_operator.events import EventRecorder
from fiber_operator.health import Health, WatchStatus, serving
from fiber_operator.informer import PodInformer
from fiber_operator.lease_monitor import LeaseMonitor
from fiber_operator.metrics import Metrics
from fiber_operator.operator_leases import Heartbeat, LeaderElector
from fiber_operator.resync import Resync
from fiber_operator.settings import OperatorSettings
from fiber_operator.watches import Configure, KopfThread
from fiber_operator.workqueue import Key, Result, WorkQueue

log = logging.getLogger(__name__)


DRAIN = 5.0
"""Seconds that running reconciles have to end when the operator stops."""


class Part(Protocol):
    """Part of the operator that runs until it is cancelled."""

    async def run(self) -> None: ...


class OperatorProcess:
    """Operator of one process.

    ``watches`` makes the part that watches pools and Leases.  ``now`` is the time of day, and
    ``draw`` makes the random end of a pod's name.  Tests replace all three.
    """

    def __init__(
        self,
        settings: OperatorSettings,
        *,
        configure: Configure = load_configuration,
        watches: Callable[..., Part] = KopfThread,
        now: Callable[[], float] = time.time,
        draw: Draw = draw_suffix,
    ) -> None:
        self._settings = settings
        self._configure = configure
        self._make_watches = watches
        self._now = now
        self._draw = draw
        self._kopf_started_before = False
        self.metrics = Metrics()
        self.port = 0
        """Port of /healthz; 0 until it is served."""

    async def run(self, stop: asyncio.Event) -> None:
        """Operate until ``stop`` is set.  Then end running reconciles and give up the Lease."""
        settings = self._settings
        async with contextlib.AsyncExitStack() as stack:
            self._build(
                await self._open(stack, settings.connections, permit=self._permit),
                # Only for Leases, so that a renewal never waits behind other calls.
                await self._open(stack, 2),
                # Only for watches: each keeps a connection open.
                await self._open(stack, 2 * max(1, len(settings.namespaces))),
            )
            self.port = await stack.enter_async_context(
                serving(
                    settings.host,
                    settings.port,
                    alive=self.health.alive,
                    ready=self.health.ready,
                    metrics=self.metrics,
                )
            )
            where = ", ".join(settings.namespaces) or "all namespaces"
            log.info("operating in %s as %s", where, settings.identity)
            await self._operate(stop)
        log.info("stopped")

    async def _open(
        self,
        stack: contextlib.AsyncExitStack,
        connections: int,
        permit: Permit = lambda: WRITE_TIMEOUT,
    ) -> Cluster:
        cluster = Cluster(
            await self._configure(),
            connections=connections,
            permit=permit,
            observe=self.metrics.requested,
        )
        stack.push_async_callback(cluster.close)
        return cluster

    def _build(self, cluster: Cluster, lease_cluster: Cluster, watch_cluster: Cluster) -> None:
        settings, clock = self._settings, asyncio.get_running_loop().time
        self.elector = LeaderElector(
            lease_cluster,
            namespace=settings.namespace,
            name=names.operator_lease_name(settings.lease),
            identity=settings.identity,
            seconds=settings.lease_seconds,
            on_change=self._lease_changed,
            wall_clock=self._now,
        )
        self.queue = WorkQueue(self._reconcile, concurrency=settings.concurrency)
        self.lease_monitor = LeaseMonitor(cluster, lambda key: self.queue.add(key, urgent=True))
        self.recorder = EventRecorder(cluster, self._now, settings.identity)
        self.watches = WatchStatus(settings.namespaces)
        self.informer = PodInformer(
            watch_cluster,
            namespaces=settings.namespaces,
            changed=self._pods_changed,
            answered=self.watches.answered,
        )
        self.controller = Controller(
            cluster,
            self.informer,
            lease_monitor=self.lease_monitor,
            recorder=self.recorder,
            metrics=self.metrics,
            draw=self._draw,
            now=self._now,
            requests=settings.requests,
        )
        self.resync = Resync(
            cluster,
            self.queue,
            namespaces=settings.namespaces,
            seconds=settings.resync_seconds,
            on_success=lambda: self.metrics.resynced(self._now()),
        )
        self.heartbeat = Heartbeat(
            lease_cluster,
            namespaces=settings.namespaces,
            identity=settings.identity,
            serves=lambda namespace: self.elector.is_leader and self.resync.lists(namespace),
            wall_clock=self._now,
        )
        self.health = Health(self.elector, self.queue, self.resync, self.watches, clock)
        self.metrics.watch_queue(self.queue.statistics, lambda: self.elector.is_leader)

    async def _operate(self, stop: asyncio.Event) -> None:
        watcher = self._make_watches(
            self.notice,
            renewed=self._renewed,
            configure=self._configure,
            namespaces=self._settings.namespaces,
            gate=self.resync.wait_until_served,
            on_start=self._kopf_started,
            answered=self.watches.answered,
        )
        parts: list[Part] = [
            self.elector,
            self.lease_monitor,
            self.queue,
            self.resync,
            self.heartbeat,
            self.recorder,
            self.informer,
            watcher,
        ]
        tasks = [asyncio.ensure_future(part.run()) for part in parts]
        stopped = asyncio.ensure_future(stop.wait())
        try:
            await asyncio.wait([*tasks, stopped], return_when=asyncio.FIRST_COMPLETED)
            self.elector.resign()
            await self.queue.drain(DRAIN)
            # Release the Lease before the slow end of the watches, so that another operator begins.
            tasks[0].cancel()
            await asyncio.wait([tasks[0]])
            await self.elector.release()
        finally:
            for task in (*tasks, stopped):
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
        for result in results:
            if isinstance(result, Exception):
                raise result

    def notice(self, key: Key, uid: str, generation: int) -> None:
        """Reconcile a pool that was made, changed or deleted (generation -1)."""
        self.metrics.watched("fiberpools")
        if self.controller.is_news(key, uid, generation):
            self.queue.add(key, urgent=True)

    def _pods_changed(self, key: Key) -> None:
        self.metrics.watched("pods")
        if all(key):  # a pod without these labels is of another program
            self.queue.add(key)

    def _renewed(self, namespace: str, lease: str, version: str, connected: int | None) -> None:
        self.metrics.watched("leases")
        self.lease_monitor.lease_changed(namespace, lease, version, connected)

    async def _reconcile(self, key: Key) -> Result:
        if not self.elector.is_leader:
            return Result()
        return await self.controller.reconcile(key)

    def _permit(self) -> float:
        return self.elector.require()

    def _kopf_started(self, running: bool) -> None:
        if running and self._kopf_started_before:
            self.metrics.watch_restarted()
        self._kopf_started_before = True
        self.watches.started(running)

    def _lease_changed(self, held: bool) -> None:
        self.controller.forget()
        if held:
            self.informer.refresh()
            # This operator has reconciled no pool while another was the leader.
            self.resync.poke()
            for key in self.queue.known():
                self.queue.add(key)
