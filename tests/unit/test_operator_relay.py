"""The body of the relay's Deployment, for every template."""

from __future__ import annotations

import json
from typing import Any

import pytest

from fiber_api import names
from fiber_operator.planning import manifests, podspec, relay
from fiber_operator.planning.manifests import template_hash
from unit.operator_objects import ADDRESS, MASTER, UID, make_pool

Json = dict[str, Any]

RESTRICTED_POD = {"runAsNonRoot": True, "seccompProfile": {"type": "RuntimeDefault"}}
RESTRICTED = {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}
GARBAGE: tuple[Any, ...] = (
    None,
    True,
    -1,
    0.5,
    "",
    "x",
    [],
    {},
    [None],
    [[]],
    [{}],
    {"name": {}},
    [{"name": []}],
)


def template(pod: Json | None = None, /, **worker: Any) -> Json:
    container = {"name": "worker", "image": "registry/worker:1", **worker}
    return {"spec": {"containers": [container], **(pod or {})}}


def deployment(pod: Json | None = None, /, **worker: Any) -> Json:
    made = make_pool(relay=True, master=MASTER, template=template(pod, **worker))
    return relay.deployment(made)


def spec_of(pod: Json | None = None, /, **worker: Any) -> Json:
    """Return the relay's pod; further arguments are fields of the worker's container."""
    return dict(deployment(pod, **worker)["spec"]["template"]["spec"])


def container_of(pod: Json | None = None, /, **worker: Any) -> Json:
    (container,) = spec_of(pod, **worker)["containers"]
    return dict(container)


# -- Plain images


def test_a_plain_image_runs_as_a_relay_by_its_own_command() -> None:
    container = container_of()
    assert container["name"] == "relay"
    assert container["image"] == "registry/worker:1"
    assert "command" not in container
    assert "args" not in container
    assert container["env"] == [
        {"name": "FIBER_RELAY_AGENTS_PORT", "value": "7070"},
        {"name": "FIBER_RELAY_MASTER_PORT", "value": "7071"},
    ]


def test_the_service_leads_to_the_port_for_agents() -> None:
    pool = make_pool(relay=True, master=MASTER)
    (port,) = manifests.service(pool)["spec"]["ports"]
    (listening,) = container_of()["ports"]
    assert port["targetPort"] == listening["containerPort"] == names.MASTER_PORT


def test_only_the_relay_has_the_labels_that_the_service_selects() -> None:
    pool = make_pool(relay=True, master=MASTER)
    body = relay.deployment(pool)
    selector = manifests.service(pool)["spec"]["selector"]
    assert selector == body["spec"]["selector"]["matchLabels"] == {names.LABEL_RELAY: UID}
    assert selector.items() <= body["spec"]["template"]["metadata"]["labels"].items()
    worker = podspec.pod(pool, "es-1", ADDRESS)
    assert not selector.items() <= worker["metadata"]["labels"].items()
    assert "selector" not in manifests.service(make_pool(master=MASTER))["spec"]


def test_what_selects_workers_does_not_select_the_relay() -> None:
    labels = deployment()["spec"]["template"]["metadata"]["labels"]
    assert names.LABEL_POOL_UID not in labels, "the informer would count it as a worker"
    assert names.LABEL_POOL not in labels, "commands in messages delete the pods with this label"


def test_the_relay_belongs_to_the_pool_and_ends_with_it() -> None:
    body = deployment()
    metadata = body["metadata"]
    assert (metadata["name"], metadata["namespace"]) == ("es-fiber-relay", "team")
    assert metadata["ownerReferences"] == [manifests.owner_reference(make_pool())]
    assert metadata["labels"][names.LABEL_POOL] == "es"
    assert manifests.is_ours(make_pool(), body)


def test_there_is_never_a_second_relay() -> None:
    spec = deployment()["spec"]
    assert spec["replicas"] == 1
    assert spec["strategy"] == {"type": "Recreate"}


