"""Revisions of the pods of a pool."""

from __future__ import annotations

from typing import Any

import pytest

from fiber_operator.planning.manifests import spec_hash, template_hash
from unit.operator_objects import MASTER, make_pool

TEMPLATE = {
    "metadata": {"labels": {"team": "research"}, "annotations": {"note": "naïve"}},
    "spec": {
        "containers": [
            {
                "name": "worker",
                "image": "registry/worker:1",
                "env": [{"name": "OMP_NUM_THREADS", "value": "4"}],
                "resources": {"limits": {"memory": "16Gi", "nvidia.com/gpu": 1}},
            }
        ],
        "terminationGracePeriodSeconds": 30,
        "hostNetwork": False,
    },
}


def test_the_hash_of_a_template_is_stable() -> None:
    """Pods carry it as a label, and one that differs is that of an older template.

    If this fails, the change that made it fail restarts every worker of every pool when its
    operator is installed.  Correct that, not the number.
    """
    assert template_hash(make_pool(template=TEMPLATE)) == "869ab9037e805d3a"
    assert template_hash(make_pool(template=TEMPLATE, processesPerPod=8)) == "501ba82f4f5d6c63"
    reordered = {name: TEMPLATE[name] for name in reversed(TEMPLATE)}
    assert template_hash(make_pool(template=reordered)) == "869ab9037e805d3a"


@pytest.mark.parametrize(
    "spec",
    [
        {"replicas": 9, "minReplicas": 1, "maxReplicas": 99},
        {"master": MASTER, "scaleDown": {"release": ["es-0000000001"], "policy": "Any"}},
        {"suspend": True, "scaleUp": {"maxInFlight": 1}},
        {"failurePolicy": {"backoffLimit": 1}, "update": {"strategy": "OnDelete"}},
    ],
)
def test_only_the_template_makes_pods_outdated(spec: dict[str, Any]) -> None:
    assert template_hash(make_pool(**spec)) == template_hash(make_pool())


@pytest.mark.parametrize(
    ("spec", "anew"),
    [
        (
            {"replicas": 9, "minReplicas": 1, "maxReplicas": 99, "scaleUp": {"maxInFlight": 1}},
            False,
        ),
        ({"scaleDown": {"release": ["es-0000000001"], "policy": "Any"}}, False),
        ({"template": TEMPLATE}, True),
        ({"processesPerPod": 2}, True),
        ({"failurePolicy": {"backoffLimit": 1}}, True),
        ({"update": {"strategy": "OnDelete"}}, True),
        ({"suspend": True}, True),
        ({"master": MASTER}, True),
    ],
)
def test_changes_of_the_template_or_policy_change_the_spec_hash(
    spec: dict[str, Any], anew: bool
) -> None:
    assert (spec_hash(make_pool(**spec)) != spec_hash(make_pool())) is anew


def test_another_address_of_the_same_master_is_no_new_beginning() -> None:
    one, other = (make_pool(master={**MASTER, "port": port}) for port in (1, 2))
    assert spec_hash(one) == spec_hash(other)
