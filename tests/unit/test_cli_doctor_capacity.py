"""Room for a worker, as ``fiber doctor`` computes it from quotas, limit ranges and nodes."""

from __future__ import annotations

from decimal import Decimal
from typing import Any

import pytest

from fiber._cli.doctor_capacity import amount, containers_of, refusing_quota, refusing_range, room
from fiber._cli.doctor_verdicts import fault, lines_of
from fiber_api import names

Body = dict[str, Any]


def template(**spec: Any) -> Body:
    requests = {"cpu": "500m", "memory": "64Mi"}
    worker = {"name": names.WORKER_CONTAINER, "resources": {"requests": requests}}
    return {"spec": {"containers": [worker], **spec}}


def node(name: str = "a", labels: Body | None = None, **spec: Any) -> Body:
    return {
        "metadata": {"name": name, "labels": labels or {}},
        "spec": spec,
        "status": {"allocatable": {"cpu": "1", "memory": "1Gi", "pods": "2"}},
    }


def pod(cpu: str, phase: str = "Running") -> Body:
    container = {"resources": {"requests": {"cpu": cpu}}}
    spec = {"nodeName": "a", "containers": [container]}
    return {"spec": spec, "status": {"phase": phase}}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("500m", "0.5"),
        ("2", "2"),
        ("1.5", "1.5"),
        ("8Ki", "8192"),
        ("1k", "1000"),
        ("1e3", "1000"),
        ("2Gi", "2147483648"),
        (3, "3"),
        ("many", "0"),
        ("1.2.3", "0"),
        ("1mi", "0"),
    ],
)
def test_quantities(text: object, value: str) -> None:
    assert amount(text) == Decimal(value)


def test_a_limit_is_also_a_request_and_defaults_fill_the_rest() -> None:
    limits = {"resources": {"limits": {"cpu": "2"}}}
    item = {"type": "Container", "default": {"cpu": "4", "memory": "1Gi"}}
    (found,) = containers_of({"spec": {"containers": [limits]}}, [{"spec": {"limits": [item]}}])
    assert found.requests == {"cpu": 2}
    assert found.limits == {"cpu": 2, "memory": 2**30}


@pytest.mark.parametrize(
    ("hard", "used", "refuses"),
    [
        ({"pods": "3"}, {"pods": "2"}, False),
        ({"pods": "3"}, {"pods": "3"}, True),
        ({"cpu": "1"}, {"cpu": "500m"}, False),
        ({"requests.cpu": "1"}, {"requests.cpu": "600m"}, True),
        ({"limits.memory": "1Gi"}, {}, True),
        ({"requests.nvidia.com/gpu": "0"}, {}, False),
        ({f"count/{names.CRD_NAME}": "1"}, {f"count/{names.CRD_NAME}": "1"}, True),
        ({"count/configmaps": "0"}, {}, False),
    ],
)
def test_quotas(hard: Body, used: Body, refuses: bool) -> None:
    quota = {"metadata": {"name": "q"}, "status": {"hard": hard, "used": used}}
    assert bool(refusing_quota([quota], template(), [])) is refuses
    scoped = {**quota, "spec": {"scopes": ["BestEffort"]}}
    assert not refusing_quota([scoped], template(), [])


@pytest.mark.parametrize(
    ("item", "refuses"),
    [
        ({"type": "Container", "max": {"memory": "64Mi"}}, False),
        ({"type": "Container", "max": {"memory": "63Mi"}}, True),
        ({"type": "Pod", "max": {"cpu": "100m"}}, True),
        ({"type": "Pod", "min": {"cpu": "1"}}, True),
        ({"type": "PersistentVolumeClaim", "max": {"cpu": "100m"}}, False),
    ],
)
def test_limit_ranges(item: Body, refuses: bool) -> None:
    found = {"metadata": {"name": "r"}, "spec": {"limits": [item]}}
    assert bool(refusing_range([found], template())) is refuses


@pytest.mark.parametrize(
    ("pods", "fit"),
    [
        ([pod("500m")], 1),
        ([pod("600m")], 0),
        ([pod("600m", "Succeeded")], 1),
        ([pod("1m"), pod("1m")], 0),
    ],
)
def test_what_pods_request_is_not_free(pods: list[Body], fit: int) -> None:
    assert room([node()], pods, template(), []).fit == fit


TAINT = {"key": "team", "value": "a", "effect": "NoSchedule"}


@pytest.mark.parametrize(
    ("found", "spec", "fit"),
    [
        (node(unschedulable=True), {}, 0),
        (node(taints=[TAINT]), {}, 0),
        (node(taints=[{**TAINT, "effect": "PreferNoSchedule"}]), {}, 1),
        (node(taints=[TAINT]), {"tolerations": [{"key": "team", "value": "a"}]}, 1),
        (node(taints=[TAINT]), {"tolerations": [{"key": "team", "value": "b"}]}, 0),
        (node(taints=[TAINT]), {"tolerations": [{"operator": "Exists"}]}, 1),
        (
            node(taints=[TAINT]),
            {"tolerations": [{"key": "team", "operator": "Exists", "effect": "NoExecute"}]},
            0,
        ),
        (node(), {"nodeSelector": {"disk": "ssd"}}, 0),
        (node(labels={"disk": "ssd"}), {"nodeSelector": {"disk": "ssd"}}, 1),
    ],
)
def test_nodes_that_take_no_such_pod(found: Body, spec: Body, fit: int) -> None:
    assert room([found], [], template(**spec), []).fit == fit


def test_a_node_that_is_not_ready_has_no_room() -> None:
    lost = node()
    lost["status"]["conditions"] = [{"type": "Ready", "status": "Unknown"}]
    found = room([lost, node("b")], [], template(), [])
    assert (found.nodes, found.fit, found.why) == (2, 1, "1 are not ready")


def test_faults_with_one_remedy_have_it_once() -> None:
    one, two = (fault(what, "why", "do")._replace(check="rights") for what in ("one", "two"))
    other = one._replace(do="other")
    assert list(lines_of([one, two, other])) == [
        "✗ rights: one",
        "✗ rights: two",
        "    why:  why",
        "    do:   do",
        "✗ rights: one",
        "    why:  why",
        "    do:   other",
    ]
