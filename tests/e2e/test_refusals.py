"""Refusals of the API server: manifests of pools, and pods of pools that looked well."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from contract.bad_manifests import BAD, BAD_UPDATES, DUPLICATE_RELEASE, GOOD, Bad, BadUpdate
from e2e.delays import record
from e2e.kube import JSON_PATCH, Body, Failed, Kube, Refused, path_of
from e2e.pools import Pool, condition_in, problem_in, says
from e2e.quotas import make_quota
from e2e.scene import Scene
from e2e.test_apply import SOMEWHERE

DRY = {"dryRun": "All", "fieldValidation": "Strict"}
QUICK = {"backoffBaseSeconds": 1, "backoffMaxSeconds": 2}


# -- Manifests


def test_a_good_manifest_is_taken(kube: Kube, release: object) -> None:
    kube.create(path_of("fiberpools", "default"), GOOD, **DRY)


@pytest.mark.parametrize("bad", [*BAD, DUPLICATE_RELEASE], ids=lambda bad: bad.name)
def test_a_manifest_that_breaks_a_rule_is_refused(kube: Kube, release: object, bad: Bad) -> None:
    with pytest.raises(Refused) as caught:
        kube.create(path_of("fiberpools", "default"), bad.manifest(), **DRY)
    assert caught.value.status in (400, 422)
    assert not [word for word in bad.words if word not in caught.value.message]


def test_kubectl_prints_the_reason_of_a_refusal(kube: Kube, release: object) -> None:
    bad = next(bad for bad in BAD if bad.name == "minimum above maximum")
    with pytest.raises(Failed) as caught:
        kube.apply(bad.manifest())
    said = str(caught.value)
    assert says(said, 'The FiberPool "es" is invalid: spec.minReplicas:', "raise the other")


def test_a_misspelt_field_is_refused_by_kubectl(kube: Kube, release: object) -> None:
    spec = {**GOOD["spec"], "minReplica": 1}
    with pytest.raises(Failed, match=r'unknown field "spec\.minReplica"'):
        kube.apply({**GOOD, "spec": spec})


@pytest.mark.parametrize("update", BAD_UPDATES, ids=lambda update: update.name)
def test_a_change_that_breaks_a_rule_is_refused(scene: Scene, update: BadUpdate) -> None:
    path = scene.path("fiberpools")
    scene.kube.create(path, update.first())
    # Not a PUT: it needs the newest version, and the operator writes the status meanwhile.
    change = [{"op": "replace", "path": "/spec", "value": update.second()["spec"]}]
    with pytest.raises(Refused) as caught:
        scene.kube.call("PATCH", f"{path}/es", change, kind=JSON_PATCH, query=DRY)
    assert not [word for word in update.words if word not in caught.value.message]


def test_an_epoch_is_remembered_after_its_master(pool: Pool, agent: Body) -> None:
    pool.apply(agent)
    pool.attach(master={**SOMEWHERE, "epoch": 3})
    pool.wait("its epoch in the status", lambda: pool.status.get("masterEpoch") == 3)
    pool.attach()
    pool.wait("no master", lambda: "master" not in pool.body["spec"])
    for epoch in (2, 3):
        with pytest.raises(Refused, match=r"must not be below status\.masterEpoch"):
            pool.attach(master={**SOMEWHERE, "epoch": epoch})
    pool.attach(master={**SOMEWHERE, "epoch": 4})


# -- Pods


def test_a_quota_that_refuses_pods_is_a_problem(pool: Pool, agent: Body) -> None:
    scene = pool.scene
    make_quota(scene, "small", pods="2")
    pool.apply(agent, minReplicas=4, failurePolicy=QUICK)
    problem = pool.has_problem("QuotaExceeded", severity="Error")
    assert says(problem["message"], "quota", "exceeded quota: small", "raise the ResourceQuota")
    assert not problem.get("terminal")
    pool.wait("two workers", lambda: pool.status.get("readyReplicas") == 2)
    assert pool.condition("Ready")["status"] == "False"
    assert pool.status["phase"] == "Degraded"
    second = sorted(scene.first("pods", _is(name)) for name in pool.ever)[1]
    told = scene.first("fiberpools", lambda body: problem_in(body, "QuotaExceeded"))
    record("a quota is exceeded", told - second)
    scene.kube.patch(scene.path("resourcequotas", "small"), {"spec": {"hard": {"pods": "9"}}})
    pool.ready(4)
    assert not pool.status["problems"]


def test_a_template_that_is_no_pod(pool: Pool, agent: Body) -> None:
    pool.apply(_with_mount(agent), minReplicas=1)
    problem = pool.has_problem("InvalidTemplate", severity="Error", terminal=True)
    words = ("volumeMounts[", 'Not found: "nothing"', "Correct spec.template")
    assert says(problem["message"], *words)
    assert pool.status["phase"] == "Failed"
    assert pool.condition("Accepted")["status"] == "False"
    made = pool.scene.first("fiberpools", bool)
    told = pool.scene.first("fiberpools", lambda p: problem_in(p, "InvalidTemplate"))
    record("a template is no valid pod", told - made)
    assert not pool.ever
    pool.apply(agent, minReplicas=1)
    pool.ready(1)
    assert pool.condition("Accepted")["status"] == "True"


def test_a_misspelt_field_of_the_template_is_named(pool: Pool, agent: Body) -> None:
    """Schemas of pools accept it, because each cluster decides which pods are valid."""
    misspelt = copy.deepcopy(agent)
    misspelt["spec"]["containers"][0]["resorces"] = {"limits": {"memory": "1Gi"}}
    pool.apply(misspelt, minReplicas=1)
    problem = pool.has_problem("InvalidTemplate", severity="Error", terminal=True)
    assert "spec.template.spec.containers[0].resorces" in problem["message"]
    assert not pool.ever


def test_a_template_that_becomes_none_leaves_workers_alone(pool: Pool, agent: Body) -> None:
    pool.apply(agent, minReplicas=2, update={"strategy": "Recreate"})
    before = pool.ready(2)
    pool.apply(_with_mount(agent), minReplicas=2, update={"strategy": "Recreate"})
    pool.has_problem("InvalidTemplate", terminal=True)
    asked = pool.scene.first("fiberpools", lambda p: p["metadata"]["generation"] == 2)
    told = pool.scene.first("fiberpools", lambda p: problem_in(p, "InvalidTemplate"))
    record("an update is no valid pod", told - asked)
    pool.scene.never("a worker goes", lambda: len(pool.live) < 2, seconds=2)
    assert sorted(pool.names) == before
    pool.apply(agent, minReplicas=2, update={"strategy": "Recreate"})
    assert pool.ready(2) == before


def test_workers_meet_the_restricted_standard(pool: Pool, agent: Body) -> None:
    scene = pool.scene
    labels = {"pod-security.kubernetes.io/enforce": "restricted"}
    scene.kube.patch(path_of("namespaces", name=scene.namespace), {"metadata": {"labels": labels}})
    pool.apply(agent, minReplicas=1).ready(1)
    rebel = Pool(scene, "rebel")
    privileged: dict[str, Any] = {"securityContext": {"privileged": True}}
    (worker,) = agent["spec"]["containers"]
    rebel.apply({"spec": {"containers": [{**worker, **privileged}]}}, minReplicas=1)
    problem = rebel.has_problem("Forbidden", severity="Error", terminal=True)
    assert says(problem["message"], "violates PodSecurity", "privileged", "spec.template")
    assert condition_in(rebel.body, "Accepted")["reason"] == "Forbidden"
    assert not rebel.ever


def test_a_name_that_is_taken(pool: Pool, agent: Body) -> None:
    scene = pool.scene
    service = scene.path("services")
    body = {"metadata": {"name": "es-fiber"}, "spec": {"ports": [{"port": 80}]}}
    before = scene.kube.create(service, body)
    pool.apply(agent, minReplicas=1)
    problem = pool.has_problem("NameTaken", severity="Error", terminal=True)
    assert says(
        problem["message"],
        "Service es-fiber",
        "does not belong to this pool",
        "Delete or rename it",
    )
    assert scene.kube.get(f"{service}/es-fiber") == before
    assert not pool.ever
    scene.kube.delete(f"{service}/es-fiber")
    pool.ready(1)


def test_a_namespace_that_is_deleted(pool: Pool, agent: Body) -> None:
    scene = pool.scene
    pool.apply(agent, minReplicas=2).ready(2)
    scene.kube.delete(path_of("namespaces", name=scene.namespace))
    scene.wait("the pool is gone", lambda: not pool.body, seconds=60)
    told = [problem["reason"] for m in scene.moments for problem in _problems(m.object)]
    assert not told


def _problems(body: Body) -> list[Body]:
    found: list[Body] = body.get("status", {}).get("problems", [])
    return found


def _with_mount(agent: Body) -> Body:
    """A template that no schema can find fault with, and that is no pod all the same."""
    (worker,) = agent["spec"]["containers"]
    mounts = [{"name": "nothing", "mountPath": "/nothing"}]
    return {"spec": {**agent["spec"], "containers": [{**worker, "volumeMounts": mounts}]}}


def _is(name: str) -> Any:
    return lambda body: body["metadata"]["name"] == name
