"""The chart on a real cluster: upgraded, tested, removed, and confined to one namespace."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from e2e.clusters import Cluster
from e2e.kube import Body, Kube, path_of
from e2e.pools import Pool
from e2e.release import Release, crd_owner
from e2e.scene import Scene
from e2e.test_apply import EXAMPLES
from fiber_api import names


def restarts(pool: Pool) -> dict[str, tuple[str, int]]:
    """Each live worker's uid, and how often its container was restarted."""
    return {
        pod["metadata"]["name"]: (
            pod["metadata"]["uid"],
            pod["status"]["containerStatuses"][0]["restartCount"],
        )
        for pod in pool.live
    }


def test_an_upgrade_restarts_no_worker(pool: Pool, agent: Body, release: Release) -> None:
    pool.apply(agent, minReplicas=2, update={"strategy": "Recreate"})
    pool.ready(2)
    before, operator = restarts(pool), release.pod()["metadata"]["name"]
    release.install({"operator": {"logLevel": "DEBUG", "resyncSeconds": 30}})
    try:
        assert release.pod()["metadata"]["name"] != operator
        pool.scale(3)
        pool.ready(3)
        after = restarts(pool)
        assert before.items() <= after.items()
        assert len(pool.ever) == 3
    finally:
        release.install()


def test_helm_test_succeeds_and_prints_its_steps(release: Release) -> None:
    said = release.helm("test", release.name, "--namespace", release.namespace, "--logs")
    assert "Phase:          Succeeded" in said
    assert "its worker is ready" in said
    assert "deleted it: this cluster runs FiberPools" in said


def test_uninstalling_keeps_pools_and_their_type(
    pool: Pool, agent: Body, release: Release, kube: Kube
) -> None:
    pool.apply(agent, minReplicas=2)
    before = pool.ready(2)
    said = release.uninstall()
    try:
        assert "CustomResourceDefinition" in said
        assert crd_owner(kube) == f"{release.namespace}/{release.name}"
        pool.scene.never("a worker goes", lambda: len(pool.live) != 2, seconds=2)
        assert pool.kubectl("get", "fiberpools", "--output", "name") == "fiberpool.fiber.dev/es\n"
        left = kube.items(path_of("clusterroles"), labelSelector=release.selector)
        assert not left
    finally:
        release.install()
    pool.scale(3)
    assert set(before) < set(pool.ready(3))


@pytest.fixture
def small(
    release: Release, kube: Kube, cluster: Cluster, scene: Scene, tmp_path: Path
) -> Iterator[Release]:
    """Instead of the operator for all namespaces, one for its own."""
    release.stop()
    small = Release(kube, "small", scene.namespace, cluster.images, tmp_path)
    try:
        yield small
    finally:
        # The other one would not be ready while only a namespace of this one has a pool.
        kube.kubectl("delete", "fiberpools", "--all", "--namespace", scene.namespace)
        small.uninstall()
        release.start()


def test_an_operator_with_rights_in_one_namespace_serves_it(
    small: Release, pool: Pool, agent: Body, kube: Kube
) -> None:
    small.install({"scope": "namespaced", "crds": {"install": False}})
    pool.apply(agent, minReplicas=1).ready(1)
    labels = {"labelSelector": small.selector}
    assert not kube.items(path_of("clusterroles"), **labels)
    assert not kube.items(path_of("clusterrolebindings"), **labels)
    assert kube.items(path_of("roles", small.namespace), **labels)
    lease = path_of("leases", small.namespace, names.SERVING_LEASE)
    pool.wait("it shows that it serves", lambda: kube.get(lease))
    pool.scale(2)
    pool.ready(2)
    small.helm("test", small.name, "--namespace", small.namespace)
    assert small.may("create", "pods", small.namespace)
    assert not small.may("list", "pods", "default")
    assert not small.may("list", "fiberpools.fiber.dev", "default")
    assert not small.may("list", "nodes", "default")


def test_the_api_server_takes_all_that_the_chart_renders(release: Release, kube: Kube) -> None:
    # tests/chart compares the Prometheus Operator's kinds with their schema.
    everything = {
        "networkPolicy": {"create": True},
        "workerNetworkPolicy": {"create": True, "namespaces": ["default"]},
        "admissionPolicy": {"create": True},
        "metrics": {"dashboard": {"create": True}},
        "priorityClassName": "system-cluster-critical",
        "commonLabels": {"team": "research"},
    }
    said = kube.kubectl(
        "apply",
        "--dry-run=server",
        "--validate=strict",
        "--server-side",
        "--force-conflicts",
        "-f",
        "-",
        stdin=release.render(everything),
    )
    for kind in (
        "deployment.apps",
        "networkpolicy",
        "validatingadmissionpolicy",
        "configmap",
        "clusterrole",
        "service",
    ):
        assert f"\n{kind}" in f"\n{said}"


@pytest.mark.parametrize("name", ["minimal", "gpu", "autoscaled", "warm"])
def test_the_api_server_takes_the_example(release: Release, kube: Kube, name: str) -> None:
    file = str(EXAMPLES / f"{name}.yaml")
    said = kube.kubectl("create", "--dry-run=server", "--validate=strict", "-f", file)
    assert said == f"fiberpool.fiber.dev/{name} created (server dry run)\n"
