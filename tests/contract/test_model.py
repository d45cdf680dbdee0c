"""Reading of resources: strict about types, tolerant of new fields."""

from __future__ import annotations

import copy
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from contract.bad_manifests import GOOD, MASTER, changed, keys_of
from fiber_api.schema import schema
from fiber_api.v1alpha1 import FiberPool, FiberPoolStatus, InvalidPool, MasterSpec

GARBAGE: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1.5,
    float("nan"),
    10**30,
    "",
    "x",
    "\ud800",
    "x" * 1000,
    [],
    [[]],
    [None],
    {},
    {"": None},
)

FULL_SPEC: dict[str, Any] = {
    "replicas": 1,
    "minReplicas": 2,
    "maxReplicas": 2,
    "minAvailable": 1,
    "suspend": False,
    "relay": True,
    "processesPerPod": 1,
    "template": {
        "metadata": {},
        "spec": {"containers": [{"name": "worker"}], "restartPolicy": "Never"},
    },
    "workerContainer": "worker",
    "master": {
        **MASTER,
        "certificate": "ab" * 32,
        "leaseName": "es",
        "leaseDurationSeconds": 30,
        "lostGraceSeconds": 60,
    },
    "onLost": "Delete",
    "idle": {"timeoutSeconds": 3600},
    "credentialsSecretName": "es-credentials",
    "scaleDown": {"policy": "Any", "release": ["es-1a2b3c4d5e"], "idleTimeoutSeconds": 60},
    "scaleUp": {"maxInFlight": 200},
    "failurePolicy": {
        "backoffBaseSeconds": 5,
        "backoffMaxSeconds": 300,
        "backoffLimit": 6,
        "startupTimeoutSeconds": 900,
    },
    "update": {"strategy": "OnIdle"},
}

FULL_STATUS: dict[str, Any] = {
    "observedGeneration": 7,
    "phase": "Scaling",
    "replicas": 12,
    "endpoint": "tls+tcp://10.96.1.2:7070",
    "failures": {
        "consecutive": 2,
        "total": 5,
        "lastExitCode": 137,
        "nextCreateTime": "2026-11-21T14:56:13Z",
        "counted": ["es-1a2b3c4d5e"],
    },
    "problems": [{"reason": "ImagePullError", "count": 3, "since": "2026-11-21T14:56:13Z"}],
    "conditions": [
        {"type": "Ready", "status": "False", "lastTransitionTime": "2026-11-21T14:56:13Z"},
        {"type": "Accepted", "status": "True"},
    ],
}

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=8,
)


def pool_of(spec: object, status: object = None) -> dict[str, Any]:
    return {**GOOD, "spec": spec, "status": status}


def paths_of(document: object, path: str) -> list[str]:
    """The path of every field in ``document``, and of every item of a list."""
    if isinstance(document, dict):
        children = [(f"{path}.{key}", value) for key, value in document.items()]
    elif isinstance(document, list):
        children = [(f"{path}[{index}]", value) for index, value in enumerate(document)]
    else:
        children = []
    return [path, *(found for child, value in children for found in paths_of(value, child))]


def fields_of(node: dict[str, Any]) -> dict[str, Any]:
    """The schema's fields below ``node``, as far as the examples here must show each of them."""
    return {
        name: fields_of(child.get("items", child))
        for name, child in node.get("properties", {}).items()
    }


def test_the_full_spec_shows_every_field() -> None:
    def missing(fields: dict[str, Any], document: Any) -> list[str]:
        if isinstance(document, list):
            document = document[0]
        return [
            name
            for name, inner in fields.items()
            if name not in document or missing(inner, document[name])
        ]

    assert missing(fields_of(schema()["properties"]["spec"]), FULL_SPEC) == []


def errors_of(pool: object) -> tuple[str, ...]:
    try:
        FiberPool.read(pool)
    except InvalidPool as error:
        return error.errors
    return ()


