"""Check that programs leave no objects in their namespaces."""

from __future__ import annotations

from e2e.kube import path_of
from e2e.program import Program
from e2e.scene import Scene
from fiber_api import names

_OWN = (
    "fiberpools",
    "pods",
    "secrets",
    "leases",
    "services",
    "endpointslices",
    "deployments",
)
_NOT_THEIRS = {f"leases/{names.SERVING_LEASE}"}
"""The Lease by which the operator shows that it serves the namespace."""


def leaves_nothing(program: Program, seconds: float = 45.0) -> None:
    """Wait until all that it made is gone from its namespace; its own pod may stay.

    A pod has 30 seconds to end before it is ended.
    """
    found: list[str] = []

    def is_empty() -> bool:
        found[:] = _left(program.scene, but=f"pods/{program.pod}")
        return not found

    try:
        program.scene.wait("nothing is left", is_empty, seconds, poll=0.3)
    except AssertionError as error:
        raise AssertionError(f"{error}, but there are {found}\n{program.output}") from None


def _left(scene: Scene, but: str) -> list[str]:
    there = [
        f"{resource}/{item['metadata']['name']}"
        for resource in _OWN
        for item in scene.kube.items(path_of(resource, scene.namespace))
    ]
    return [each for each in there if each not in {but, *_NOT_THEIRS}]
