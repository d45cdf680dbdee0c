"""The policy that closes the network of workers."""

from __future__ import annotations

from typing import Any

import pytest

from chart.helm import Helm, Refused
from fiber_api import names


def policy(helm: Helm, **values: Any) -> dict[str, Any]:
    given = {"create": True, "namespaces": ["lab"], **values}
    manifests = helm.render({"workerNetworkPolicy": given})
    found = [m for m in manifests if m["kind"] == "NetworkPolicy"]
    assert [m["metadata"]["namespace"] for m in found] == given["namespaces"]
    return dict(found[0]["spec"])


def test_the_policy_closes_the_pods_of_workers(helm: Helm) -> None:
    spec = policy(helm)
    (label,) = spec["podSelector"]["matchExpressions"]
    assert label == {"key": names.LABEL_POOL_UID, "operator": "Exists"}
    assert spec["policyTypes"] == ["Ingress", "Egress"]
    assert "ingress" not in spec


def test_workers_reach_their_master_and_dns(helm: Helm) -> None:
    master, dns = policy(helm, masterPorts=[4000])["egress"]
    assert master == {"to": [{"podSelector": {}}], "ports": [{"port": 4000, "protocol": "TCP"}]}
    assert {port["port"] for port in dns["ports"]} == {53}
    assert "ports" not in policy(helm)["egress"][0]


def test_with_scope_cluster_the_namespaces_are_named(helm: Helm) -> None:
    with pytest.raises(Refused, match="Name the namespaces of the pools"):
        helm.render({"workerNetworkPolicy": {"create": True}})