@pytest.mark.parametrize("path", paths_of(FULL_SPEC, "spec"))
def test_garbage_in_the_spec_is_named_or_does_no_harm(path: str) -> None:
    for garbage in GARBAGE:
        errors = errors_of(changed(pool_of(FULL_SPEC), {path: garbage}))
        assert all(error.startswith("spec") for error in errors)
        # A rule between two fields may begin with the other one, and then says this one's path.
        assert not errors or any(path.partition("[")[0] in error for error in errors), garbage


@pytest.mark.parametrize("path", paths_of(FULL_STATUS, "status"))
def test_garbage_in_the_status_is_left_out_and_named(path: str) -> None:
    whole = FiberPool.read(pool_of(FULL_SPEC, FULL_STATUS))
    assert whole.unread == ()
    for garbage in GARBAGE:
        pool = FiberPool.read(changed(pool_of(FULL_SPEC, FULL_STATUS), {path: garbage}))
        assert pool.spec == whole.spec
        assert all(line.startswith("status") for line in pool.unread)
        if pool.unread:
            assert any(line.startswith(path.partition("[")[0]) for line in pool.unread)
        # The rest is still there.
        if keys_of(path)[1:2] not in ([], ["phase"]):
            assert pool.status.phase == "Scaling"


def test_an_invalid_condition_is_skipped_and_reported() -> None:
    broken = changed(pool_of(FULL_SPEC, FULL_STATUS), {"status.conditions[0].status": "Perhaps"})
    pool = FiberPool.read(broken)
    assert [condition.type for condition in pool.status.conditions] == ["Accepted"]
    assert pool.unread == (
        "status.conditions[0].status: must be 'True', 'False' or 'Unknown', not 'Perhaps'",
    )


@pytest.mark.slow
@settings(deadline=None)
@given(JSON)
def test_no_status_is_too_odd(document: object) -> None:
    status, _ = FiberPoolStatus.salvage(document)
    again, complaints = FiberPoolStatus.salvage(status.model_dump(by_alias=True, mode="json"))
    assert again == status
    assert complaints == ()


@pytest.mark.slow
@settings(deadline=None)
@given(
    st.fixed_dictionaries(
        {},
        optional={
            "replicas": JSON,
            "phase": JSON,
            "failures": JSON | st.fixed_dictionaries({"total": JSON, "counted": JSON}),
            "problems": JSON | st.lists(st.fixed_dictionaries({"reason": JSON, "since": JSON})),
            "conditions": JSON | st.lists(st.fixed_dictionaries({"type": JSON, "status": JSON})),
        },
    )
)
def test_no_field_of_a_status_is_too_odd(document: dict[str, Any]) -> None:
    before = copy.deepcopy(document)
    status, complaints = FiberPoolStatus.salvage(document)
    assert repr(document) == repr(before)
    assert complaints or status.phase == document.get("phase")


@settings(deadline=None)
@given(JSON)
def test_no_resource_is_too_odd(document: object) -> None:
    for whole in (document, {"metadata": {"name": "es"}, "spec": document}):
        with pytest.raises(InvalidPool):
            FiberPool.read(whole)


def test_defaults_are_the_contracts() -> None:
    pool = FiberPool.read(GOOD)
    spec = pool.spec
    assert (spec.replicas, spec.suspend, spec.processes_per_pod) == (0, False, 1)
    assert (spec.worker_container, spec.master) == ("worker", None)
    assert (spec.scale_down.policy, spec.scale_down.idle_timeout_seconds) == ("ReleasedOnly", 60)
    assert spec.scale_up.max_in_flight == 200
    policy = spec.failure_policy
    assert (policy.backoff_base_seconds, policy.backoff_max_seconds) == (5, 300)
    assert (policy.backoff_limit, policy.startup_timeout_seconds) == (6, 900)
    assert spec.update.strategy == "OnIdle"
    master = MasterSpec.model_validate(MASTER)
    assert (master.lease_name, master.lease_duration_seconds) == (None, 30)
    assert master.lost_grace_seconds == 60
    assert (spec.on_lost, spec.idle, spec.credentials_secret_name) == ("ScaleToMin", None, None)
    bounds = changed(GOOD, {"spec": {"template": GOOD["spec"]["template"]}})
    assert FiberPool.read(bounds).spec.min_replicas == 0
    assert FiberPool.read(bounds).spec.max_replicas == 1000


