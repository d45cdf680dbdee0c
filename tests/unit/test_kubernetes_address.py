"""The address that pods reach a program at."""

from __future__ import annotations

import socket
from typing import Any

import pytest

from fiber._backends.kubernetes import provisioner
from fiber._backends.kubernetes.provisioner import reachable_address, resolved
from fiber.errors import ConfigError, FiberPoolError
from fiber_api.rest import Forbidden


class Cluster:
    """Stand-in for an Api as ``reachable_address`` uses it, and the routes of this machine."""

    def __init__(self) -> None:
        self.in_cluster = False
        self.server = "127.0.0.1"
        self.nodes: list[str] | None = None
        self.ways: dict[str, str] = {}
        self.asked = 0

    def list(self, path: str, selector: object, timeout: float) -> dict[str, Any]:
        assert path == "/api/v1/nodes"
        self.asked += 1
        if self.nodes is None:
            raise Forbidden("nodes is forbidden")
        hostname = {"type": "Hostname", "address": "n"}
        return {
            "items": [
                {"status": {"addresses": [hostname, {"type": "InternalIP", "address": node}]}}
                for node in self.nodes
            ]
        }

    def found(self, listen_host: str | None = None) -> str:
        api: Any = self
        return reachable_address(api, listen_host, pool="es-1", namespace="lab")


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Cluster:
    made = Cluster()
    monkeypatch.setattr(provisioner, "_local_address", made.ways.get)
    return made


def test_the_configured_address_wins(cluster: Cluster) -> None:
    assert cluster.found("192.168.1.5") == "192.168.1.5"
    assert cluster.asked == 0


def test_a_configured_name_becomes_the_address_that_a_pool_takes(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("192.168.1.5", 0))]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    assert cluster.found("laptop.example") == "192.168.1.5"


def test_a_configured_name_without_an_address_is_an_error(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(socket, "getaddrinfo", nobody)
    with pytest.raises(ConfigError, match="listen_host 'nobody' has no address"):
        cluster.found("nobody")


@pytest.mark.parametrize("loopback", ["127.0.0.1", "::1", "localhost"])
def test_a_configured_loopback(cluster: Cluster, loopback: str) -> None:
    with pytest.raises(ConfigError, match="another machine in each pod"):
        cluster.found(loopback)


def test_an_advertised_loopback_is_an_error_that_names_the_key() -> None:
    with pytest.raises(ConfigError, match=r"advertised_host '127\.0\.0\.1' is 127\.0\.0\.1"):
        resolved("advertised_host", "127.0.0.1")


def nobody(*_: object, **__: object) -> None:
    raise socket.gaierror(-2, "Name or service not known")


@pytest.mark.parametrize("listen_host", [None, "0.0.0.0", "::"])
def test_the_way_to_the_nodes(cluster: Cluster, listen_host: str | None) -> None:
    cluster.nodes = ["172.30.0.2", "172.30.0.3"]
    cluster.ways |= {"172.30.0.3": "172.30.0.1", "127.0.0.1": "127.0.0.1"}
    assert cluster.found(listen_host) == "172.30.0.1"


def test_without_the_right_to_list_nodes_the_address_toward_the_api_server_is_used(
    cluster: Cluster,
) -> None:
    cluster.server = "api.example"
    cluster.ways["api.example"] = "10.1.2.3"
    assert cluster.found() == "10.1.2.3"


def test_a_program_in_a_pod_uses_the_pods_address_without_a_call(cluster: Cluster) -> None:
    cluster.in_cluster, cluster.server = True, "10.96.0.1"
    cluster.ways["10.96.0.1"] = "10.244.0.9"
    assert cluster.found() == "10.244.0.9"
    assert cluster.asked == 0


def test_the_way_out_where_the_api_server_is_a_loopback(cluster: Cluster) -> None:
    cluster.ways |= {"127.0.0.1": "127.0.0.1", "192.0.2.1": "192.168.1.5"}
    assert cluster.found() == "192.168.1.5"


@pytest.mark.parametrize("useless", ["127.0.0.1", "::1", "fe80::1%eth0", "169.254.3.4"])
def test_a_loopback_address_is_refused_with_advice(cluster: Cluster, useless: str) -> None:
    cluster.ways |= {"127.0.0.1": useless, "192.0.2.1": useless}
    with pytest.raises(FiberPoolError, match="FIBER_LISTEN_HOST") as caught:
        cluster.found()
    assert (caught.value.reason, caught.value.pool) == ("NoAddress", "es-1")


def test_the_way_to_this_machine_is_a_loopback() -> None:
    assert provisioner._local_address("127.0.0.1") == "127.0.0.1"


def test_an_unknown_name_has_no_local_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "getaddrinfo", nobody)
    assert provisioner._local_address("nobody") is None
