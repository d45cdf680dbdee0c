"""Check kubectl's commands for pools and their output."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from e2e.delays import record
from e2e.kube import Body, Kube
from e2e.pools import Pool, is_live, says
from e2e.release import Release
from e2e.scene import Scene

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "manifests"
SOMEWHERE: Body = {"host": "10.0.3.7", "port": 41337, "epoch": 1, "identity": "somebody"}
"""Master without a Lease: its absence cannot be noticed."""


def example(name: str, image: str) -> Body:
    """Return an example as printed, except the image."""
    manifest: dict[str, Any] = yaml.safe_load((EXAMPLES / f"{name}.yaml").read_text())
    (worker,) = manifest["spec"]["template"]["spec"]["containers"]
    worker["image"] = image
    return manifest


def table(pool: Pool) -> dict[str, str]:
    """The pool's line in ``kubectl get fiberpools``, by column."""
    head, line = pool.kubectl("get", "fp", pool.name).splitlines()
    starts = [head.index(word) for word in head.split()]
    return {
        head[start:end].strip(): line[start:end].strip()
        for start, end in pairwise([*starts, max(len(head), len(line)) + 1])
    }


def test_the_minimal_example_gives_workers(scene: Scene, image: str) -> None:
    pool = Pool(scene, "minimal")
    scene.kube.apply(example("minimal", image), "--namespace", scene.namespace)
    pool.ready(2)
    # Also of a pool that does not set replicas, or no autoscaler could read it.
    scale = pool.scene.kube.get(pool.scene.path("fiberpools", pool.name, "scale"))
    assert scale is not None
    assert scale["status"]["replicas"] == 2
    row = table(pool)
    assert row.pop("AGE").endswith("s")
    assert row == {
        "NAME": "minimal",
        "DESIRED": "2",
        "READY": "2",
        "CONNECTED": "0",
        "PENDING": "0",
        "PHASE": "Ready",
        "REASON": "",
        "MASTER": "",
    }
    assert {kind: pool.condition(kind)["status"] for kind in pool.conditions} == {
        "Accepted": "True",
        "Ready": "True",
        "Progressing": "False",
        "Degraded": "False",
        "MasterAlive": "Unknown",
        "ScalingLimited": "False",
        "Suspended": "False",
    }


def test_a_deleted_pool_takes_everything_along(pool: Pool, agent: Body) -> None:
    scene = pool.scene
    pool.apply(agent, minReplicas=2).ready(2)
    secret, service = scene.path("secrets", "es-fiber-key"), scene.path("services", "es-fiber")
    assert scene.kube.get(secret)
    assert scene.kube.get(service)
    pool.kubectl("delete", "fiberpool", "es")
    scene.wait("no pod is left", lambda: not scene.now["pods"])
    scene.wait("no endpoint is left", lambda: not scene.now["endpointslices"])
    scene.wait("no Secret is left", lambda: not scene.kube.get(secret), poll=0.5)
    scene.wait("no Service is left", lambda: not scene.kube.get(service), poll=0.5)


def test_kubectl_scales_a_warm_pool_between_its_bounds(pool: Pool, agent: Body) -> None:
    pool.apply(agent, minReplicas=1, maxReplicas=3).ready(1)
    pool.scale(2)
    two = pool.ready(2)
    pool.scale(9)
    pool.ready(3)
    scale = pool.scene.kube.get(pool.scene.path("fiberpools", pool.name, "scale"))
    assert scale is not None
    assert (scale["spec"]["replicas"], scale["status"]["replicas"]) == (9, 3)
    selected = pool.kubectl(
        "get", "pods", "--selector", scale["status"]["selector"], "--no-headers"
    )
    assert len(selected.splitlines()) == 3
    limited = pool.condition("ScalingLimited")
    assert (limited["status"], limited["reason"]) == ("True", "AboveMaximum")
    assert says(limited["message"], "9", "maxReplicas", "3")
    pool.scale(0)
    assert set(pool.ready(1)) < {*two, *pool.ever}
    # As if replicas had not been set: the minimum does not limit that.
    assert pool.condition("ScalingLimited")["reason"] == "WithinBounds"
    assert pool.scene.most_at_once(is_live) == 3