@pytest.mark.parametrize(("replicas", "wanted"), [(None, 1), (0, 1), (1, 1), (2, 2), (9, 2)])
def test_the_wanted_replicas_lie_between_the_bounds(replicas: int | None, wanted: int) -> None:
    change = {"spec.minReplicas": 1, "spec.replicas": replicas}
    assert FiberPool.read(changed(GOOD, change)).wanted == wanted


def test_the_credentials_are_the_pools_own_unless_it_names_others() -> None:
    assert FiberPool.read(GOOD).credentials_secret == "es-fiber-key"
    named = changed(GOOD, {"spec.credentialsSecretName": "mine"})
    assert FiberPool.read(named).credentials_secret == "mine"


def test_fields_of_a_newer_release_are_passed_over() -> None:
    change = {"spec.shiny": {"new": 1}, "status": {"shiny": 1, "phase": "Ready"}}
    pool = FiberPool.read(changed(GOOD, change))
    assert (pool.status.phase, pool.unread) == ("Ready", ())


def test_null_is_absent() -> None:
    pool = FiberPool.read(changed(GOOD, {"spec.minReplicas": None, "status": None}))
    assert (pool.spec.min_replicas, pool.status) == (0, FiberPoolStatus())


def test_the_template_comes_through_as_it_is() -> None:
    template = {
        "metadata": {"labels": {"team": "research"}},
        "spec": {"containers": [{"name": "worker", "env": [{"name": "A", "value": None}]}], "x": 1},
    }
    assert FiberPool.read(changed(GOOD, {"spec.template": template})).spec.template == template


def test_a_pool_is_a_value() -> None:
    pool = FiberPool.read(pool_of(FULL_SPEC, FULL_STATUS))
    assert pool == FiberPool.read(pool_of(copy.deepcopy(FULL_SPEC), copy.deepcopy(FULL_STATUS)))
    with pytest.raises(ValueError, match="frozen"):
        pool.spec.suspend = True


def test_a_status_is_written_as_it_is_read() -> None:
    status, _ = FiberPoolStatus.salvage(FULL_STATUS)
    written = status.model_dump(by_alias=True, exclude_unset=True)
    assert written == FULL_STATUS | {
        "problems": tuple(FULL_STATUS["problems"]),
        "conditions": tuple(FULL_STATUS["conditions"]),
        "failures": FULL_STATUS["failures"] | {"counted": ("es-1a2b3c4d5e",)},
    }


@pytest.mark.parametrize(
    ("host", "good"),
    [
        ("10.0.3.7", True),
        ("8.8.8.8", True),
        ("fd00::1", True),
        ("2001:db8::1", True),
        ("127.0.0.1", False),
        ("::1", False),
        ("0.0.0.0", False),
        ("::", False),
        ("169.254.1.1", False),
        ("fe80::1", False),
        ("fe80::1%eth0", False),
        ("224.0.0.1", False),
        ("255.255.255.255", False),
        ("::ffff:10.0.3.7", False),
        ("10.0.3.07", False),
        ("10.0.3", False),
        ("[fd00::1]", False),
        ("localhost", False),
    ],
)
def test_an_endpointslice_accepts_the_address_of_a_master(host: str, good: bool) -> None:
    pool = changed(GOOD, {"spec.master": {**MASTER, "host": host}})
    if good:
        assert FiberPool.read(pool).spec.master is not None
    else:
        with pytest.raises(InvalidPool, match=r"spec\.master\.host: must be an IP address"):
            FiberPool.read(pool)
