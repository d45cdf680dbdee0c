"""/healthz, /readyz and /metrics."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable

from aiohttp import web

from fiber_operator.metrics import CONTENT_TYPE, Metrics

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
