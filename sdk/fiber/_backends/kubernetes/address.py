"""The address of this machine that pods can reach, found without asking anybody to connect."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterator

from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.api_errors import ApiError
from fiber._backends.kubernetes.resources import NODES
from fiber.errors import ConfigError, FiberPoolError

_NODES = 10
"""Nodes that are looked at: the way to one is mostly the way to all."""

_ELSEWHERE = ("192.0.2.1", "2001:db8::1")
"""Addresses that are nobody's (RFC 5737, RFC 3849): the way to them is the default route."""


def reachable_address(api: Api, listen_host: str | None, *, pool: str, namespace: str) -> str:
    """The IP address that pods reach this program at.

    ``listen_host``, if it names one.  Else the local address on the way to the cluster's nodes, to
    its API server, or out of this machine: of these the first that is no loopback.  In a pod that
    is the pod's.  FiberPoolError if all are.
    """
    if listen_host is not None and not _is_unspecified(listen_host):
        return resolved("listen_host", listen_host)
    for target in _targets(api):
        found = _local_address(target)
        if found is not None and _is_reachable(found):
            return found
    raise FiberPoolError(
        f"pods cannot reach this program: the only address of this machine on the way to the "
        f"cluster at {api.server} is a loopback. Set listen_host (fiber.init(listen_host=) or "
        "FIBER_LISTEN_HOST) to an address of this machine that pods can reach, run the program in "
        "a pod, or set advertised_host too where pods reach this machine at another address",
        pool=pool,
        namespace=namespace,
        reason="NoAddress",
    )


def _targets(api: Api) -> Iterator[str]:
    if not api.in_cluster:
        yield from _node_addresses(api)
    yield api.server
    yield from _ELSEWHERE


def _node_addresses(api: Api) -> Iterator[str]:
    try:
        nodes = api.list(NODES.path(), {"limit": str(_NODES)}, timeout=0.0)["items"]
    except ApiError:
        return  # few may list them; whoever else cannot be reached is told by the next call
    for node in nodes:
        for address in node.get("status", {}).get("addresses", ()):
            if address.get("type") == "InternalIP":
                yield address["address"]


def _local_address(target: str) -> str | None:
    """Return the address that this machine would send from.  Nothing is sent."""
    try:
        family, kind, _, _, where = socket.getaddrinfo(target, 9, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind) as probe:
            probe.connect(where)
            return str(probe.getsockname()[0])
    except OSError:
        return None  # no such name, or no way there


def resolved(key: str, host: str) -> str:
    """Return the IP address of ``host``, the value of the configuration's ``key``, for pods."""
    try:
        found = str(socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][4][0])
    except OSError as error:
        raise _useless(key, host, f"has no address ({error})") from error
    if not _is_reachable(found):
        raise _useless(key, host, f"is {found}, which is another machine in each pod")
    return found


def _useless(key: str, host: str, why: str) -> ConfigError:
    return ConfigError(
        f"pods cannot reach this program: {key} {host!r} {why}. Set it to an address of this "
        "machine that pods can reach, or leave it out. Behind NAT or port forwarding, set "
        "advertised_host to the address that pods dial"
    )


def _is_unspecified(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return False


def _is_reachable(host: str) -> bool:
    address = ipaddress.ip_address(host.partition("%")[0])
    return not (address.is_loopback or address.is_link_local or address.is_unspecified)
