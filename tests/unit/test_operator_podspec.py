"""The body of a worker pod: what Fiber adds, and that the user's template wins."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber_api import names
from fiber_api.v1alpha1 import FiberPool
from fiber_operator.planning.manifests import template_hash
from fiber_operator.planning.podspec import NODE_LOST_SECONDS, pod
from unit.operator_objects import MASTER, UID, make_pool, pool_document
from unit.test_operator_pods import ANYTHING

Json = dict[str, Any]


def body_of(spec: Json | None = None, metadata: Json | None = None, **pool: Any) -> Json:
    """A pod of a pool whose template says this beside its worker container."""
    containers = [{"name": "worker", "image": "i"}]
    template = {"metadata": metadata or {}, "spec": {"containers": containers, **(spec or {})}}
    return pod(make_pool(template=template, **pool), "es-0000000001", "10.96.1.2:7070")


def worker_of(container: Json | None = None, **spec: Any) -> Json:
    """The worker container, of which the template says this."""
    worker = {"name": "worker", "image": "i", **(container or {})}
    containers = [{"name": "first", "image": "x"}, worker]
    found: Json = body_of({"containers": containers, **spec})["spec"]["containers"][1]
    return found


def environment(container: Json) -> dict[str, str]:
    values = {variable["name"]: variable.get("value", "") for variable in container["env"]}
    assert len(values) == len(container["env"]), "a variable is there twice"
    return values


def test_a_worker_knows_its_identity_and_place() -> None:
    pool = make_pool(processesPerPod=8, master={**MASTER, "lostGraceSeconds": 90})
    worker = pod(pool, "es-0000000001", "10.96.1.2:7070")["spec"]["containers"][0]
    assert environment(worker) == {
        "FIBER_AGENT_NAME": "es-0000000001",
        "FIBER_AGENT_ADDRESS": "10.96.1.2:7070",
        "FIBER_AGENT_CREDENTIALS": "/etc/fiber/credentials/agent.json",
        "FIBER_AGENT_POOL": "es",
        "FIBER_AGENT_NAMESPACE": "team",
        "FIBER_AGENT_PROCESSES": "8",
        "FIBER_AGENT_LOST_GRACE": "90",
        "FIBER_AGENT_TERMINATION_GRACE": "30",
        "FIBER_AGENT_TEMPLATE_HASH": template_hash(pool),
        "FIBER_AGENT_UID": "",
        "FIBER_AGENT_LINKED": "/etc/fiber/credentials/linked",
    }
    (uid,) = (v for v in worker["env"] if v["name"] == "FIBER_AGENT_UID")
    assert uid["valueFrom"]["fieldRef"]["fieldPath"] == "metadata.uid"


@pytest.mark.parametrize(("seconds", "told"), [(None, "30"), (0, "0"), (90, "90")])
def test_a_worker_knows_how_long_its_pod_has_after_sigterm(seconds: Any, told: str) -> None:
    worker = worker_of(terminationGracePeriodSeconds=seconds)
    assert environment(worker)["FIBER_AGENT_TERMINATION_GRACE"] == told


def test_the_users_environment_wins_and_comes_last() -> None:
    own = [
        {"name": "FIBER_AGENT_ADDRESS", "value": "127.0.0.1:1"},
        {"name": "LOG", "value": "/logs/$(FIBER_AGENT_NAME)"},
    ]
    worker = worker_of({"env": own})
    assert environment(worker)["FIBER_AGENT_ADDRESS"] == "127.0.0.1:1"
    assert worker["env"][-2:] == own
    assert "FIBER_AGENT_POOL" in environment(worker)


def test_an_agent_is_called_as_its_pod_whatever_the_template_says() -> None:
    own = [{"name": "FIBER_AGENT_NAME", "value": "mine"}, {"name": "A", "value": "1"}]
    worker = worker_of({"env": own})
    assert environment(worker)["FIBER_AGENT_NAME"] == "es-0000000001"
    assert environment(worker)["A"] == "1"


def test_autoscalers_leave_a_node_with_workers_alone_unless_the_template_says_otherwise() -> None:
    evict, disrupt = "cluster-autoscaler.kubernetes.io/safe-to-evict", "karpenter.sh/do-not-disrupt"
    assert body_of()["metadata"]["annotations"] == {evict: "false", disrupt: "true"}
    metadata = {"annotations": {evict: "true", "note": "n"}}
    found = body_of(metadata=metadata)["metadata"]["annotations"]
    assert found == {evict: "true", disrupt: "true", "note": "n"}


def test_a_pod_mounts_the_secret_that_its_pool_names() -> None:
    key, _ = body_of(credentialsSecretName="mine")["spec"]["volumes"]
    assert key["secret"]["secretName"] == "mine"


def test_only_the_init_container_gets_the_pools_key() -> None:
    body = body_of({"containers": [{"name": "x", "image": "i"}, {"name": "worker", "image": "i"}]})
    other, worker = body["spec"]["containers"]
    (first,) = body["spec"]["initContainers"]
    assert "volumeMounts" not in other
    assert "env" not in other
    written = {"name": "fiber-credentials", "mountPath": "/etc/fiber/credentials"}
    key = {"name": "fiber-key", "mountPath": "/etc/fiber/key", "readOnly": True}
    assert worker["volumeMounts"] == [written]
    assert first["volumeMounts"] == [written, key]
    secret, memory = body["spec"]["volumes"]
    assert secret["secret"]["secretName"] == "es-fiber-key"
    assert memory["emptyDir"]["medium"] == "Memory"


def first_of(container: Json, **spec: Any) -> Json:
    """The pod's first init container, of which the template's worker says this."""
    worker = {"name": "worker", "image": "i", **container}
    found: Json = body_of({"containers": [worker], **spec})["spec"]["initContainers"][0]
    return found


def test_the_init_container_names_the_pod_whatever_the_template_says() -> None:
    own = [{"name": "FIBER_AGENT_NAME", "value": "another"}, {"name": "FIBER_AGENT_UID"}]
    env = {v["name"]: v for v in first_of({"env": own})["env"]}
    fields = {
        n: v["valueFrom"]["fieldRef"]["fieldPath"] for n, v in env.items() if "valueFrom" in v
    }
    assert fields == {"FIBER_AGENT_NAME": "metadata.name", "FIBER_AGENT_UID": "metadata.uid"}
    assert env["FIBER_AGENT_KEY"]["value"] == "/etc/fiber/key"


@pytest.mark.parametrize(
    ("master", "status", "epoch"),
    [
        (None, {}, "0"),
        (None, {"masterEpoch": 4}, "4"),
        ({**MASTER, "epoch": 5}, {"masterEpoch": 4}, "5"),
    ],
)
def test_an_agent_knows_the_highest_epoch_before_its_pod(
    master: Json | None, status: Json, epoch: str
) -> None:
    pool = make_pool(status=status, **({} if master is None else {"master": master}))
    (first,) = pod(pool, "es-0000000001", "a:1")["spec"]["initContainers"]
    assert {"name": "FIBER_AGENT_EPOCH", "value": epoch} in first["env"]


def test_the_init_container_gets_no_variable_or_volume_that_tasks_can_write() -> None:
    """Each of these makes Python, its loader or its shell run code from the shared volume."""
    names_of_code = ("PYTHONPATH", "PYTHONHOME", "HOME", "PATH", "LD_PRELOAD", "BASH_ENV")
    shared = {
        "workingDir": "/shared",
        "env": [{"name": name, "value": "/shared"} for name in names_of_code],
        "envFrom": [{"configMapRef": {"name": "variables"}}],
        "volumeMounts": [{"name": "shared", "mountPath": "/shared"}],
        "volumeDevices": [{"name": "disk", "devicePath": "/dev/xvda"}],
    }
    first, plain = first_of(shared), first_of({})
    assert first == plain
    assert {v["name"] for v in first["env"]}.isdisjoint(names_of_code)


def test_the_init_container_has_the_volume_of_the_interpreter_and_no_other() -> None:
    mounts = [
        {"name": "tools", "mountPath": "/opt/", "subPath": "venv"},
        {"name": "shared", "mountPath": "/op"},
    ]
    first = first_of(
        {"command": ["/opt/bin/python", "-m", "fiber.agent"], "volumeMounts": mounts},
        volumes=[{"name": "tools"}, {"name": "shared"}],
    )
    assert first["volumeMounts"][0] == {**mounts[0], "readOnly": True}
    assert [m["name"] for m in first["volumeMounts"][1:]] == ["fiber-credentials", "fiber-key"]


@pytest.mark.parametrize(
    ("said", "command"),
    [
        ({}, None),
        ({"command": ["/opt/python", "-m", "fiber.agent"]}, ["/opt/python", "-m", "fiber.agent"]),
        ({"command": ["sh", "-c", "exec python -m fiber.agent"]}, None),
        ({"command": ["sleep", "9"], "args": ["x"]}, ["python", "-m", "fiber.agent"]),
    ],
)
def test_the_init_container_has_the_agent_command_of_the_worker(
    said: Json, command: list[str] | None
) -> None:
    first = first_of(said)
    assert first.get("command") == (command or said.get("command"))
    assert "args" not in first


def test_the_init_container_asks_for_no_more_than_the_worker() -> None:
    asked = {"cpu": "2", "memory": "1Gi"}
    devices = {**asked, "nvidia.com/gpu": "1"}
    first = first_of({"resources": {"limits": devices, "requests": asked}, "ports": [{}]})
    assert first["resources"] == {"limits": asked, "requests": asked}
    assert "ports" not in first
    assert "resources" not in first_of({})


def test_the_init_container_comes_before_those_of_the_template() -> None:
    own = {"name": "mine", "image": "x"}
    body = body_of({"initContainers": [own]})["spec"]
    assert [c["name"] for c in body["initContainers"]] == ["fiber-identity", "mine"]
    assert [v["name"] for v in body["volumes"]] == ["fiber-key", "fiber-credentials"]


def test_a_mount_of_the_users_own_replaces_the_credentials() -> None:
    mounts = [{"name": "mine", "mountPath": "/etc/fiber/credentials/"}]
    body = body_of({"containers": [{"name": "worker", "image": "i", "volumeMounts": mounts}]})
    assert body["spec"]["containers"][0]["volumeMounts"] == mounts
    assert "volumes" not in body["spec"]
    assert "initContainers" not in body["spec"]


def test_a_read_only_root_gets_a_writable_tmp_and_another_does_not() -> None:
    read_only = {"securityContext": {"readOnlyRootFilesystem": True}}
    assert {m["mountPath"] for m in worker_of(read_only)["volumeMounts"]} == {
        "/tmp",
        "/etc/fiber/credentials",
    }
    assert len(worker_of()["volumeMounts"]) == 1
    own = {**read_only, "volumeMounts": [{"name": "disk", "mountPath": "/tmp"}]}
    assert [m["name"] for m in worker_of(own)["volumeMounts"]] == ["disk", "fiber-credentials"]


def test_a_pod_is_bare_and_ends_for_good() -> None:
    body = body_of()
    assert body["spec"]["restartPolicy"] == "Never"
    assert body["spec"]["automountServiceAccountToken"] is False
    assert body["spec"]["enableServiceLinks"] is False
    assert body["spec"]["containers"][0]["terminationMessagePolicy"] == "FallbackToLogsOnError"
    kept = {"automountServiceAccountToken": True, "enableServiceLinks": True}
    assert body_of(kept)["spec"].items() >= kept.items()
    assert worker_of({"terminationMessagePolicy": "File"})["terminationMessagePolicy"] == "File"


def test_a_pod_keeps_the_metadata_of_the_user_except_identity_and_owner() -> None:
    metadata = {
        "name": "mine",
        "namespace": "elsewhere",
        "finalizers": ["keep"],
        "ownerReferences": [{"uid": "other"}],
        "labels": {"team": "rl", names.LABEL_POOL_UID: "stolen"},
        "annotations": {"note": "n"},
    }
    pool = make_pool(master={**MASTER, "epoch": 3})
    found = body_of(metadata=metadata, master={**MASTER, "epoch": 3})["metadata"]
    assert (found["name"], found["namespace"]) == ("es-0000000001", "team")
    assert "finalizers" not in found
    assert [owner["uid"] for owner in found["ownerReferences"]] == [UID]
    assert found["labels"]["team"] == "rl"
    assert found["labels"][names.LABEL_POOL_UID] == UID
    assert found["labels"][names.LABEL_EPOCH] == "3"
    assert found["annotations"].items() >= {"note": "n"}.items()
    plain = pod(pool, "es-0000000001", "a:1")["metadata"]
    assert plain["labels"][names.LABEL_TEMPLATE_HASH] == template_hash(pool)


def test_pods_meet_the_restricted_security_standard() -> None:
    body = body_of({"initContainers": [{"name": "i", "image": "x"}]})["spec"]
    assert body["securityContext"] == {
        "runAsNonRoot": True,
        "seccompProfile": {"type": "RuntimeDefault"},
    }
    for container in (*body["initContainers"], *body["containers"]):
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "capabilities": {"drop": ["ALL"]},
        }


def test_the_templates_security_settings_win() -> None:
    pod_wide = {"runAsUser": 1000, "fsGroup": 5, "seccompProfile": {"type": "Unconfined"}}
    body = body_of({"securityContext": pod_wide})["spec"]
    assert body["securityContext"] == {**pod_wide, "runAsNonRoot": True}
    own = {"allowPrivilegeEscalation": True, "capabilities": {"add": ["NET_ADMIN"]}}
    assert worker_of({"securityContext": own})["securityContext"] == own


@pytest.mark.parametrize(
    "said",
    [{"securityContext": {"runAsNonRoot": False}}, {"securityContext": {"runAsUser": 0}}],
)
def test_a_template_may_ask_for_root(said: Json) -> None:
    body = body_of(said)["spec"]
    assert not body["securityContext"].get("runAsNonRoot")
    assert "capabilities" not in body["containers"][0]["securityContext"]


def test_a_container_that_asks_for_root_keeps_it() -> None:
    worker = worker_of({"securityContext": {"runAsUser": 0}})
    assert worker["securityContext"]["runAsNonRoot"] is False
    assert "capabilities" not in worker["securityContext"]


@pytest.mark.parametrize(
    "own", [{"privileged": True}, {"capabilities": {"add": ["CAP_SYS_ADMIN"]}}]
)
def test_a_security_context_gets_no_field_that_conflicts_with_the_users(own: Json) -> None:
    worker = worker_of({"securityContext": own})
    assert "allowPrivilegeEscalation" not in worker["securityContext"]


def test_capabilities_may_hold_anything() -> None:
    added = {"add": [["SYS_ADMIN"], {}]}
    context = worker_of({"securityContext": {"capabilities": added}})["securityContext"]
    assert context["capabilities"] == added


def tolerated(spec: Json) -> dict[str, Any]:
    return {
        t.get("key", ""): t.get("tolerationSeconds") for t in body_of(spec)["spec"]["tolerations"]
    }


def test_a_pod_leaves_a_silent_node_after_a_minute_unless_the_template_says_when() -> None:
    lost, unready = "node.kubernetes.io/unreachable", "node.kubernetes.io/not-ready"
    assert tolerated({}) == {lost: NODE_LOST_SECONDS, unready: NODE_LOST_SECONDS}
    own = [{"key": lost, "operator": "Exists", "effect": "NoExecute", "tolerationSeconds": 9}]
    assert tolerated({"tolerations": own}) == {lost: 9, unready: NODE_LOST_SECONDS}
    assert tolerated({"tolerations": [{"operator": "Exists"}]}) == {"": None}
    gpu = [{"key": "nvidia.com/gpu", "operator": "Exists", "effect": "NoSchedule"}]
    assert len(tolerated({"tolerations": gpu})) == 3


def test_the_template_is_not_changed() -> None:
    pool = make_pool()
    before = copy.deepcopy(pool.spec.template)
    body = pod(pool, "es-0000000001", "a:1")
    body["spec"]["containers"][0]["env"].clear()
    assert pool.spec.template == before


def test_null_equals_an_absent_field() -> None:
    spec = {"securityContext": None, "volumes": None, "tolerations": None}
    container = {"name": "worker", "image": "i", "env": None, "securityContext": None}
    nulls, silent = body_of({**spec, "containers": [container]})["spec"], body_of()["spec"]
    for body in (nulls, silent):  # the hash is of the template as it is written
        for container in (*body["initContainers"], *body["containers"]):
            env = container["env"]
            env[:] = [variable for variable in env if variable["name"] != names.ENV_TEMPLATE_HASH]
    assert nulls == silent


FIELDS = ["volumes", "securityContext", "tolerations", "initContainers", "hostNetwork"]
CONTAINER_FIELDS = ["env", "volumeMounts", "securityContext", "resources", "command"]


@pytest.mark.slow
@given(
    spec=st.dictionaries(st.sampled_from(FIELDS), ANYTHING),
    container=st.dictionaries(st.sampled_from(CONTAINER_FIELDS), ANYTHING),
    metadata=st.dictionaries(st.sampled_from(["labels", "annotations"]), ANYTHING),
)
def test_nonsense_is_passed_on(spec: Json, container: Json, metadata: Json) -> None:
    worker = {"name": "worker", "image": "i", **container}
    body = body_of({**spec, "containers": [worker]}, metadata)
    assert body["spec"]["restartPolicy"] == "Never"
    hidden = spec.get("hostNetwork")
    assert body["spec"].get("hostNetwork") == hidden or hidden != hidden


# -- Requests that the template does not set

REQUESTS = {"cpu": "50m", "memory": "64Mi"}


@pytest.mark.parametrize(
    ("resources", "of_the_pod", "requested"),
    [
        (None, {}, REQUESTS),
        ({"requests": None}, {}, REQUESTS),
        ({"requests": {"cpu": "2"}}, {}, {"cpu": "2", "memory": "64Mi"}),
        ({"limits": {"memory": "1Gi"}}, {}, {"cpu": "50m"}),
        ({"limits": {"nvidia.com/gpu": "1"}}, {}, REQUESTS),
        ({}, {"limits": {"cpu": "1", "memory": "1Gi"}}, {}),
    ],
)
def test_a_worker_has_requests_that_its_template_does_not_set(
    resources: Json | None, of_the_pod: Json, requested: Json
) -> None:
    worker = {"name": "worker", "image": "i", "resources": resources}
    others = [{"name": "other", "image": "x"}]
    spec = {"containers": [worker, *others], "resources": of_the_pod}
    made = pod(make_pool(template={"spec": spec}), "es-0000000001", "a:1", REQUESTS)["spec"]
    container, other = made["containers"]
    assert container["resources"].get("requests", {}) == requested
    assert container["resources"].get("limits") == (resources or {}).get("limits")
    assert "resources" not in other


def test_the_pool_of_a_program_gets_no_default_requests() -> None:
    document = pool_document()
    document["metadata"]["labels"] = {names.LABEL_MANAGED_BY: names.SDK_MANAGER}
    made = pod(FiberPool.read(document), "es-0000000001", "a:1", REQUESTS)
    assert not made["spec"]["containers"][0].get("resources", {}).get("requests")
