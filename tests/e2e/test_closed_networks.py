"""Workers whose network is closed, as the chart's NetworkPolicy for them says."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from urllib.parse import urlsplit

import pytest
import yaml

from cluster.filters import Allowed
from e2e.clusters import Cluster
from e2e.kube import Body, path_of
from e2e.leftovers import leaves_nothing
from e2e.program import Programs
from e2e.release import Release
from e2e.scene import Scene

pytestmark = pytest.mark.timeout(240, func_only=True)

PORT = 29100
SAME_NAMESPACE: Body = {"podSelector": {}}


@pytest.mark.parametrize("place", ["inside", pytest.param("outside", marks=pytest.mark.long)])
def test_workers_reach_only_their_program(
    place: str, programs: Programs, scene: Scene, cluster: Cluster, release: Release
) -> None:
    operator = release.pod()
    programs.node = operator["spec"]["nodeName"]  # the other node is the workers'
    (node, *_) = (name for name in cluster.workers() if name != programs.node)
    targets = [metrics_of(operator), *api_servers(scene, cluster)]
    settings = {
        "listen_port": PORT,
        "node_selector": f"kubernetes.io/hostname={node}",
    }
    program = programs.start(place, "closing.py", *targets, **settings)
    assert program.says("open")["reached"] == targets
    (pool,) = scene.now["fiberpools"].values()
    host = f"{pool['spec']['master']['host']}/32"
    peer = SAME_NAMESPACE if place == "inside" else {"ipBlock": {"cidr": host}}
    policy = workers_policy(release, scene.namespace, peer)
    scene.kube.create(path_of("networkpolicies", scene.namespace), policy)
    with cluster.closed(node) as allow:
        for packets in egress(policy, {str(SAME_NAMESPACE): host}):
            allow(packets)
        assert program.says("closed", seconds=90)["reached"] == []
        program.says("done", seconds=90)
        program.ends()
        leaves_nothing(program)


def metrics_of(operator: Body) -> str:
    """Return where a pod listens to everybody."""
    (port,) = operator["spec"]["containers"][0]["ports"]
    return f"{operator['status']['podIP']}:{port['containerPort']}"


def api_servers(scene: Scene, cluster: Cluster) -> Iterator[str]:
    """Yield where pods have the API server, and where it is."""
    service = scene.kube.get(path_of("services", "default", "kubernetes"))
    assert service is not None
    yield f"{service['spec']['clusterIP']}:{service['spec']['ports'][0]['port']}"
    view = ("config", "view", "--minify", "--output=jsonpath={.clusters[0].cluster.server}")
    yield urlsplit(cluster.kubectl(*view)).netloc


def workers_policy(release: Release, namespace: str, master: Body) -> Body:
    """Return the chart's policy for the workers of a namespace, with masters there."""
    values = {
        "create": True,
        "namespaces": [namespace],
        "masters": [master],
        "masterPorts": [PORT],
    }
    manifests = yaml.safe_load_all(release.render({"workerNetworkPolicy": values}))
    (policy,) = (found for found in manifests if found and found["kind"] == "NetworkPolicy")
    return dict(policy)


def egress(policy: Body, peers: Mapping[str, str]) -> Iterator[Allowed]:
    """Yield what the policy lets out; ``peers`` has the addresses of pods that it selects."""
    assert policy["spec"]["policyTypes"] == ["Ingress", "Egress"]
    assert "ingress" not in policy["spec"]
    for rule in policy["spec"]["egress"]:
        for peer in rule.get("to", [{"ipBlock": {"cidr": "0.0.0.0/0"}}]):
            address = peer["ipBlock"]["cidr"] if "ipBlock" in peer else peers[str(peer)]
            for port in rule["ports"]:
                yield Allowed(address, port["protocol"].lower(), port["port"])
