"""The cluster as a whole: brought up, found again, repaired, taken down."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from cluster import (
    build,
    control_plane,
    diagnosis,
    fake_nodes,
    filters,
    network,
    packages,
    places,
    remains,
)
from cluster.daemons import Daemon, all_daemons
from cluster.kubectl import answer_of, ready_nodes
from cluster.node import Node
from cluster.pause import pause_archive
from cluster.pki import Pki
from cluster.shell import ClusterError, locked, need_root, say, wait_for

_WHY = (  # each node's own word on whether it is Ready
    "--output=jsonpath={range .items[*]}{.metadata.name}: "
    '{.status.conditions[?(@.type=="Ready")].message}{"\\n"}{end}',
)
_BUSY = "starts or stops the cluster"


@dataclass(frozen=True)
class Found:
    """The cluster that is on this machine."""

    checkout: str
    programs: str
    nodes: int

    def write(self) -> None:
        places.STATE.mkdir(parents=True, exist_ok=True)
        _record().write_text(json.dumps(asdict(self)))

    @property
    def description(self) -> str:
        return f"{Path(self.programs).name}, {self.nodes} nodes, from {self.checkout}"


def _record() -> Path:
    return places.STATE / "cluster.json"


def find() -> Found | None:
    """Return the cluster that was started here and not taken down, complete or not.

    One of which no process runs any more has ended, with its machine or with who started it: what
    it was in the middle of then is nothing to go on with.
    """
    try:
        found = Found(**json.loads(_record().read_text()))
    except (OSError, ValueError, TypeError):
        return None
    return found if any(daemon.runs() for daemon in all_daemons()) else None


def up(count: int) -> None:
    """Ensure that a complete cluster with at least this many nodes is up.

    What runs is left alone, what has ended is started again, cables that were cut are mended, and
    what a reboot has torn apart is taken away first. Raises ClusterError where the machine has a
    cluster of other versions.
    """
    need_root("start the test cluster")
    packages.need(packages.TO_RUN, "run the test cluster")
    build.build(["kubernetes", "helm"])
    pause_archive()
    with locked(places.LOCK, _BUSY):
        found = keep_or_clear() or Found(str(places.CHECKOUT), str(places.cache()), count)
        found = replace(found, nodes=max(found.nodes, count))
        found.write()
        _start(found.nodes)


def keep_or_clear() -> Found | None:
    """Return the cluster to continue with, or None after all parts of it are removed."""
    found = find()
    if found is None or not network.is_there(found.nodes):
        if _leftovers():
            say("taking away what is left of an earlier cluster")
            take_down()
        return None
    if found.programs != str(places.cache()):
        raise ClusterError(
            f"this machine has a cluster of other versions ({found.description}), and there can be "
            "only one: take it down (make cluster-down), if nobody uses it"
        )
    if found.checkout != str(places.CHECKOUT):
        say(f"using the cluster that was brought up from {found.checkout}")
    return found


def _start(count: int) -> None:
    """Start all that does not run: the control plane and the nodes at the same time."""
    pki = Pki(places.KUBECONFIG.parent)
    network.connect(count)
    for index in range(1, count + 1):
        filters.reopen(index)  # a test that was killed may have closed it
    nodes = [Node(index, pki) for index in range(1, count + 1)]
    with ThreadPoolExecutor() as pool:
        starts = [pool.submit(control_plane.start, pki)]
        starts += [pool.submit(node.start) for node in nodes]
    complaints = []
    for begun in starts:
        try:
            begun.result()
        except ClusterError as error:
            complaints.append(str(error))
    if complaints:
        raise ClusterError("\n".join(complaints))
    for daemon in all_daemons():  # neither control plane nor node: KWOK
        daemon.start_again()
    wait_for(
        f"{count} nodes that are Ready",
        lambda: ready_nodes(f"!{fake_nodes.KEY}") >= count,
        complaint=lambda: diagnosis.end_of(all_daemons()),
        account=lambda: diagnosis.silence_of(_kubelets(count), answer_of("get", "nodes", *_WHY)),
    )
    for daemon in all_daemons():
        daemon.keep()


def _kubelets(count: int) -> list[Daemon]:
    return [Daemon(f"{places.node_name(index)}-kubelet") for index in range(1, count + 1)]


def down() -> None:
    """Stop the cluster and delete all its parts; do nothing if there is none."""
    need_root("stop the test cluster")
    with locked(places.LOCK, _BUSY):
        take_down()


def _leftovers() -> bool:
    return places.STATE.exists() or places.SOCKETS.exists() or bool(network.namespaces())


def take_down() -> None:
    """Remove what there is of a cluster, whole or not."""
    with ThreadPoolExecutor() as pool:
        list(pool.map(Daemon.kill, all_daemons()))
    remains.clear()
    network.remove()
