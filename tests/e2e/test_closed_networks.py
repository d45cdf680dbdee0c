"""Closed networks: only traffic that the chart and docs/administrators.md ask for passes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from urllib.parse import urlsplit

import pytest
import yaml

from cluster.filters import Allowed
from e2e.clusters import Cluster
from e2e.cordons import cordoned
from e2e.kube import Body, path_of
from e2e.leftovers import leaves_nothing
from e2e.program import Programs
from e2e.release import Release
from e2e.scene import Scene
from fiber_api import names

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
    servers = list(api_servers(scene, cluster))
    targets = [metrics_of(operator), *servers]
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
    (incoming,) = policy["spec"]["ingress"]
    assert [port["port"] for port in incoming["ports"]] == [names.PEER_PORT]
    with ExitStack() as closed:
        if place == "inside":
            ports = [int(server.rpartition(":")[2]) for server in servers]
            passing = [*operator_egress(release, ports), *program_traffic(host, ports)]
            release.note_refusals()  # reads metrics, which a closed network prevents
            closed.enter_context(open_only_to(passing, cluster, programs.node))
            restart_operator(release, scene, cluster)
        passing = [*egress(policy, {str(SAME_NAMESPACE): host})]
        closed.enter_context(open_only_to(passing, cluster, node))
        program.says("closed", seconds=90)
        program.says("done", seconds=90)
        program.ends()
        leaves_nothing(program)


@contextmanager
def open_only_to(passing: Iterable[Allowed], cluster: Cluster, node: str) -> Iterator[None]:
    """Close the node meanwhile; of new connections of its pods only these pass."""
    with cluster.closed(node) as allow:
        for packets in passing:
            allow(packets)
        yield


def restart_operator(release: Release, scene: Scene, cluster: Cluster) -> None:
    """Have an operator on the same node all of whose connections are new."""
    node = release.pod()["spec"]["nodeName"]
    others = [name for name in cluster.workers() if name != node]
    with cordoned(scene.kube, *others):
        release.scale(0)
        release.wait("no operator", lambda: not release.pods())
        release.start()


def operator_egress(release: Release, ports: Sequence[int]) -> Iterator[Allowed]:
    """Yield the traffic that the chart's policy lets out of the operator's pod."""
    values = {"networkPolicy": {"create": True, "apiServer": {"ports": list(ports)}}}
    return egress(rendered_policy(release, values), {})


def program_traffic(host: str, ports: Sequence[int]) -> Iterator[Allowed]:
    """Yield what docs/administrators.md asks for: the API server, workers at the listen_port."""
    yield Allowed(host, "tcp", PORT)
    for port in ports:
        yield Allowed(protocol="tcp", port=port)


def metrics_of(operator: Body) -> str:
    """Return the ports at which a pod accepts connections from any address."""
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
    return rendered_policy(release, {"workerNetworkPolicy": values})


def rendered_policy(release: Release, values: Body) -> Body:
    """Return the chart's only policy that is not about relays."""
    manifests = yaml.safe_load_all(release.render(values))
    policies = [found for found in manifests if found and found["kind"] == "NetworkPolicy"]
    (policy,) = (one for one in policies if not one["metadata"]["name"].endswith("-relays"))
    return dict(policy)


def egress(policy: Body, peers: Mapping[str, str]) -> Iterator[Allowed]:
    """Yield the traffic that the policy lets out; ``peers`` has the addresses of selected pods.

    Pods that are not in ``peers``, such as relays, do not exist here.
    """
    assert policy["spec"]["policyTypes"] == ["Ingress", "Egress"]
    for rule in policy["spec"]["egress"]:
        for peer in rule.get("to", [{"ipBlock": {"cidr": "0.0.0.0/0"}}]):
            if "ipBlock" not in peer and str(peer) not in peers:
                continue
            address = peer["ipBlock"]["cidr"] if "ipBlock" in peer else peers[str(peer)]
            for port in rule["ports"]:
                yield Allowed(address, port["protocol"].lower(), port["port"])
