"""Workers that do not start or do not last: the status reports them, and soon.

All the pools are made at once, as most of the time is the kubelet's; each test waits for its own.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping
from typing import Any

import pytest
import yaml

from e2e.delays import record
from e2e.kube import Body
from e2e.pools import Pool, has_ended, says, state_of, template, waits_for
from e2e.scene import Scene

Pools = Mapping[str, Pool]

QUICK = {"backoffBaseSeconds": 1, "backoffMaxSeconds": 4, "backoffLimit": 2}
SECRET = {"name": "KEY", "valueFrom": {"secretKeyRef": {"name": "absent", "key": "key"}}}
VOLUME = {"name": "data", "secret": {"secretName": "absent-too"}}
NO_MODEL = "import sys; print('reading the model'); sys.exit('model.pt: no such file')"


@pytest.fixture(scope="module")
def pools(module_scene: Scene, image: str) -> Pools:
    """Make one pool with one worker for each way to be bad."""
    templates: dict[str, Body] = {
        "bad-image": template("registry.invalid/none:1"),
        "bad-name": template("Not/An:Image:Name"),
        "never-pulled": template("absent:1", imagePullPolicy="Never"),
        "no-secret": template(image, env=[SECRET]),
        "no-volume": template(image, volumeMounts=[{"name": "data", "mountPath": "/data"}]),
        "too-big": template(image, resources={"requests": {"cpu": "1000"}}),
        "oom": template(
            image, "python", "-c", "bytearray(10**9)", resources={"limits": {"memory": "48Mi"}}
        ),
        "fails": template(image, "python", "-c", NO_MODEL),
        "ends": template(image, "true"),
        "no-program": template(image, "no-such-program"),
        "never-ready": template(image, readinessProbe={"exec": {"command": ["false"]}}),
        "as-root": template(image, securityContext={"runAsNonRoot": True, "runAsUser": 0}),
    }
    templates["no-volume"]["spec"]["volumes"] = [VOLUME]
    pools = {name: Pool(module_scene, name) for name in templates}
    # The first probe may come late on a busy machine.
    policies = {"never-ready": {**QUICK, "startupTimeoutSeconds": 20}}
    items = [
        pool.manifest(templates[name], minReplicas=1, failurePolicy=policies.get(name, QUICK))
        for name, pool in pools.items()
    ]
    module_scene.kube.apply({"apiVersion": "v1", "kind": "List", "items": items})
    return pools


def is_told_soon(pool: Pool, reported: Callable[[Body], bool], reason: str, **fields: Any) -> None:
    record(f"{pool.name}: {reason}", pool.told_after(reported, reason, **fields))


# First, as the kubelet tries again to mount a volume ever later.
def test_a_secret_that_is_missing(pools: Pools) -> None:
    pool = pools["no-secret"]
    problem = pool.has_problem("CreateContainerConfigError", severity="Error")
    assert says(
        problem["message"], problem["pod"], 'secret "absent" not found', "Create the missing Secret"
    )
    assert not problem.get("terminal")
    is_told_soon(pool, waits_for("CreateContainerConfigError"), "CreateContainerConfigError")


def test_a_volume_that_is_missing(pools: Pools) -> None:
    pool = pools["no-volume"]
    problem = pool.has_problem("FailedMount")
    assert says(problem["message"], problem["pod"], 'secret "absent-too" not found')


def test_the_missing_secrets_come(pools: Pools, module_scene: Scene) -> None:
    waiting = [pools["no-secret"], pools["no-volume"]]
    pods = [{pod["metadata"]["name"] for pod in pool.pods} for pool in waiting]
    for name in ("absent", "absent-too"):
        secret = {"metadata": {"name": name}, "stringData": {"key": "x"}}
        module_scene.kube.create(module_scene.path("secrets"), secret)
    for pool, before in zip(waiting, pods, strict=True):
        assert set(pool.ready(1, seconds=100)) == before
        assert not pool.status["problems"]


def test_an_image_that_cannot_be_pulled(pools: Pools) -> None:
    pool = pools["bad-image"]
    problem = pool.has_problem("ImagePullError", severity="Error", seconds=60)
    words = (problem["pod"], "registry.invalid/none:1", "Correct", "imagePullSecrets")
    assert says(problem["message"], *words)
    assert not problem.get("terminal")
    assert pool.status["phase"] == "Degraded"
    assert pool.condition("Degraded")["reason"] == "ImagePullError"
    assert says(pool.condition("Ready")["message"], "0 of 1")
    assert says(pool.condition("Degraded")["message"], "registry.invalid/none:1")
    is_told_soon(pool, waits_for("ErrImagePull", "ImagePullBackOff"), "ImagePullError")
    is_told_soon(pool, waits_for("ImagePullBackOff"), "ImagePullError", severity="Error")


def test_kubectl_shows_the_problem_of_a_pool(pools: Pools) -> None:
    pool = pools["bad-image"]
    pool.has_problem("ImagePullError", severity="Error", seconds=60)
    read = yaml.safe_load(pool.kubectl("get", "fiberpool", pool.name, "--output", "yaml"))
    (problem,) = read["status"]["problems"]
    assert problem["reason"] == "ImagePullError"
    columns = pool.kubectl("get", "fiberpool", pool.name, "--output", "wide").splitlines()[1]
    assert "Degraded   ImagePullError" in columns
    assert problem["message"] in columns
    described = pool.kubectl("describe", "fiberpool", pool.name)
    assert says(described, "Problems:", "registry.invalid/none:1")
    events = pool.kubectl("events", "--for", f"fiberpool/{pool.name}")
    assert "ImagePullError" in events


def test_a_corrected_image_heals_the_pool(pools: Pools, agent: Body) -> None:
    pool = pools["bad-image"]
    pool.has_problem("ImagePullError", seconds=60)
    pool.apply(agent, minReplicas=1, failurePolicy=QUICK)
    pool.ready(1)
    assert not pool.status["problems"]
    assert pool.condition("Degraded")["status"] == "False"


def test_an_invalid_image_name_is_a_terminal_problem(pools: Pools) -> None:
    pool = pools["bad-name"]
    problem = pool.has_problem("InvalidImageName", severity="Error", terminal=True)
    assert says(problem["message"], problem["pod"], "Correct the image in spec.template")
    is_told_soon(pool, waits_for("InvalidImageName"), "InvalidImageName")


def test_an_image_that_is_not_there_and_not_to_be_pulled(pools: Pools) -> None:
    pool = pools["never-pulled"]
    problem = pool.has_problem("ErrImageNeverPull", severity="Error", terminal=True)
    assert says(problem["message"], problem["pod"], "Never", "absent:1", "Load the image")
    is_told_soon(pool, waits_for("ErrImageNeverPull"), "ErrImageNeverPull")


def test_a_worker_that_fits_nowhere(pools: Pools) -> None:
    pool = pools["too-big"]
    problem = pool.has_problem("Unschedulable", severity="Warning")
    assert says(problem["message"], problem["pod"], "Insufficient cpu", "Add nodes", "autoscaler")
    assert pool.status["pendingReplicas"] == 1
    assert pool.status["phase"] == "Scaling"
    is_told_soon(pool, _unschedulable, "Unschedulable")


def test_a_worker_out_of_memory(pools: Pools) -> None:
    pool = pools["oom"]
    problem = pool.has_problem("OOMKilled", severity="Error")
    words = (problem["pod"], "out of memory", "48Mi", "Raise resources.limits.memory")
    assert says(problem["message"], *words)
    failures = pool.status["failures"]
    assert (failures["lastExitCode"], failures["lastReason"]) == (137, "OOMKilled")
    is_told_soon(pool, has_ended, "OOMKilled")


def test_a_worker_that_fails_is_tried_again_and_then_no_more(pools: Pools) -> None:
    pool = pools["fails"]
    last = pool.has_problem("BackoffLimitExceeded", terminal=True, seconds=60)
    words = (
        "3",
        "in a row",
        "failurePolicy.backoffLimit",
        "2",
        "No workers are created until template",
        "change in the spec",
    )
    assert says(last["message"], *words, "model.pt: no such file")
    assert pool.status["phase"] == "Failed"
    assert pool.status["failures"]["consecutive"] == 3
    assert pool.status["failures"]["total"] == 3
    assert pool.condition("Degraded")["reason"] == "BackoffLimitExceeded"
    problem = pool.problem("ContainerFailed")
    assert problem is not None
    assert says(problem["message"], problem["pod"], "code 1", "model.pt: no such file")
    is_told_soon(pool, has_ended, "ContainerFailed")
    _waited_longer_each_time(pool)
    pool.scene.never("a fourth pod", lambda: len(pool.ever) > 3, seconds=3)
    for name in pool.ever:
        assert "reading the model" in pool.kubectl("logs", name)


def test_a_corrected_spec_is_tried_at_once(pools: Pools, agent: Body) -> None:
    pool = pools["fails"]
    pool.has_problem("BackoffLimitExceeded", seconds=60)
    pool.apply(agent, minReplicas=1, failurePolicy=QUICK)
    pool.ready(1)
    assert pool.status["failures"].get("consecutive", 0) == 0


def test_a_worker_that_ends_at_once(pools: Pools) -> None:
    pool = pools["ends"]
    problem = pool.has_problem("Completed", severity="Error")
    assert says(problem["message"], problem["pod"], "exit code 0", "python -m fiber.agent")
    is_told_soon(pool, has_ended, "Completed")


def test_a_program_that_is_not_in_the_image(pools: Pools) -> None:
    pool = pools["no-program"]
    problem = pool.has_problem("RunContainerError", severity="Error", terminal=True)
    words = (problem["pod"], "no-such-program", "Correct the command in spec.template")
    assert says(problem["message"], *words)
    is_told_soon(pool, has_ended, "RunContainerError")


def test_a_worker_that_is_never_ready(pools: Pools) -> None:
    pool = pools["never-ready"]

    def deleted() -> Body | None:
        """Return the problem of a worker that ran for so long; it has others before."""
        found = pool.problem("StartupTimeout")
        return found if found and "It was deleted" in found["message"] else None

    problem = pool.wait("a late worker is deleted", deleted, seconds=90)
    assert problem["severity"] == "Error"
    words = (problem["pod"], "20 s", "startupTimeoutSeconds", "not become ready", "probe failed")
    assert says(problem["message"], *words)
    assert pool.status["failures"]["total"] >= 1


def test_an_image_that_wants_to_be_root(pools: Pools) -> None:
    pool = pools["as-root"]
    problem = pool.has_problem("CreateContainerConfigError", severity="Error", terminal=True)
    assert says(problem["message"], problem["pod"], "root", "runAsUser")
    is_told_soon(pool, waits_for("CreateContainerConfigError"), "CreateContainerConfigError")


def _unschedulable(pod: Body) -> bool:
    conditions = pod.get("status", {}).get("conditions", [])
    return any(c["type"] == "PodScheduled" and c["status"] == "False" for c in conditions)


def _waited_longer_each_time(pool: Pool) -> None:
    """The second worker came a second after the end of the first, the third two after that."""
    first, second, third = pool.pods
    assert _seconds_between(first, second) >= 1
    assert _seconds_between(second, third) >= 2


def _seconds_between(ended: Body, made: Body) -> float:
    """Return the time from a worker's end to the next pod; both are whole seconds."""
    end = state_of(ended)["terminated"]["finishedAt"]
    return (_time(made["metadata"]["creationTimestamp"]) - _time(end)).total_seconds()


def _time(text: str) -> datetime.datetime:
    return datetime.datetime.fromisoformat(text)