def test_an_attached_master_names_the_workers_to_end(pool: Pool, lone_agent: Body) -> None:
    pool.apply(lone_agent, maxReplicas=5)
    pool.attach(master=SOMEWHERE, replicas=3)
    first, second, third = pool.ready(3)
    pool.scale(1)
    progress = pool.wait("draining", lambda: _progress(pool, "Draining"))
    words = ("2", "only the master knows which are idle", "spec.scaleDown.release")
    assert says(progress["message"], *words)
    assert pool.names == {first, second, third}
    pool.attach(master=SOMEWHERE, replicas=2, scaleDown={"release": [second]})
    assert pool.ready(2) == [first, third]
    pool.attach(master=SOMEWHERE, replicas=1, scaleDown={"release": [second, first]})
    assert pool.ready(1) == [third]
    assert pool.status["failures"].get("disrupted", 0) == 0
    assert not pool.status["problems"]


def test_a_released_name_that_is_no_worker_is_reported(pool: Pool, lone_agent: Body) -> None:
    pool.apply(lone_agent)
    pool.attach(master=SOMEWHERE, replicas=1, scaleDown={"release": ["kube-dns"]})
    problem = pool.has_problem("InvalidRelease", severity="Warning")
    assert says(problem["message"], "spec.scaleDown.release", "kube-dns", "No pod is deleted")
    pool.ready(1)


def test_policy_any_takes_workers_from_a_master(pool: Pool, lone_agent: Body) -> None:
    pool.apply(lone_agent, scaleDown={"policy": "Any"})
    pool.attach(master=SOMEWHERE, replicas=2)
    two = pool.ready(2)
    pool.scale(1)
    (kept,) = pool.ready(1)
    assert kept in two


def test_suspend_and_resume(pool: Pool, agent: Body) -> None:
    scene = pool.scene
    pool.apply(agent, minReplicas=2)
    before = pool.ready(2)
    pool.patch(suspend=True)
    scene.wait("no pod is left", lambda: not scene.now["pods"])
    pool.wait("suspended", lambda: pool.status.get("phase") == "Suspended")
    assert table(pool)["PHASE"] == "Suspended"
    assert (pool.condition("Ready")["status"], pool.condition("Ready")["reason"]) == (
        "False",
        "Suspended",
    )
    assert not pool.status["problems"]
    secret = scene.kube.get(scene.path("secrets", "es-fiber-key"))
    pool.patch(suspend=False)
    assert set(pool.ready(2)).isdisjoint(before)
    assert pool.condition("Suspended")["status"] == "False"
    assert scene.kube.get(scene.path("secrets", "es-fiber-key")) == secret
    assert pool.status["failures"].get("total", 0) == 0


def test_a_worker_that_a_user_deletes_is_replaced(pool: Pool, agent: Body) -> None:
    scene = pool.scene
    pool.apply(agent, minReplicas=2)
    victim, other = pool.ready(2)
    pool.kubectl("delete", "pod", victim, "--wait=false")
    three = pool.wait("a third pod", lambda: len(pool.ever) == 3 and pool.ever)
    (new,) = three - {victim, other}
    assert pool.ready(2) == sorted([other, new])
    failures = pool.status["failures"]
    assert (failures.get("disrupted", 0), failures.get("total", 0)) == (0, 0)
    asked = scene.first("pods", lambda pod: "deletionTimestamp" in pod["metadata"])
    came = scene.first("pods", lambda pod: pod["metadata"]["name"] == new)
    record("a deleted worker is replaced", came - asked)


def test_an_evicted_worker_is_replaced(pool: Pool, agent: Body) -> None:
    scene = pool.scene
    pool.apply(agent, minReplicas=1)
    (victim,) = pool.ready(1)
    scene.kube.create(scene.path("pods", victim, "eviction"), {"metadata": {"name": victim}})
    pool.wait("another", lambda: pool.ever - {victim})
    pool.wait("it is counted", lambda: pool.status.get("failures", {}).get("disrupted") == 1)
    pool.ready(1)
    failures = pool.status["failures"]
    assert (failures["disrupted"], failures.get("total", 0)) == (1, 0)


def test_kubectl_explains_the_fields(release: Release, kube: Kube) -> None:
    assert says(kube.kubectl("explain", "fiberpool"), "pool of worker pods", "spec", "status")
    assert "Action when the master is lost" in kube.kubectl("explain", "fiberpool.spec.onLost")


def test_two_pools_do_not_mix(scene: Scene, agent: Body) -> None:
    es, ppo = Pool(scene, "es"), Pool(scene, "ppo")
    es.apply(agent, minReplicas=1)
    ppo.apply(agent, minReplicas=2)
    one, two = es.ready(1), ppo.ready(2)
    assert len({*one, *two}) == 3
    es.delete()
    scene.wait("es is gone", lambda: "es" not in scene.now["fiberpools"] and not es.pods)
    assert ppo.ready(2) == two


def _progress(pool: Pool, reason: str) -> Body | None:
    condition = pool.condition("Progressing")
    return condition if condition.get("reason") == reason and pool.seen_generation else None
