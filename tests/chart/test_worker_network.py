"""The policies that close the network of workers and of relays."""

from __future__ import annotations

from typing import Any

import pytest

from chart.helm import Helm, Refused
from fiber_api import names
from fiber_operator.planning import podspec, relay
from unit.operator_objects import ADDRESS, MASTER, make_pool


def policies(helm: Helm, **values: Any) -> dict[str, dict[str, Any]]:
    """Return the policies' specs by the ends of their names: ``workers`` and ``relays``."""
    given = {"create": True, "namespaces": ["lab"], **values}
    manifests = helm.render({"workerNetworkPolicy": given})
    found = [m["metadata"] | m["spec"] for m in manifests if m["kind"] == "NetworkPolicy"]
    assert {one["namespace"] for one in found} == {"lab"}
    return {one["name"].rpartition("-")[2]: one for one in found}


def policy(helm: Helm, **values: Any) -> dict[str, Any]:
    return policies(helm, **values)["workers"]


def relays_pod() -> dict[str, Any]:
    """Return the relay's pod as its Deployment makes it."""
    body = relay.deployment(make_pool(relay=True, master=MASTER))
    return dict(body["spec"]["template"])


def chosen(peer: dict[str, Any], pod: dict[str, Any]) -> bool:
    """Return True if a peer or policy selects the pod by the presence of a label."""
    (label,) = peer["podSelector"]["matchExpressions"]
    assert label["operator"] == "Exists"
    return label["key"] in pod["metadata"]["labels"]


def test_the_policy_closes_the_pods_of_workers(helm: Helm) -> None:
    spec = policy(helm)
    (label,) = spec["podSelector"]["matchExpressions"]
    assert label == {"key": names.LABEL_POOL_UID, "operator": "Exists"}
    assert spec["policyTypes"] == ["Ingress", "Egress"]


def test_workers_reach_each_other_at_the_port_for_large_blobs(helm: Helm) -> None:
    worker = podspec.pod(make_pool(), "es-1", ADDRESS)
    spec = policy(helm)
    (rule,) = spec["ingress"]
    for peers, ports in (
        (rule["from"], rule["ports"]),
        (spec["egress"][2]["to"], spec["egress"][2]["ports"]),
    ):
        (peer,) = peers
        assert chosen(peer, worker)
        assert not chosen(peer, relays_pod())
        assert ports == [{"port": names.PEER_PORT, "protocol": "TCP"}]


def test_workers_reach_their_master_relays_and_dns(helm: Helm) -> None:
    master, relays, _, dns = policy(helm, masterPorts=[4000])["egress"]
    assert master == {"to": [{"podSelector": {}}], "ports": [{"port": 4000, "protocol": "TCP"}]}
    (peer,) = relays["to"]
    assert chosen(peer, relays_pod())
    assert relays["ports"] == [{"port": names.MASTER_PORT, "protocol": "TCP"}]
    assert {port["port"] for port in dns["ports"]} == {53}
    assert "ports" not in policy(helm)["egress"][0]


def test_relays_accept_workers_and_connect_to_nothing(helm: Helm) -> None:
    both = policies(helm)
    assert sorted(both) == ["relays", "workers"]
    spec, pod = both["relays"], relays_pod()
    assert chosen(spec, pod)
    assert not chosen(both["workers"], pod)
    assert spec["policyTypes"] == ["Ingress", "Egress"]
    assert "egress" not in spec
    (rule,) = spec["ingress"]
    (peer,) = rule["from"]
    assert chosen(peer, worker := podspec.pod(make_pool(), "es-1", ADDRESS))
    assert not chosen(spec, worker)
    (port,) = rule["ports"]
    (container,) = pod["spec"]["containers"]
    assert [port["port"]] == [p["containerPort"] for p in container["ports"]]


def test_with_scope_cluster_the_namespaces_are_named(helm: Helm) -> None:
    with pytest.raises(Refused, match="Name the namespaces of the pools"):
        helm.render({"workerNetworkPolicy": {"create": True}})
