"""Health of the operator, and the HTTP server of /healthz, /readyz and /metrics.

/healthz fails if this process is stuck, so that a restart may help.  /readyz fails if pools are not
served as they should be and a restart would not help, for example because a right is missing.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass

from aiohttp import web

from fiber_api.rest import PODS, ApiError
from fiber_operator.metrics import CONTENT_TYPE, Metrics
from fiber_operator.operator_leases import LeaderElector
from fiber_operator.responses import complaint
from fiber_operator.resync import Resync
from fiber_operator.watches import WATCHED
from fiber_operator.workqueue import WorkQueue

log = logging.getLogger(__name__)


LATE_RECONCILE = 30.0
"""Seconds that a pool may wait for its reconcile.  After that the operator is not ready."""
STUCK_RECONCILE = 600.0
"""Seconds that a reconcile may take.  One in which every call times out takes less."""
STUCK_QUEUE = 120.0
"""Seconds that may pass without the end of a reconcile while a pool waits."""
MISSED_RESYNCS = 2.5
"""Intervals of the resync that may pass without a list of all pools."""


class WatchStatus:
    """State of the watches of ``namespaces`` (empty: all), for /readyz."""

    def __init__(self, namespaces: Sequence[str]) -> None:
        self._required = [
            f"watch {resource.plural}{where}"
            for where in ([f" in {namespace}" for namespace in namespaces] or [""])
            for resource in (*WATCHED, PODS)
        ]
        self._kopf_runs = False
        self._open: set[str] = set()
        """Watches that the API server has accepted, as in ``_required``."""
        self._failures: dict[str, str] = {}
        """Errors of lists and watches whose last attempt failed."""

    def started(self, running: bool) -> None:
        """Note that kopf has started (True) or ended (False), which begins its watches anew."""
        self._kopf_runs = running
        # The watch of pods is the informer's, and goes on.
        self._open = {what for what in self._open if what.startswith(f"watch {PODS.plural}")}

    def answered(self, what: str, error: ApiError | None) -> None:
        """Note the answer to the list or watch ``what``."""
        if error is None:
            self._open.add(what)
            if self._failures.pop(what, None):
                log.info("%s works again", what)
            return
        failure = complaint(error)
        if self._failures.get(what) != failure:
            log.warning("changes are not seen: %s", failure)
        self._failures[what] = failure

    def problems(self) -> list[str]:
        """Return the reasons why changes are not seen, or are seen late."""
        problems = [f"changes are not seen: {failure}" for failure in self._failures.values()]
        if not self._kopf_runs:
            problems.append("kopf does not run: changes are seen late")
        elif not problems:
            missing = [what for what in self._required if what not in self._open]
            problems += [f"changes are seen late: {what} has not begun yet" for what in missing]
        return problems


@dataclass
class Health:
    """The checks of /healthz and /readyz.  Each returns a list of problems, one sentence each."""

    elector: LeaderElector
    queue: WorkQueue
    resync: Resync
    watches: WatchStatus
    clock: Callable[[], float]

    def __post_init__(self) -> None:
        self._started = self.clock()

    def alive(self) -> list[str]:
        """Return the reasons to restart this process."""
        now, statistics = self.clock(), self.queue.statistics()
        problems = []
        if statistics.longest_run > STUCK_RECONCILE:
            problems.append(
                f"the reconcile of a pool has taken {statistics.longest_run:.0f} s so far"
            )
        if min(statistics.longest_wait, statistics.since_last_end) > STUCK_QUEUE:
            problems.append(
                f"pools wait, and no reconcile has ended for {statistics.since_last_end:.0f} s"
            )
        silence = now - (self._started if self.resync.tried is None else self.resync.tried)
        # If the API server does not answer, a list takes until its timeout.
        if silence > 2 * self.resync.seconds + 120:
            problems.append(f"the operator has not tried to list the pools for {silence:.0f} s")
        return problems

    def ready(self) -> list[str]:
        """Return the reasons why pools are not served as they should be."""
        now, statistics = self.clock(), self.queue.statistics()
        problems = list(self.resync.failures.values())
        if not self.elector.is_leader:
            problems.append(f"this operator is not the leader: {self.elector.why}")
        if self.resync.succeeded is None:
            problems.append("the pools have not been listed yet")
        elif now - self.resync.succeeded > MISSED_RESYNCS * self.resync.seconds:
            problems.append(f"the pools were last listed {now - self.resync.succeeded:.0f} s ago")
        problems += self.watches.problems()
        if statistics.longest_wait > LATE_RECONCILE:
            problems.append(f"a pool has waited {statistics.longest_wait:.0f} s for its reconcile")
        return problems


# -- The server

MOST_CONNECTIONS = 64
"""Connections that are open at the same time.  One more ends the oldest, so that a pod that opens
many takes neither the operator's descriptors nor the place of the kubelet's probes."""
FRESH = 1.0
"""Seconds for which a page of metrics serves.  A page of 1,000 pools takes about 0.1 s to make, in
which the operator does no other work."""

Check = Callable[[], list[str]]
"""Returns a sentence for each problem."""


@contextlib.asynccontextmanager
async def serving(
    host: str, port: int, *, alive: Check, ready: Check, metrics: Metrics
) -> AsyncIterator[int]:
    """Serve on ``host`` (empty: all addresses) and ``port`` (0: a free one).  Yield the port."""
    pages = {
        "/healthz": _handler(alive),
        "/readyz": _handler(ready),
        "/metrics": _MetricsPage(metrics, asyncio.get_running_loop().time).answer,
    }

    async def answer(request: web.BaseRequest) -> web.StreamResponse:
        page = pages.get(request.path)
        return web.Response(status=404) if page is None else page()

    runner = web.ServerRunner(_Server(answer, access_log=None), shutdown_timeout=0.5)
    await runner.setup()
    try:
        await web.TCPSite(runner, host or None, port).start()
        yield int(runner.addresses[0][1])
    finally:
        await runner.cleanup()


class _Server(web.Server):
    """HTTP server with a bounded number of connections."""

    def __call__(self) -> web.RequestHandler:
        there = [one.transport for one in self.connections if one.transport is not None]
        open_ones = [transport for transport in there if not transport.is_closing()]
        for transport in open_ones[: max(0, len(open_ones) + 1 - MOST_CONNECTIONS)]:
            transport.abort()
        return super().__call__()


class _MetricsPage:
    """The page of /metrics, made at most once in ``FRESH`` seconds."""

    def __init__(self, metrics: Metrics, clock: Callable[[], float]) -> None:
        self._metrics = metrics
        self._clock = clock
        self._page = b""
        self._made = float("-inf")

    def answer(self) -> web.Response:
        now = self._clock()
        if now - self._made >= FRESH:
            self._page, self._made = self._metrics.render(), now
        return web.Response(body=self._page, headers={"Content-Type": CONTENT_TYPE})


def _handler(check: Check) -> Callable[[], web.Response]:
    def answer() -> web.Response:
        problems = check()
        text = "\n".join(problems) if problems else "ok"
        return web.Response(status=503 if problems else 200, text=text + "\n")

    return answer
