"""`--set-up`: the cluster of tests/cluster with pretended nodes and the operator, for one run.

Parts that existed before are used and stay; parts that are made here are removed at the end.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks.operator_scale.cases import DEFAULT_RATE
from benchmarks.operator_scale.installed import CannotMeasure

from cluster import ability, build, control_plane, fake_nodes, images, lifecycle, places
from cluster.kubectl import ready_nodes
from e2e.kube import Kube, path_of
from e2e.release import Release, crd_owner
from fiber_api import names

_NODES = 2
_RELEASE = "fiber-bench"
# The chart's own defaults where the end-to-end tests have others.
_VALUES = {"operator": {"leaseSeconds": 15}}


def kubeconfig() -> Path:
    """Return the file that KUBECONFIG names."""
    given = os.environ.get("KUBECONFIG")
    if not given:
        raise CannotMeasure(
            "KUBECONFIG is not set, so there is no cluster to measure on: set it, or let --set-up "
            "bring up the cluster of tests/cluster (root, Linux, Go)"
        )
    if not Path(given).is_file():
        raise CannotMeasure(f"KUBECONFIG is {given}, and there is no such file: unset or mend it")
    return Path(given)


@contextlib.contextmanager
def own_cluster(fakes: int) -> Iterator[Path]:
    """Bring up our cluster with so many pretended nodes; give its KUBECONFIG."""
    given = os.environ.get("KUBECONFIG")
    if given and Path(given) != places.KUBECONFIG:
        raise CannotMeasure(
            f"--set-up is for the cluster of tests/cluster, and KUBECONFIG names another ({given}):"
            " unset it, or install the chart there and run this without --set-up"
        )
    if obstacles := ability.obstacles():
        raise CannotMeasure(
            f"the cluster of tests/cluster cannot run here: {'; '.join(obstacles)}. Set KUBECONFIG "
            "to a cluster that has the operator and KWOK's nodes, and run this without --set-up"
        )
    if fakes:
        build.build(["kwok"])
    was_up = lifecycle.find() is not None
    before = 0
    try:
        lifecycle.up(_NODES)
        before = ready_nodes(f"{fake_nodes.KEY}={fake_nodes.VALUE}")
        if fakes > before:
            fake_nodes.set_count(fakes)
        yield places.KUBECONFIG
    finally:
        if was_up and fakes > before:
            fake_nodes.set_count(before)
        elif not was_up:
            lifecycle.down()


@contextlib.contextmanager
def default_rate() -> Iterator[None]:
    """Limit Kubernetes' controllers to the calls a second that they make by default."""
    try:
        control_plane.limit_controllers(DEFAULT_RATE)
        yield
    finally:
        control_plane.limit_controllers()


@contextlib.contextmanager
def operator(kube: Kube) -> Iterator[None]:
    """Install the operator of this checkout, unless the cluster has one already."""
    owner = crd_owner(kube)
    if owner is not None and owner != f"{_RELEASE}/{_RELEASE}":
        yield  # its caller finds out whether it runs
        return
    with tempfile.TemporaryDirectory() as home:
        release = Release(kube, _RELEASE, _RELEASE, images.bring_images(), Path(home))
        try:
            release.install(_VALUES)
            yield
        finally:
            release.uninstall()
            kube.delete(path_of("customresourcedefinitions", name=names.CRD_NAME))
            kube.delete(path_of("namespaces", name=_RELEASE))
