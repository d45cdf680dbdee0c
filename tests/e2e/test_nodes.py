"""A node that is cut off."""

from __future__ import annotations

import copy

import pytest

from e2e.clusters import Cluster
from e2e.delays import record
from e2e.kube import Body
from e2e.pools import Pool, says
from e2e.release import Release
from fiber_api import names

SOON = 2
"""Seconds that a worker stays bound to a node that is lost, instead of a minute."""


def spread(agent: Body) -> Body:
    """The template, with workers on different nodes that do not wait for a lost one."""
    changed = copy.deepcopy(agent)
    changed["spec"]["topologySpreadConstraints"] = [
        {
            "maxSkew": 1,
            "topologyKey": "kubernetes.io/hostname",
            "whenUnsatisfiable": "ScheduleAnyway",
            "labelSelector": {"matchLabels": {names.LABEL_POOL: "es"}},
        }
    ]
    changed["spec"]["tolerations"] = [
        {
            "key": f"node.kubernetes.io/{key}",
            "operator": "Exists",
            "effect": "NoExecute",
            "tolerationSeconds": SOON,
        }
        for key in ("not-ready", "unreachable")
    ]
    return changed


@pytest.mark.timeout(240, func_only=True)
def test_workers_of_a_lost_node_are_replaced(
    pool: Pool, agent: Body, release: Release, cluster: Cluster
) -> None:
    pool.apply(spread(agent), minReplicas=2)
    pool.ready(2)
    operator = release.pod()["spec"]["nodeName"]
    lost = next(node for node in cluster.workers() if node != operator)
    (victim,) = [_name(pod) for pod in pool.live if pod["spec"]["nodeName"] == lost]
    before = pool.names
    with cluster.cut_off(lost):
        problem = pool.has_problem("NotReady", severity="Warning", seconds=cluster.node_lost_after)
        assert says(problem["message"], victim, "node")
        (new,) = pool.wait("another", lambda: pool.ever - before, seconds=60)
        pool.wait("two ready", lambda: pool.status.get("readyReplicas") == 2)
        asked = pool.scene.first("pods", lambda pod: _name(pod) == victim and _is_ending(pod))
        came = pool.scene.first("pods", lambda pod: _name(pod) == new)
        record("a worker of a lost node is replaced", came - asked)
        assert pool.status["failures"]["disrupted"] == 1
        assert pool.status["failures"].get("total", 0) == 0
    pool.wait("the lost one is gone", lambda: victim not in pool.scene.now["pods"], seconds=60)
    pool.ready(2)
    assert len(pool.ever) == 3


def _name(pod: Body) -> str:
    return str(pod["metadata"]["name"])


def _is_ending(pod: Body) -> bool:
    return "deletionTimestamp" in pod["metadata"]
