"""Programs in namespaces with restrictions: standards, quotas, limits, webhooks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from e2e.clusters import Cluster
from e2e.kube import Body, path_of
from e2e.leftovers import leaves_nothing
from e2e.pools import is_ready
from e2e.program import Programs
from e2e.quotas import make_quota
from e2e.scene import Scene
from e2e.test_drain import squares
from e2e.test_program import ever, is_worker, workers
from e2e.webhook import SIDECAR, sidecars
from fiber_api import names

pytestmark = pytest.mark.timeout(240, func_only=True)

TASKS = 60


def restricted(scene: Scene) -> None:
    labels = {"pod-security.kubernetes.io/enforce": "restricted"}
    scene.kube.patch(path_of("namespaces", name=scene.namespace), {"metadata": {"labels": labels}})


def quota_on_requests(scene: Scene) -> None:
    make_quota(scene, "requests", **{"requests.cpu": "1", "requests.memory": "1Gi"})


def limit_range(scene: Scene) -> None:
    limits = {
        "type": "Container",
        "min": {"memory": "16Mi"},
        "max": {"memory": "512Mi"},
        "default": {"cpu": "1", "memory": "256Mi"},
        "defaultRequest": {"cpu": "10m", "memory": "32Mi"},
    }
    body = {"metadata": {"name": "limits"}, "spec": {"limits": [limits]}}
    scene.kube.create(scene.path("limitranges"), body)


@pytest.mark.parametrize(
    "guard", [restricted, quota_on_requests, limit_range], ids=lambda guard: guard.__name__
)
def test_a_program_works_under(
    guard: Callable[[Scene], None], programs: Programs, scene: Scene
) -> None:
    guard(scene)
    program = programs.start("inside", "mapping.py", "--tasks", TASKS)
    assert program.says("done")["total"] == squares(TASKS)
    program.ends()
    leaves_nothing(program)


def test_a_worker_that_ends_before_its_sidecar_is_replaced(
    programs: Programs, scene: Scene, cluster: Cluster, image: str, tmp_path: Path
) -> None:
    """A worker has ended though the other container of its pod has not."""
    if cluster.outside is None:
        pytest.skip(f"{cluster.description}: the API server cannot reach a webhook of the tests")
    with sidecars(scene, cluster.outside, image, tmp_path):
        program = programs.start("inside", "mapping.py", "--tasks", 600, "--seconds", 0.1)
        program.says("first")
        (victim, *_) = scene.wait(
            "a worker is Ready", lambda: list(filter(is_ready, workers(scene)))
        )
        cluster.kill(victim, names.WORKER_CONTAINER)
        assert program.says("done")["total"] == squares(600)
        program.ends()
        leaves_nothing(program)
    pods = list(filter(is_worker, ever(scene, "pods").values()))
    assert len(pods) > 3
    assert {tuple(containers(pod)) for pod in pods} == {(SIDECAR, names.WORKER_CONTAINER)}


def containers(pod: Body) -> list[str]:
    return [container["name"] for container in pod["spec"]["containers"]]
