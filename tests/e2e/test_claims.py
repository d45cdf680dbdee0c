"""Volumes of a program's pod, and those that its workers get."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from e2e.kube import Body, path_of
from e2e.leftovers import leaves_nothing
from e2e.program import Programs
from e2e.scene import Scene
from e2e.test_program import ever, is_worker

MODES = {"scratch": "ReadWriteOnce", "datasets": "ReadOnlyMany"}


@pytest.fixture
def claims(scene: Scene) -> Iterator[tuple[str, ...]]:
    """Claims with volumes that are bound to them, by name."""
    volumes = {claim: f"{scene.namespace}-{claim}" for claim in MODES}
    try:
        for claim, mode in MODES.items():
            same = {"accessModes": [mode], "storageClassName": ""}
            where = {"claimRef": {"namespace": scene.namespace, "name": claim}}
            what = {"capacity": {"storage": "1Mi"}, "hostPath": {"path": "/tmp"}}
            volume = {"metadata": {"name": volumes[claim]}, "spec": {**same, **where, **what}}
            scene.kube.create(path_of("persistentvolumes"), volume)
            wanted = {"volumeName": volumes[claim], "resources": {"requests": {"storage": "1Mi"}}}
            body = {"metadata": {"name": claim}, "spec": {**same, **wanted}}
            scene.kube.create(scene.path("persistentvolumeclaims"), body)
        yield tuple(MODES)
    finally:
        for name in volumes.values():
            scene.kube.delete(path_of("persistentvolumes", name=name))


def test_workers_get_no_claim_of_one_node(
    programs: Programs, scene: Scene, claims: tuple[str, ...]
) -> None:
    programs.claims = claims
    program = programs.start("inside", "mapping.py", "--tasks", 60)
    program.says("done")
    output = program.ends()
    assert "workers do not get the PersistentVolumeClaims scratch: " in output
    pods = list(filter(is_worker, ever(scene, "pods").values()))
    assert {tuple(claims_of(pod)) for pod in pods} == {("datasets",)}
    leaves_nothing(program)


def claims_of(pod: Body) -> Iterator[str]:
    for volume in pod["spec"]["volumes"]:
        if "persistentVolumeClaim" in volume:
            yield volume["persistentVolumeClaim"]["claimName"]
