"""A laptop: a network namespace that reaches the API server, and that no pod reaches.

    laptop 10.99.0.2 ── veth ── 10.99.0.1 root namespace 172.30.0.1   apiserver

The rules of the cluster's bridge refuse packets of pods to any other network, as a router with NAT
does.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from cluster.shell import output, succeeds

NAMESPACE = "fiber-laptop"
_CABLE = "fvlaptop"
_NETWORKS = ("10.99.0", "10.99.1")
"""Networks that the laptop may be in; each has the gateway .1 and the laptop .2."""


class Laptop:
    """Laptop that is plugged in."""

    command = ("ip", "netns", "exec", NAMESPACE)
    """Words before a command that runs on the laptop."""

    def __init__(self) -> None:
        self._network = 0

    @contextmanager
    def unplugged(self) -> Iterator[None]:
        """Reach nothing meanwhile."""
        output("ip", "link", "set", _CABLE, "down")
        try:
            yield
        finally:
            output("ip", "link", "set", _CABLE, "up")
            self._route()

    def move(self) -> None:
        """Change the laptop's address, as in another network."""
        self._network = 1 - self._network
        self._inside("ip", "addr", "flush", "dev", "eth0")
        self._inside("ip", "addr", "add", f"{_NETWORKS[self._network]}.2/24", "dev", "eth0")
        self._route()

    def _route(self) -> None:
        gateway = f"{_NETWORKS[self._network]}.1"
        self._inside("ip", "route", "replace", "default", "via", gateway)

    def _inside(self, *command: str) -> None:
        output(*self.command, *command)


@contextmanager
def plugged_in() -> Iterator[Laptop]:
    """Make the laptop, and remove it at the end."""
    _remove()
    output("ip", "netns", "add", NAMESPACE)
    try:
        output(
            "ip", "link", "add", _CABLE, "type", "veth", "peer", "name", "eth0", "netns", NAMESPACE
        )
        for network in _NETWORKS:
            output("ip", "addr", "add", f"{network}.1/24", "dev", _CABLE)
        output("ip", "link", "set", _CABLE, "up")
        laptop = Laptop()
        output(*laptop.command, "ip", "link", "set", "lo", "up")
        output(*laptop.command, "ip", "link", "set", "eth0", "up")
        laptop.move()
        yield laptop
    finally:
        _remove()


def _remove() -> None:
    succeeds("ip", "netns", "delete", NAMESPACE)
    succeeds("ip", "link", "delete", _CABLE)