@pytest.mark.parametrize("length", [1, names.MAX_POOL_NAME])
def test_the_name_is_one_that_kubernetes_takes(length: int) -> None:
    assert len(names.relay_name("p" * length)) <= 63


# -- Commands


def test_a_command_that_is_not_the_agents_is_replaced() -> None:
    container = container_of(command=["jupyter", "lab"], args=["--port", "1"])
    assert container["command"] == ["python", "-m", "fiber.agent"]
    assert "args" not in container


def test_the_command_of_an_agent_is_the_relays() -> None:
    command = ["/opt/python", "-m", "fiber.agent"]
    assert container_of(command=command)["command"] == command


def test_a_command_on_a_volume_has_that_volume_alone_and_may_not_write_to_it() -> None:
    volumes = [
        {"name": "venv", "persistentVolumeClaim": {"claimName": "venv"}},
        {"name": "data", "secret": {"secretName": "data"}},
    ]
    mounts = [
        {"name": "venv", "mountPath": "/venv"},
        {"name": "data", "mountPath": "/data"},
    ]
    command = ["/venv/bin/python", "-m", "fiber.agent"]
    spec = spec_of({"volumes": volumes}, command=command, volumeMounts=mounts)
    assert spec["volumes"] == volumes[:1]
    (container,) = spec["containers"]
    assert container["volumeMounts"] == [{**mounts[0], "readOnly": True}]


def test_the_container_of_the_worker_is_found_by_its_name() -> None:
    containers = [{"name": "log", "image": "log"}, {"name": "main", "image": "worker"}]
    pool = make_pool(
        relay=True, workerContainer="main", template={"spec": {"containers": containers}}
    )
    (container,) = relay.deployment(pool)["spec"]["template"]["spec"]["containers"]
    assert container["image"] == "worker"


# -- Rights


def test_a_relay_meets_the_restricted_security_standard() -> None:
    spec = spec_of()
    assert spec["securityContext"] == RESTRICTED_POD
    assert spec["containers"][0]["securityContext"] == RESTRICTED


def test_a_relay_has_no_secret_no_token_and_no_variable_of_the_template() -> None:
    pod = {
        "serviceAccountName": "robot",
        "automountServiceAccountToken": True,
        "volumes": [{"name": "key", "secret": {"secretName": "key"}}],
        "initContainers": [{"name": "first", "image": "first"}],
        "hostNetwork": True,
        "hostPID": True,
        "shareProcessNamespace": True,
    }
    worker = {
        "env": [{"name": "TOKEN", "value": "t"}],
        "envFrom": [{"secretRef": {"name": "key"}}],
        "volumeMounts": [{"name": "key", "mountPath": "/key"}],
        "workingDir": "/data",
        "lifecycle": {"postStart": {"exec": {"command": ["true"]}}},
    }
    spec = spec_of(pod, **worker)
    assert spec["automountServiceAccountToken"] is False
    assert spec["enableServiceLinks"] is False
    assert spec["volumes"] == []
    (container,) = spec["containers"]
    text = json.dumps(spec)
    for word in ("secret", "TOKEN", "first", "host", "share", "envFrom", "/data"):
        assert word not in text
    assert "lifecycle" not in container


def test_a_relay_of_privileged_workers_has_no_privilege() -> None:
    own = {"privileged": True, "procMount": "Unmasked", "capabilities": {"add": ["SYS_ADMIN"]}}
    unconfined = {"type": "Unconfined"}
    wide = {"sysctls": [{"name": "a", "value": "1"}], "seccompProfile": unconfined}
    spec = spec_of({"securityContext": wide}, securityContext=own)
    assert spec["securityContext"] == RESTRICTED_POD
    assert spec["containers"][0]["securityContext"] == RESTRICTED


