"""``python -m fiber_operator.smoke MANIFEST``: check that this cluster turns a FiberPool into pods.

``helm test`` runs this.  The test creates the FiberPool of MANIFEST (a JSON document), waits until
the pool is ready, and deletes it, even if the test is interrupted.  A pool of that name from an
earlier test is deleted first.  The exit status is 0, or 1 with a message that names the problem.
"""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from collections.abc import Callable, Coroutine, Mapping
from typing import Any

from fiber_api.names import CRD_NAME, ConditionType
from fiber_api.rest import POOLS, ApiError, Conflict, NotFound
from fiber_operator.cluster import MAY_PASS, Cluster, load_configuration

PATIENCE = 240.0
"""Seconds for each step.  `helm test` waits longer by default."""
TOLERANCE = 30.0
"""Seconds for which the pool may be degraded.  A registry, for example, may fail once."""
PAUSE = 0.5
"""Seconds between two reads of the pool."""

UNSEEN = "the operator has not looked at the pool yet"

Pool = Mapping[str, Any]


class Failed(Exception):
    """Failure of the test.  The message says what happened and what to do."""


class Smoke:
    """Test that a pool becomes ready.  ``say`` is called with each line about the progress."""

    def __init__(
        self,
        cluster: Cluster,
        manifest: dict[str, Any],
        say: Callable[[str], None],
        *,
        patience: float = PATIENCE,
        tolerance: float = TOLERANCE,
        pause: float = PAUSE,
    ) -> None:
        self._cluster = cluster
        self._manifest = manifest
        self._namespace: str = manifest["metadata"]["namespace"]
        self._name: str = manifest["metadata"]["name"]
        self._say = say
        self._patience = patience
        self._tolerance = tolerance
        self._pause = pause
        self._last = "no answer of the API server"
        """State that was seen last."""

    async def run(self) -> None:
        """Create the pool, wait until it is ready, and delete it.  Raises Failed."""
        await self._within_patience(self._remove(), "an earlier test's pool could not be deleted")
        try:
            await self._within_patience(self._create(), "the pool could not be made")
            self._say(f"made the FiberPool {self._name} in namespace {self._namespace}")
            await self._within_patience(self._until_ready(), "its worker did not become ready")
        finally:
            await self._within_patience(self._remove(), "the pool could not be deleted")
        self._say("deleted it: this cluster runs FiberPools")

    async def _within_patience(self, step: Coroutine[Any, Any, None], failure: str) -> None:
        try:
            async with asyncio.timeout(self._patience):
                await step
        except TimeoutError:
            message = f"{failure} in {self._patience:g} s. Last seen: {self._last}"
            if self._last == UNSEEN:
                message += (
                    ". The operator does not run, or does not watch the namespace "
                    f"{self._namespace}: see its log"
                )
            raise Failed(message) from None

    async def _create(self) -> None:
        while True:
            try:
                await self._cluster.create(POOLS, self._namespace, self._manifest)
            except NotFound as error:
                raise Failed(
                    f"{error}. Either the namespace {self._namespace} or the resource type "
                    f"{CRD_NAME} does not exist; the chart installs the latter with "
                    "crds.install=true."
                ) from error
            except Conflict:
                return  # an earlier attempt succeeded, and its answer was lost
            except MAY_PASS as error:
                await self._wait(str(error))
            except ApiError as error:
                raise Failed(f"the API server refuses the pool: {error}") from error
            else:
                return

    async def _until_ready(self) -> None:
        clock = asyncio.get_running_loop().time
        last_healthy = clock()
        while True:
            pool = await self._read()
            if pool is None:
                raise Failed(
                    "another client deleted the pool while its worker started. Run the test again"
                )
            if is_ready(pool):
                self._say("its worker is ready")
                return
            if not is_degraded(pool):
                last_healthy = clock()
            if is_hopeless(pool) or clock() - last_healthy > self._tolerance:
                raise Failed(f"its worker does not start. {problems(pool)}")
            await self._wait(state(pool), problems(pool))

    async def _remove(self) -> None:
        while (pool := await self._read()) is not None:
            if "deletionTimestamp" not in pool["metadata"]:
                try:
                    await self._cluster.delete(
                        POOLS, self._namespace, self._name, uid=pool["metadata"]["uid"]
                    )
                except (NotFound, Conflict):
                    continue  # another client deleted it: read it again
                except MAY_PASS as error:
                    self._last = str(error)
            await self._wait("the pool is being deleted")

    async def _read(self) -> Pool | None:
        while True:
            try:
                return await self._cluster.read(POOLS, self._namespace, self._name)
            except NotFound:
                return None
            except MAY_PASS as error:
                await self._wait(str(error))
            except ApiError as error:
                raise Failed(f"the API server does not show the pool: {error}") from error

    async def _wait(self, seen: str, details: str = "") -> None:
        """Wait ``_pause`` seconds.  Print the details only when ``seen`` has changed."""
        if seen != self._last:
            self._last = seen
            self._say(f"{seen}. {details}" if details else seen)
        await asyncio.sleep(self._pause)


def is_ready(pool: Pool) -> bool:
    """Return True if the operator reports Ready for the current spec of the pool."""
    return _is_true(pool, ConditionType.READY)


def is_degraded(pool: Pool) -> bool:
    """Return True if the operator reports a problem."""
    return _is_true(pool, ConditionType.DEGRADED)


def is_hopeless(pool: Pool) -> bool:
    """Return True if a problem is reported that does not end by waiting."""
    return any(problem.get("terminal") for problem in _problems(pool))


def state(pool: Pool) -> str:
    """Return the progress of the pool in a few words."""
    status = pool.get("status")
    if not status:
        return UNSEEN
    reasons = ", ".join(str(problem.get("reason")) for problem in _problems(pool))
    return f"{status.get('phase')}" + (f": {reasons}" if reasons else "")


def problems(pool: Pool) -> str:
    """Return the operator's messages about the problems."""
    return " ".join(str(problem.get("message")) for problem in _problems(pool))


def _is_true(pool: Pool, kind: ConditionType) -> bool:
    status = pool.get("status") or {}
    return status.get("observedGeneration") == pool["metadata"].get("generation") and any(
        condition.get("type") == kind and condition.get("status") == "True"
        for condition in status.get("conditions") or []
    )


def _problems(pool: Pool) -> list[dict[str, Any]]:
    return (pool.get("status") or {}).get("problems") or []


async def _main(manifest: dict[str, Any]) -> None:
    loop, task = asyncio.get_running_loop(), asyncio.current_task()
    assert task is not None
    # Kubernetes sends SIGTERM.  asyncio.run cancels the task on Ctrl-C in the same way.
    loop.add_signal_handler(signal.SIGTERM, task.cancel)
    cluster = Cluster(await load_configuration(), connections=1)
    try:
        await Smoke(cluster, manifest, lambda line: print(line, flush=True)).run()
    finally:
        await cluster.close()


def main() -> None:
    """Run the test of the manifest on the command line."""
    if len(sys.argv) != 2:
        sys.exit("usage: python -m fiber_operator.smoke MANIFEST (a FiberPool as a JSON document)")
    try:
        asyncio.run(_main(json.loads(sys.argv[1])))
    except Failed as failure:
        sys.exit(f"failed: {failure}")
    except asyncio.CancelledError:
        sys.exit("interrupted; the pool was deleted")


if __name__ == "__main__":
    main()
