"""Health of the operator, and the HTTP server of /healthz, /readyz and /metrics.

"Not alive" means that this process is stuck and a restart may help.  "Not ready" means that pools
are not served as they should be and a restart would change nothing.
"""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass

from aiohttp import web

from fiber_operator.metrics import CONTENT_TYPE, Metrics
from fiber_operator.operator_leases import LeaderElector
from fiber_operator.watches import Resync, WatchStatus
from fiber_operator.workqueue import WorkQueue

LATE_TURN = 30.0
"""Seconds that a pool may wait for its reconcile while the operator is ready."""
STUCK_TURN = 600.0
"""Longer than any reconcile takes whose every call ends by its timeout."""
STUCK_QUEUE = 120.0
"""Seconds without the end of any reconcile while a pool waits."""
MISSED_RESYNCS = 2.5


@dataclass
class Health:
    """Both checks.  Each returns what is wrong, a sentence each."""

    elector: LeaderElector
    queue: WorkQueue
    resync: Resync
    watches: WatchStatus
    clock: Callable[[], float]

    def __post_init__(self) -> None:
        self._began = self.clock()

    def alive(self) -> list[str]:
        """Why this process should be restarted."""
        now, statistics = self.clock(), self.queue.statistics()
        wrong = []
        if statistics.longest_run > STUCK_TURN:
            wrong.append(f"the reconcile of a pool takes {statistics.longest_run:.0f} s so far")
        if min(statistics.longest_wait, statistics.since_last_end) > STUCK_QUEUE:
            wrong.append(
                f"no reconcile has ended for {statistics.since_last_end:.0f} s, and pools wait"
            )
        tried = now - (self._began if self.resync.tried is None else self.resync.tried)
        # One list takes as long as its timeout where the API server is silent.
        if tried > 2 * self.resync.seconds + 120:
            wrong.append(f"the pools were not even tried to be listed for {tried:.0f} s")
        return wrong

    def ready(self) -> list[str]:
        """Why pools are not served as they should be."""
        now, statistics = self.clock(), self.queue.statistics()
        wrong = list(self.resync.failures.values())
        if not self.elector.is_leader:
            wrong.append(f"this operator does not act: {self.elector.why}")
        if self.resync.succeeded is None:
            wrong.append("the pools were not listed yet")
        elif now - self.resync.succeeded > MISSED_RESYNCS * self.resync.seconds:
            wrong.append(f"the pools were last listed {now - self.resync.succeeded:.0f} s ago")
        wrong += self.watches.wrong()
        if statistics.longest_wait > LATE_TURN:
            wrong.append(f"a pool waits for its reconcile for {statistics.longest_wait:.0f} s")
        return wrong


# -- The server

Check = Callable[[], list[str]]
"""Function that returns a sentence for each trouble; none: all is well."""


@contextlib.asynccontextmanager
async def serving(
    host: str, port: int, *, alive: Check, ready: Check, metrics: Metrics
) -> AsyncIterator[int]:
    """Serve on ``host`` (empty: all addresses) and ``port`` (0: a free one, which is yielded)."""

    async def show_metrics(request: web.Request) -> web.Response:
        return web.Response(body=metrics.render(), headers={"Content-Type": CONTENT_TYPE})

    application = web.Application()
    application.router.add_get("/healthz", _handler(alive))
    application.router.add_get("/readyz", _handler(ready))
    application.router.add_get("/metrics", show_metrics)
    runner = web.AppRunner(application, access_log=None, shutdown_timeout=0.5)
    await runner.setup()
    try:
        await web.TCPSite(runner, host or None, port).start()
        yield int(runner.addresses[0][1])
    finally:
        await runner.cleanup()


def _handler(check: Check) -> Callable[[web.Request], Awaitable[web.Response]]:
    async def answer(request: web.Request) -> web.Response:
        wrong = check()
        text = "\n".join(wrong) if wrong else "ok"
        return web.Response(status=503 if wrong else 200, text=text + "\n")

    return answer