def test_a_relay_runs_as_the_user_of_the_workers() -> None:
    wide = {"runAsUser": 1000, "runAsGroup": 7, "fsGroup": 5, "supplementalGroups": [9]}
    own = {"runAsUser": 2000, "readOnlyRootFilesystem": True}
    spec = spec_of({"securityContext": wide}, securityContext=own)
    assert spec["securityContext"] == {**wide, **RESTRICTED_POD}
    assert spec["containers"][0]["securityContext"] == {**own, **RESTRICTED}


@pytest.mark.parametrize("where", ["pod", "container"])
def test_a_relay_runs_as_root_where_the_workers_do(where: str) -> None:
    root = {"securityContext": {"runAsUser": 0}}
    spec = spec_of(root) if where == "pod" else spec_of(**root)
    contexts = [spec["securityContext"], spec["containers"][0]["securityContext"]]
    assert 0 in [context.get("runAsUser") for context in contexts]
    assert contexts[where == "container"].get("runAsNonRoot") is not True
    assert contexts[1]["allowPrivilegeEscalation"] is False
    assert "capabilities" not in contexts[1], "root without them could not read its files"


# -- Nodes


def test_a_relay_runs_where_the_workers_may_run() -> None:
    where = {
        "imagePullSecrets": [{"name": "registry"}],
        "nodeSelector": {"gpu": "yes"},
        "priorityClassName": "high",
        "runtimeClassName": "gvisor",
        "schedulerName": "own",
    }
    required = {"nodeSelectorTerms": [{"matchExpressions": [{"key": "a", "operator": "Exists"}]}]}
    nodes = {"requiredDuringSchedulingIgnoredDuringExecution": required}
    pods: Json = {"preferredDuringSchedulingIgnoredDuringExecution": []}
    spec = spec_of({**where, "affinity": {"nodeAffinity": nodes, "podAntiAffinity": pods}})
    assert where.items() <= spec.items()
    assert spec["affinity"] == {"nodeAffinity": nodes}
    assert "affinity" not in spec_of({"affinity": {"podAntiAffinity": pods}})


def test_a_relay_leaves_a_lost_node_soon_whatever_the_template_tolerates() -> None:
    everything = {"operator": "Exists"}
    first, second, own = spec_of({"tolerations": [everything]})["tolerations"]
    assert own == everything
    for toleration in (first, second):
        assert toleration["effect"] == "NoExecute"
        assert toleration["tolerationSeconds"] < podspec.NODE_LOST_SECONDS
    taints = [toleration["key"].partition("/")[2] for toleration in (first, second)]
    assert taints == ["not-ready", "unreachable"]


def test_a_relay_requests_little_and_limits_what_the_worker_limits() -> None:
    large = {"cpu": "8", "nvidia.com/gpu": "1", "ephemeral-storage": "9Gi", "memory": "64Gi"}
    plain, limited = container_of(), container_of(resources={"limits": large})
    assert set(plain["resources"]["limits"]) == {"memory"}
    assert set(limited["resources"]["limits"]) == {"cpu", "memory", "ephemeral-storage"}
    assert plain["resources"]["requests"] == limited["resources"]["requests"]


# -- Templates of any content


@pytest.mark.parametrize("value", GARBAGE, ids=repr)
def test_a_malformed_field_does_not_raise(value: object) -> None:
    pod_wide = (
        *("affinity", "imagePullSecrets", "nodeSelector", "securityContext", "tolerations"),
        *("volumes", "initContainers", "priorityClassName", "metadata"),
    )
    own = ("args", "command", "env", "image", "resources", "securityContext", "volumeMounts")
    for field in pod_wide:
        json.dumps(deployment({field: value}))
    for field in own:
        json.dumps(deployment(**{field: value}))
    for field in ("limits", "requests"):
        json.dumps(deployment(resources={field: value}))
    for field in ("capabilities", "runAsUser", "runAsNonRoot", "seccompProfile"):
        context = {"securityContext": {field: value}}
        json.dumps(deployment(context, **context))


