"""Every pool is reconciled at least this often, whatever the watches bring or do not bring."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from fiber_operator.api_errors import complaint
from fiber_operator.cluster import POOLS, ApiError, Body, Cluster
from fiber_operator.logs import about
from fiber_operator.planning.documents import mapping, text
from fiber_operator.workqueue import Key, Queue

RETRY = 5.0
"""Seconds until the pools are listed again where that failed."""

log = logging.getLogger(__name__)


class Resync:
    """Lists the pools of ``namespaces`` (empty: of all) and puts them in the queue."""

    def __init__(
        self,
        cluster: Cluster,
        queue: Queue,
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
        self._poked = asyncio.Event()
        self._answered = asyncio.Event()
        self.failures: dict[str, str] = {}
        """Namespace (empty: all) -> why its pools cannot be listed."""
        self.tried: float | None = None
        """Time of the event loop at which the pools were last tried to be listed."""
        self.succeeded: float | None = None

    @property
    def seconds(self) -> float:
        return self._seconds

    def lists(self, namespace: str) -> bool:
        """Return True if the pools of the namespace (empty: of all) were listed the last time."""
        return self.tried is not None and namespace not in self.failures

    def poke(self) -> None:
        """List the pools now."""
        self._poked.set()

    async def answered(self) -> None:
        """List the pools now, and wait until that has succeeded somewhere: they are served."""
        self._answered.clear()
        self.poke()
        await self._answered.wait()

    async def run(self) -> None:
        """Go on until cancelled."""
        while True:
            self._poked.clear()
            for namespace in self._namespaces:
                await self._list(namespace)
            self.tried = self._now()
            if not self.failures:
                self.succeeded = self.tried
                self._on_success()
            try:
                async with asyncio.timeout(RETRY if self.failures else self._seconds):
                    await self._poked.wait()
            except TimeoutError:
                pass  # it is time again

    async def _list(self, namespace: str | None) -> None:
        where = namespace or ""
        try:
            found = await self._cluster.list_metadata(POOLS, namespace, _key)
        except ApiError as error:
            failure = complaint(error)
            if self.failures.get(where) != failure:
                log.warning("%s", failure, extra=about(where, reason=error.reason))
            self.failures[where] = failure
            return
        self.failures.pop(where, None)
        self._answered.set()
        # Those of which no event told that they are gone get a last reconcile that finds it out.
        known = [key for key in self._queue.known() if namespace in (None, key.namespace)]
        for key in dict.fromkeys([key for key in found if key is not None] + known):
            self._queue.add(key)

    def _now(self) -> float:
        return asyncio.get_running_loop().time()


def _key(pool: Body) -> Key | None:
    metadata = mapping(pool, "metadata")
    key = Key(text(metadata.get("namespace")), text(metadata.get("name")))
    return key if all(key) else None
