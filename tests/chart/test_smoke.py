"""Run of `helm test` against pools in memory: its output, and that it cleans up."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from fiber_api.rest import (
    ApiError,
    Conflict,
    Invalid,
    NotFound,
    NotServed,
    ResourceType,
    ServerUnreachable,
    Unauthorized,
)
from fiber_operator import smoke
from fiber_operator.cluster import Cluster

MANIFEST: dict[str, Any] = {
    "metadata": {"namespace": "ns", "name": "smoke-x"},
    "spec": {"replicas": 1},
}
READY: dict[str, Any] = {
    "observedGeneration": 1,
    "phase": "Ready",
    "readyReplicas": 1,
    "conditions": [{"type": "Ready", "status": "True"}],
}
STARTING: dict[str, Any] = {
    "observedGeneration": 1,
    "phase": "Scaling",
    "conditions": [{"type": "Ready", "status": "False"}],
}
PULLING = {
    "reason": "ImagePullError",
    "message": "no such image; push it",
    "terminal": False,
}


class Pools(Cluster):
    """Stand-in API with at most one FiberPool; each read shows the next status."""

    def __init__(self, *statuses: dict[str, Any]) -> None:
        self.statuses = list(statuses)
        self.pool: dict[str, Any] | None = None
        self.calls: list[str] = []
        self.faults: dict[str, list[Exception]] = {}

    def _called(self, verb: str) -> None:
        self.calls.append(verb)
        if self.faults.get(verb):
            raise self.faults[verb].pop(0)

    async def read(
        self, resource: ResourceType, namespace: str, name: str, *, only_metadata: bool = False
    ) -> dict[str, Any]:
        self._called("get")
        assert (resource.plural, namespace, name) == ("fiberpools", "ns", "smoke-x")
        if self.pool is None:
            raise NotFound("not found")
        if len(self.statuses) > 1:
            return {**self.pool, "status": self.statuses.pop(0)}
        return {**self.pool, "status": self.statuses[0]} if self.statuses else self.pool

    async def create(
        self, resource: ResourceType, namespace: str, body: dict[str, Any], *, dry_run: bool = False
    ) -> dict[str, Any]:
        self._called("create")
        if self.pool is not None:
            raise Conflict("exists")
        self.pool = {**body, "metadata": {**body["metadata"], "uid": "u1", "generation": 1}}
        return self.pool

    async def delete(
        self,
        resource: ResourceType,
        namespace: str,
        name: str,
        *,
        uid: str,
        resource_version: str | None = None,
        grace: int | None = None,
    ) -> None:
        self._called("delete")
        assert self.pool is not None
        assert uid == self.pool["metadata"]["uid"]
        self.pool = None


def run(pools: Pools, patience: float = 15, tolerance: float = 15) -> list[str]:
    """Return the output of the test."""
    said: list[str] = []
    test = smoke.Smoke(
        pools, MANIFEST, said.append, patience=patience, tolerance=tolerance, pause=0
    )
    asyncio.run(test.run())
    return said


def failure(pools: Pools, patience: float = 15, tolerance: float = 15) -> str:
    with pytest.raises(smoke.Failed) as failed:
        run(pools, patience, tolerance)
    return str(failed.value)


def test_the_smoke_test_prints_each_step_once_and_deletes_the_pool() -> None:
    pools = Pools(STARTING, STARTING, {**STARTING, "problems": [PULLING]}, READY)
    assert run(pools) == [
        "made the FiberPool smoke-x in namespace ns",
        "Scaling",
        "Scaling: ImagePullError. no such image; push it",
        "its worker is ready",
        "the pool is being deleted",
        "deleted it: this cluster runs FiberPools",
    ]
    assert pools.pool is None


def test_leftovers_of_an_interrupted_test_are_removed_first() -> None:
    pools = Pools(READY)
    pools.pool = {"metadata": {**MANIFEST["metadata"], "uid": "older", "generation": 1}}
    run(pools)
    assert [call for call in pools.calls if call != "get"] == ["delete", "create", "delete"]


def test_a_status_of_an_older_spec_is_not_believed() -> None:
    pools = Pools({**READY, "observedGeneration": 0}, READY)
    assert "its worker is ready" in run(pools)
    assert pools.statuses == [READY]


def test_a_problem_that_waiting_cannot_help_ends_it() -> None:
    problem = {"reason": "InvalidImageName", "message": "the image is no image", "terminal": True}
    pools = Pools({**STARTING, "problems": [PULLING, problem]})
    words = "its worker does not start. no such image; push it the image is no image"
    assert failure(pools) == words
    assert pools.pool is None


def test_a_trouble_that_lasts_ends_it_and_one_that_passes_does_not() -> None:
    conditions = [*STARTING["conditions"], {"type": "Degraded", "status": "True"}]
    degraded = {**STARTING, "phase": "Degraded", "conditions": conditions, "problems": [PULLING]}
    assert "Degraded: ImagePullError. no such image; push it" in run(Pools(degraded, READY))
    pools = Pools(degraded)
    assert failure(pools, tolerance=0.05) == "its worker does not start. no such image; push it"
    assert pools.pool is None


def test_words_that_change_are_not_repeated() -> None:
    """The kubelet words the same problem differently each time."""
    again = {**PULLING, "message": "no such image (2)"}
    told = run(Pools({**STARTING, "problems": [PULLING]}, {**STARTING, "problems": [again]}, READY))
    assert [line for line in told if "ImagePullError" in line] == [
        "Scaling: ImagePullError. no such image; push it"
    ]


def test_an_idle_operator_is_named() -> None:
    said = failure(pools := Pools(), patience=0.05)
    assert "did not become ready in 0.05 s" in said
    assert "does not watch the namespace ns" in said
    assert pools.pool is None


@pytest.mark.parametrize("kind", [ServerUnreachable, Unauthorized, NotServed])
def test_calls_whose_error_may_pass_are_repeated(kind: type[ApiError]) -> None:
    pools = Pools(READY)
    error = kind("no luck", what="get fiberpools")
    pools.faults = {"get": [error], "create": [error], "delete": [error]}
    assert "its worker is ready" in run(pools)
    assert pools.pool is None


def test_a_create_that_was_carried_out_unseen_counts() -> None:
    pools = Pools(READY)

    async def create_unseen(*arguments: Any, **_: Any) -> dict[str, Any]:
        await Pools.create(pools, *arguments)
        pools.create = Pools.create.__get__(pools)  # type: ignore[method-assign]
        raise ServerUnreachable("no answer in time")

    pools.create = create_unseen  # type: ignore[method-assign]
    assert "its worker is ready" in run(pools)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (NotFound("the server could not find the requested resource"), "crds.install=true"),
        (Invalid("spec.replicas: must not be negative"), "refuses the pool: spec.replicas"),
    ],
)
def test_a_pool_that_cannot_be_made_says_why(error: Exception, words: str) -> None:
    pools = Pools()
    pools.faults = {"create": [error]}
    assert words in failure(pools)


def test_an_interruption_deletes_the_pool() -> None:
    pools = Pools(STARTING)

    async def interrupted(said: Callable[[str], None]) -> None:
        task = asyncio.ensure_future(smoke.Smoke(pools, MANIFEST, said, pause=0).run())
        while "create" not in pools.calls:
            await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(interrupted(lambda line: None))
    assert pools.pool is None