@pytest.mark.parametrize("value", GARBAGE, ids=repr)
def test_a_malformed_mount_of_the_interpreter_does_not_raise(value: object) -> None:
    command = ["/venv/bin/python", "-m", "fiber.agent"]
    for mount in ({"name": value, "mountPath": "/venv"}, {"name": "v", "mountPath": value}):
        volumes = {"volumes": [{"name": value}, {"name": "v"}, value]}
        json.dumps(deployment(volumes, command=command, volumeMounts=[mount, value]))


def test_the_template_is_not_changed_or_shared() -> None:
    given = template(
        {"tolerations": [{"key": "a"}], "securityContext": {"runAsUser": 1}},
        securityContext={"runAsUser": 2},
    )
    pool = make_pool(relay=True, template=given)
    before = json.dumps(pool.spec.template)
    body = relay.deployment(pool)
    spec = body["spec"]["template"]["spec"]
    spec["tolerations"][-1]["key"] = "b"
    spec["containers"][0]["securityContext"]["runAsUser"] = 3
    assert json.dumps(pool.spec.template) == before


# -- When it is made anew

OLD, NEW = template(image="registry/worker:1"), template(image="registry/worker:2")


def may_stay(there: Json, wanted: Json, proven: Json | None, **spec: Any) -> bool:
    """Return True if the relay of one template stays when the pool has another one."""
    existing = relay.deployment(make_pool(relay=True, template=there))
    existing["spec"].update(spec)
    status = {} if proven is None else {"provenTemplateHash": hash_of(proven)}
    pool = make_pool(status, relay=True, template=wanted)
    return relay.may_stay(pool, existing, relay.deployment(pool))


def hash_of(made: Json) -> str:
    return template_hash(make_pool(template=made))


def test_a_relay_stays_while_its_template_stays() -> None:
    assert may_stay(OLD, OLD, OLD)
    assert may_stay(OLD, OLD, None)


def test_a_relay_that_works_waits_until_the_new_template_works() -> None:
    assert may_stay(OLD, NEW, proven=OLD)
    assert not may_stay(OLD, NEW, proven=NEW)


@pytest.mark.parametrize("proven", [None, template(image="registry/worker:0")])
def test_a_relay_of_an_unproven_template_is_made_anew_at_once(proven: Json | None) -> None:
    """No worker could reach its master through a relay that does not start."""
    assert not may_stay(OLD, NEW, proven)


@pytest.mark.parametrize("replicas", [0, 2, None])
def test_a_scaled_relay_is_made_anew(replicas: int | None) -> None:
    assert not may_stay(OLD, OLD, OLD, replicas=replicas)


def test_a_relay_of_an_operator_with_another_body_is_made_anew() -> None:
    pool = make_pool(relay=True)
    wanted, existing = relay.deployment(pool), relay.deployment(pool)
    existing["metadata"]["annotations"] = {names.ANNOTATION_RELAY_HASH: "another"}
    assert not relay.may_stay(pool, existing, wanted)
    existing["metadata"] = {}
    assert not relay.may_stay(pool, existing, wanted)


def test_two_pools_of_one_name_have_different_relays() -> None:
    first, second = make_pool(relay=True), make_pool(relay=True)
    second = second.model_copy(
        update={"metadata": second.metadata.model_copy(update={"uid": "another"})}
    )
    assert not relay.may_stay(second, relay.deployment(first), relay.deployment(second))


# -- Suspended pools


@pytest.mark.parametrize(
    ("suspend", "status", "wanted"),
    [
        (False, {}, True),
        (True, {}, False),
        (True, {"replicas": 2}, True),
        (True, {"replicas": 0, "terminatingReplicas": 1}, True),
        (True, {"replicas": 0, "terminatingReplicas": 0}, False),
    ],
)
def test_a_suspended_pool_keeps_its_relay_for_its_last_workers(
    suspend: bool, status: Json, wanted: bool
) -> None:
    assert relay.is_wanted(make_pool(status, relay=True, suspend=suspend)) is wanted
    assert not relay.is_wanted(make_pool(status, suspend=suspend))
