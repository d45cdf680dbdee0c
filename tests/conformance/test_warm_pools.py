"""Warm pools: each interpreter that runs tests on pods has one that no other holds."""

from __future__ import annotations

import pytest

from conformance.runner import Target
from conformance.warm_pools import warm_pools
from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.attached_pool import PoolMaster
from fiber_api.rest import POOLS, NotFound

VARIABLES = Target("fiber", "spawn", frozenset({"core"}), 60).variables()


def test_a_pool_that_a_killed_interpreter_held_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("KUBECONFIG", raising=False)
    with warm_pools(1, VARIABLES) as pools:
        with pools.lend() as given:
            pass
        with pools.lend() as same:
            assert same["FIBER_POOL"] == given["FIBER_POOL"]
            monkeypatch.setenv("KUBECONFIG", given["KUBECONFIG"])
            api = Api.connect()
            path = POOLS.path(given["FIBER_NAMESPACE"], given["FIBER_POOL"])
            master = PoolMaster("10.0.0.7", 41337, "killed", "ab" * 32).spec(given["FIBER_POOL"], 1)
            api.merge_patch(path, {"spec": {"master": master}})
        with pools.lend() as other:
            assert other["FIBER_POOL"] != given["FIBER_POOL"]
            assert "master" not in api.get(POOLS.path("lab", other["FIBER_POOL"]))["spec"]
            with pytest.raises(NotFound):
                api.get(path)
        api.close()
