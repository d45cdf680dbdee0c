"""Faults that a test can bring about, and undo: cut cables, and daemons that are gone."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from cluster import control_plane, filters, network, places
from cluster.containerd import Containerd
from cluster.daemons import all_daemons
from cluster.filters import Allowed
from cluster.shell import ClusterError

APISERVER = "apiserver"


def cut(node: str) -> None:
    """Disconnect a node: it keeps running, and no packet reaches or leaves it."""
    network.set_cable(_index(node), up=False)


def restore(node: str) -> None:
    """Plug a node in again."""
    network.set_cable(_index(node), up=True)


@contextmanager
def cut_off(node: str) -> Iterator[None]:
    """The node is cut off meanwhile."""
    cut(node)
    try:
        yield
    finally:
        restore(node)


@contextmanager
def closed(node: str) -> Iterator[Callable[[Allowed], None]]:
    """Drop all packets from and to the node's pods meanwhile, except those allowed.

    Connections that there are go on.
    """
    index = _index(node)
    filters.close(index)
    try:
        yield lambda allowed: filters.allow(index, allowed)
    finally:
        filters.reopen(index)


def stop(name: str) -> None:
    """Kill a daemon, such as apiserver or node-2-kubelet, at once and without farewell."""
    known = {daemon.name: daemon for daemon in all_daemons()}
    if name not in known:
        raise ClusterError(f"there is no daemon {name}; there are: {', '.join(known)}")
    known[name].kill()


def start(name: str) -> None:
    """Start a daemon again that was stopped; returns for the API server once it answers."""
    for daemon in all_daemons():
        if daemon.name == name:
            daemon.start_again()
    if name == APISERVER:
        control_plane.wait_for_apiserver()


@contextmanager
def stopped(name: str) -> Iterator[None]:
    """The daemon does not run meanwhile."""
    try:
        stop(name)
        yield
    finally:
        start(name)


def kill_container(node: str, container: str) -> None:
    """Kill a container, by its id, at once and without farewell."""
    Containerd(_index(node)).kill(container)


def _index(node: str) -> int:
    found = re.fullmatch(r"node-(\d+)", node)
    if found is None or int(found[1]) not in places.nodes():
        names = ", ".join(map(places.node_name, places.nodes())) or "none, the cluster is down"
        raise ClusterError(f"there is no node {node}; there are: {names}")
    return int(found[1])
