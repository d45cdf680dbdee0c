"""Resync: list all pools regularly and put each into the work queue.

The watches report changes.  The resync finds what the watches missed.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from fiber_api.rest import POOLS, ApiError, Body
from fiber_operator.cluster import Cluster
from fiber_operator.logs import about
from fiber_operator.planning.documents import mapping, text
from fiber_operator.responses import complaint
from fiber_operator.workqueue import Key, WorkQueue

log = logging.getLogger(__name__)


RETRY = 5.0
"""Seconds until the next attempt after a list that failed."""


class Resync:
    """Lister of the pools of ``namespaces`` (empty: all), which puts them into ``queue``.

    ``on_success`` is called each time the pools of all ``namespaces`` were listed.
    """

    def __init__(
        self,
        cluster: Cluster,
        queue: WorkQueue,
        *,
        namespaces: tuple[str, ...],
        seconds: float,
        on_success: Callable[[], None] = lambda: None,
    ) -> None:
        self._cluster = cluster
        self._queue = queue
        self._namespaces: tuple[str | None, ...] = namespaces or (None,)
        self._seconds = seconds
        self._on_success = on_success
        self._requested = asyncio.Event()
        self._listed = asyncio.Event()
        self.failures: dict[str, str] = {}
        """Error of the last list that failed, by namespace (empty: all)."""
        self.tried: float | None = None
        """Time of the event loop at the end of the last attempt to list all pools."""
        self.succeeded: float | None = None
        """Time of the event loop at the end of the last attempt that listed all pools."""

    @property
    def seconds(self) -> float:
        """Seconds between two lists."""
        return self._seconds

    def lists(self, namespace: str) -> bool:
        """Return True if the last list of the pools of ``namespace`` (empty: all) succeeded."""
        return self.tried is not None and namespace not in self.failures

    def poke(self) -> None:
        """List the pools now."""
        self._requested.set()

    async def wait_until_served(self) -> None:
        """List the pools now, and wait until the API server has answered one list."""
        self._listed.clear()
        self.poke()
        await self._listed.wait()

    async def run(self) -> None:
        """List the pools again and again until cancelled."""
        while True:
            self._requested.clear()
            for namespace in self._namespaces:
                await self._list(namespace)
            self.tried = self._now()
            if not self.failures:
                self.succeeded = self.tried
                self._on_success()
            try:
                async with asyncio.timeout(RETRY if self.failures else self._seconds):
                    await self._requested.wait()
            except TimeoutError:
                pass  # the next list is due

    async def _list(self, namespace: str | None) -> None:
        where = namespace or ""
        try:
            listed = await self._cluster.list_metadata(POOLS, namespace, _key)
        except ApiError as error:
            failure = complaint(error)
            if self.failures.get(where) != failure:
                log.warning("%s", failure, extra=about(where, reason=error.reason))
            self.failures[where] = failure
            return
        self.failures.pop(where, None)
        self._listed.set()
        # A pool whose deletion the watch missed is reconciled once more, which finds it deleted.
        known = [key for key in self._queue.known() if namespace in (None, key.namespace)]
        for key in dict.fromkeys([key for key in listed if key is not None] + known):
            self._queue.add(key)

    def _now(self) -> float:
        return asyncio.get_running_loop().time()


def _key(pool: Body) -> Key | None:
    metadata = mapping(pool, "metadata")
    key = Key(text(metadata.get("namespace")), text(metadata.get("name")))
    return key if all(key) else None
