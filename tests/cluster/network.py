"""The cables: one bridge, and for each node a network namespace that is plugged into it.

    root namespace             172.30.0.1   etcd, apiserver, controller-manager, scheduler, tests
      bridge fbr0 ─┬─ node-1   172.30.0.11  containerd, kubelet, kube-proxy; pods 10.244.1.0/24
                   └─ node-2   172.30.0.12  containerd, kubelet, kube-proxy; pods 10.244.2.0/24

Pods of different nodes therefore cross a network that can be cut. The root namespace has routes
to them, and they reach it at 172.30.0.1.
"""

from __future__ import annotations

from pathlib import Path

from cluster import places
from cluster.shell import output, succeeds

_IFF_UP = 1
_FORWARD = Path("/proc/sys/net/ipv4/ip_forward")


def connect(count: int) -> None:
    """Make the bridge and connect this many nodes; use those that exist."""
    if not _has_link(places.BRIDGE):
        output("ip", "link", "add", places.BRIDGE, "type", "bridge")
        output("ip", "addr", "add", f"{places.HOST_IP}/24", "dev", places.BRIDGE)
    output("ip", "link", "set", places.BRIDGE, "up")
    _FORWARD.write_text("1")
    if not succeeds(*_firewall("--check")):
        output(*_firewall("--insert"))
    for index in range(1, count + 1):
        if places.namespace(index) not in namespaces():
            _plug_in(index)
        set_cable(index, up=True)
    for index in range(1, count + 1):
        _route_pods(index, count)


def _firewall(action: str) -> tuple[str, ...]:
    """Add or remove the rules that refuse all packets out of the cluster.

    Nothing out there would find a way back to our addresses: a registry, or the server that knows
    its name, would be waited for until a limit of time is over.
    """
    outwards = ("--in-interface", places.BRIDGE, "!", "--out-interface", places.BRIDGE)
    refuse = ("--jump", "REJECT", "--reject-with", "icmp-admin-prohibited")
    return ("iptables", "--wait", action, "FORWARD", *outwards, *refuse)


def _plug_in(index: int) -> None:
    name, cable = places.namespace(index), places.link(index)
    output("ip", "netns", "add", name)
    output("ip", "link", "add", cable, "type", "veth", "peer", "name", "eth0", "netns", name)
    output("ip", "link", "set", cable, "master", places.BRIDGE)
    inside(index, "ip", "link", "set", "lo", "up")
    inside(index, "ip", "addr", "add", f"{places.node_ip(index)}/24", "dev", "eth0")
    inside(index, "ip", "link", "set", "eth0", "up")
    inside(index, "ip", "route", "add", "default", "via", places.HOST_IP)
    inside(index, "sh", "-c", f"echo 1 > {_FORWARD}")


def _route_pods(index: int, count: int) -> None:
    route = ("ip", "route", "replace", places.pod_range(index), "via", places.node_ip(index))
    output(*route)
    for other in range(1, count + 1):
        if other != index:
            inside(other, *route)


def set_cable(index: int, *, up: bool) -> None:
    """Pull the plug of a node, or push it in again."""
    output("ip", "link", "set", places.link(index), "up" if up else "down")


def is_plugged_in(index: int) -> bool:
    """Return whether packets reach the node and leave it."""
    try:
        flags = Path("/sys/class/net", places.link(index), "flags").read_text()
    except OSError:
        return False
    return bool(int(flags, 16) & _IFF_UP)


def remove() -> None:
    """Remove every namespace of a node, and the bridge, if they exist."""
    for cable in Path("/sys/class/net").glob(places.link_prefix() + "*"):
        # A namespace ends some time after its name; its cable must not be there when it comes back.
        output("ip", "link", "delete", cable.name, check=False)
    for name in namespaces():
        output("ip", "netns", "delete", name, check=False)
    if _has_link(places.BRIDGE):
        output("ip", "link", "delete", places.BRIDGE, check=False)
    output(*_firewall("--delete"), check=False)


def namespaces() -> list[str]:
    """The network namespaces of our nodes."""
    lines = output("ip", "netns", "list").splitlines()
    return [line.split()[0] for line in lines if line.startswith(places.namespace_prefix())]


def is_there(count: int) -> bool:
    """Return whether the bridge and the namespaces of this many nodes exist."""
    wanted = {places.namespace(index) for index in range(1, count + 1)}
    return _has_link(places.BRIDGE) and wanted <= set(namespaces())


def _has_link(name: str) -> bool:
    return Path("/sys/class/net", name).exists()


def inside(index: int, *command: str, check: bool = True) -> None:
    """Run a command in the network namespace of a node."""
    output("nsenter", f"--net=/run/netns/{places.namespace(index)}", "--", *command, check=check)
