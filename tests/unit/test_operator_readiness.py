"""Readiness of a pod: the probe that waits for its agent's link, and the status meanwhile."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from fiber_api import names
from fiber_api.times import format_time
from fiber_api.v1alpha1 import FiberPool
from fiber_operator.metrics import PoolSample
from fiber_operator.planning import plans
from fiber_operator.planning.pods import observe
from fiber_operator.planning.podspec import pod
from patience import PATIENCE
from unit.operator_objects import (
    ADDRESS,
    MASTER,
    NOW,
    make_pool,
    plan_of,
    running,
    status_of,
    terminating,
)

Json = dict[str, Any]

LEASED = {**MASTER, "leaseName": "es"}


def worker_of(container: Json | None = None, master: Json | None = MASTER, **spec: Any) -> Json:
    """The worker container of a pod whose template says this of it."""
    template = {"spec": {"containers": [{"name": "worker", "image": "i", **(container or {})}]}}
    pool = make_pool(template=template, master=master, **spec)
    found: Json = pod(pool, "es-0000000001", ADDRESS)["spec"]["containers"][0]
    return found


def joining(number: int = 1, *, age: float = 100.0, **container: Any) -> Json:
    """A pod that runs and whose agent has reached no master, as the kubelet tells."""
    document = running(number, age=age, ready=False)
    document["spec"]["containers"] = [{**worker_of(), **container}]
    document["status"]["containerStatuses"][0].update(ready=False, started=False)
    return document


def is_probed(worker: Json) -> bool:
    linked = [v for v in worker.get("env") or () if v["name"] == names.ENV_LINKED]
    assert bool(linked) == (names.CREDENTIALS_DIRECTORY in str(worker.get("startupProbe")))
    return bool(linked)


# -- Which pods have the probe


@pytest.mark.parametrize("command", [None, ["python", "-m", "fiber.agent"]])
def test_a_pod_of_a_master_waits_for_its_agents_link(command: list[str] | None) -> None:
    worker = worker_of({"command": command} if command else {})
    assert is_probed(worker)
    assert worker["startupProbe"]["failureThreshold"] == 2**31 - 1, "it would end the pod"


@pytest.mark.parametrize(
    ("container", "master"),
    [
        ({}, None),
        ({"command": ["sleep", "infinity"]}, MASTER),
        ({"startupProbe": {"exec": {"command": ["true"]}}}, MASTER),
        ({"volumeMounts": [{"name": "own", "mountPath": names.CREDENTIALS_DIRECTORY}]}, MASTER),
    ],
    ids=["no-master", "no-agent", "own-probe", "own-credentials"],
)
def test_a_pod_without_a_master_or_agent_has_no_startup_probe(
    container: Json, master: Json | None
) -> None:
    assert not is_probed(worker_of(container, master))


@pytest.mark.parametrize(("epoch", "waits"), [(1, False), (2, True)])
def test_a_pod_that_is_made_after_a_master_was_lost_waits_for_the_next_on_purpose(
    epoch: int, waits: bool
) -> None:
    lost = {"masterEpoch": 1, "conditions": [{"type": "MasterAlive", "status": "False"}]}
    pool = make_pool(lost, master={**LEASED, "epoch": epoch})
    made = pod(pool, "es-0000000001", ADDRESS)
    assert is_probed(made["spec"]["containers"][0]) == waits


def test_the_probe_ends_when_the_file_is_there(tmp_path: Path) -> None:
    """Run the probe by the interpreter that the init container has linked to."""
    os.symlink(os.path.realpath(sys.executable), tmp_path / names.PROBE_PROGRAM)
    command = [
        word.replace(names.CREDENTIALS_DIRECTORY, str(tmp_path))
        for word in worker_of()["startupProbe"]["exec"]["command"]
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as probe:
        (tmp_path / names.LINKED_FILE).touch()
        said, _ = probe.communicate(timeout=PATIENCE)
    assert (probe.returncode, said) == (0, b"")
    hurried = [word.replace("range(200)", "range(1)") for word in command]
    (tmp_path / names.LINKED_FILE).unlink()
    failed = subprocess.run(hurried, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert failed.returncode == 1
    assert "no master has answered the agent yet" in failed.stderr


# -- Plan and status


def beside(document: Json, name: str) -> Json:
    """Return the pod with another container that is not ready."""
    other = {"name": name, "ready": False, "state": {"running": {}}}
    document["status"]["containerStatuses"].append(other)
    return document


FALSE = {"exec": {"command": ["false"]}}


@pytest.mark.parametrize(
    ("document", "state", "waits"),
    [
        pytest.param(joining(age=50), "Ready", True, id="not-linked"),
        pytest.param(joining(readinessProbe=FALSE), "Starting", False, id="own-readiness"),
        pytest.param(joining(startupProbe=FALSE), "Starting", False, id="own-startup"),
        pytest.param(running(ready=False), "Starting", False, id="no-probe"),
        pytest.param(beside(joining(), "proxy"), "Starting", False, id="another-container"),
        pytest.param(terminating(joining()), "Terminating", False, id="deleted"),
    ],
)
def test_a_pod_that_is_not_linked_counts_as_ready(document: Json, state: str, waits: bool) -> None:
    found = observe(document, "worker")
    assert (found.state, found.joining) == (state, waits)
    if waits:
        assert (found.was_ready, found.since, found.trouble) == (True, NOW - 49, None)


def test_a_pool_is_ready_when_its_workers_are_linked() -> None:
    pool = make_pool(replicas=2, master=MASTER)
    status = status_of(pool, running(1), joining(2))
    assert (status.replicas, status.ready_replicas, status.pending_replicas) == (2, 1, 0)
    told = {found.type: (found.status, found.reason) for found in status.conditions}
    assert told["Ready"] == ("False", "Starting")
    assert told["Progressing"] == ("True", "Starting")
    assert (status.phase, status.problems) == ("Scaling", ())
    assert status.proven_template_hash == status.template_hash  # the canaries do not wait for it


def test_a_worker_without_a_master_is_neither_replaced_nor_a_failure() -> None:
    pool = make_pool(replicas=1, master=MASTER)
    late = NOW + 10 * pool.spec.failure_policy.startup_timeout_seconds
    made = plan_of(pool, joining(), now=late)
    assert (made.delete, made.create) == ((), 0)


def test_workers_without_a_master_are_ready_and_not_connected() -> None:
    """Even who was made for one that left before the two had met."""
    status = status_of(make_pool(minReplicas=2), running(1), joining(2))
    assert (status.ready_replicas, status.connected_replicas, status.phase) == (2, 0, "Ready")
    orphaned = make_pool(minReplicas=2, master=LEASED)
    lost = status_of(orphaned, running(1), joining(2), master=plans.LeaseVerdict(alive=False))
    assert (lost.ready_replicas, lost.connected_replicas) == (2, 0)


def test_the_metrics_distinguish_connected_from_ready_pods() -> None:
    found = PoolSample.of({}, [observe(each, "worker") for each in (running(1), joining(2))])
    assert found.pods == {"ready": 1, "starting": 1}


# -- How many are connected


WAITING = make_pool(replicas=3, master=LEASED)


def known_before(epoch: int) -> FiberPool:
    """Return a pool whose status says that the first master had two agents."""
    alive = {"type": "MasterAlive", "status": "True", "lastTransitionTime": format_time(NOW - 9)}
    before = {"connectedReplicas": 2, "masterEpoch": 1, "conditions": [alive]}
    return make_pool(before, replicas=3, master={**LEASED, "epoch": epoch})


@pytest.mark.parametrize(
    ("pool", "alive", "told", "connected"),
    [
        pytest.param(WAITING, True, 2, 2, id="lease"),
        pytest.param(WAITING, True, 9, 3, id="more-than-pods"),
        pytest.param(WAITING, True, None, None, id="lease-without-number"),
        pytest.param(WAITING, False, 2, 0, id="lost-master"),
        pytest.param(make_pool(minReplicas=3), None, None, 0, id="no-master"),
        pytest.param(make_pool(replicas=3, master=MASTER), None, None, None, id="no-lease"),
        # An operator that starts goes by the status of this very master.
        pytest.param(known_before(epoch=1), None, None, 2, id="status"),
        pytest.param(known_before(epoch=2), None, None, None, id="status-of-another-master"),
    ],
)
def test_the_lease_of_a_live_master_has_the_number_of_its_agents(
    pool: FiberPool, alive: bool | None, told: int | None, connected: int | None
) -> None:
    verdict = plans.LeaseVerdict(alive, connected=told)
    status = status_of(pool, *map(running, range(3)), master=verdict)
    assert status.connected_replicas == connected
