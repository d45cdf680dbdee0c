"""/healthz, /readyz, /metrics, and the process as a whole."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import aiohttp
import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from fakes import virtual_time
from fakes.kubernetes_api import Fault
from fakes.world import NAMESPACE, OWN_LEASE, Test, World, a_world
from fiber_operator.health import MOST_CONNECTIONS, Health, WatchStatus
from fiber_operator.metrics import Metrics, PoolSample
from fiber_operator.planning.pods import PodState
from fiber_operator.workqueue import QueueStatistics
from patience import PATIENCE

ROOT = Path(__file__).resolve().parents[2]


def played(test: Test) -> Callable[[], None]:
    async def main() -> None:
        async with a_world() as world:
            await world.until(lambda: bool(world.program.port))
            await test(world)

    return lambda: virtual_time.run(main())


async def ask(world: World, path: str) -> tuple[int, str]:
    url = f"http://127.0.0.1:{world.program.port}{path}"
    async with aiohttp.ClientSession() as session, session.get(url) as response:
        return response.status, (await response.text()).strip()


async def metrics(world: World) -> dict[tuple[str, ...], float]:
    """Name and values of labels, by the labels' names -> value."""
    _, page = await ask(world, "/metrics")
    return {
        (sample.name, *(value for _, value in sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(page)
        for sample in family.samples
    }


@played
async def test_an_operator_at_work_is_alive_and_ready(world: World) -> None:
    await world.settled()
    assert await ask(world, "/healthz") == (200, "ok")
    assert await ask(world, "/readyz") == (200, "ok")
    await world.settled(1000)
    assert await ask(world, "/healthz") == (200, "ok")
    assert await ask(world, "/readyz") == (200, "ok")


@played
async def test_an_operator_that_is_not_the_leader_is_alive_and_not_ready(world: World) -> None:
    await world.settled()
    spec = {"holderIdentity": "another", "leaseDurationSeconds": 1000}
    world.store.merge("leases", "fiber-system", OWN_LEASE, {"spec": spec})
    await world.settled(20)
    assert await ask(world, "/healthz") == (200, "ok")
    status, text = await ask(world, "/readyz")
    assert (status, text) == (503, "this operator is not the leader: another holds the Lease")


@played
async def test_pools_that_cannot_be_listed_are_reported(world: World) -> None:
    await world.settled()
    message = 'fiberpools.fiber.dev is forbidden: User "operator" cannot list'
    refused = Fault("list", "fiberpools", status=403, message=message, times=10**6)
    world.api.faults.append(refused)
    await world.settled(70)
    status, text = await ask(world, "/readyz")
    assert status == 503
    assert f"list fiberpools: {message}" in text
    await world.settled(1000)
    assert "were last listed" in (await ask(world, "/readyz"))[1]
    assert await ask(world, "/healthz") == (200, "ok"), "a restart would not help"
    refused.times = 0
    await world.settled(10)
    assert await ask(world, "/readyz") == (200, "ok")


@played
async def test_an_outage_is_no_reason_for_a_restart(world: World) -> None:
    world.make_pool(replicas=3)
    await world.ready(3)
    world.api.down = True
    for _ in range(5):
        await world.settled(60)
        assert (await ask(world, "/healthz"))[0] == 200
    assert (await ask(world, "/readyz"))[0] == 503


class Parts:
    """Parts by which health is judged, all well until a test says otherwise."""

    def __init__(self, **statistics: float) -> None:
        self.now = 10_000.0
        well = {"waiting": 0, "running": 0, "known": 1, "longest_wait": 0.0, "longest_run": 0.0}
        found = QueueStatistics(**{**well, "since_last_end": 5.0, **statistics})  # type: ignore[arg-type]
        self.resync = SimpleNamespace(
            seconds=60.0, failures={}, tried=self.now - 30, succeeded=self.now - 30
        )
        self.watches = WatchStatus(())
        self.watches.started(True)
        self.watches.answered("watch fiberpools", None)
        self.watches.answered("watch pods", None)
        self.watches.answered("watch leases", None)
        self.health = Health(
            SimpleNamespace(is_leader=True, why=""),  # type: ignore[arg-type]
            SimpleNamespace(statistics=lambda: found),  # type: ignore[arg-type]
            self.resync,  # type: ignore[arg-type]
            self.watches,
            lambda: self.now,
        )


def test_all_is_well() -> None:
    parts = Parts(since_last_end=4000.0)
    assert parts.health.alive() == parts.health.ready() == []


def test_a_turn_that_hangs_is_a_reason_for_a_restart() -> None:
    assert Parts(longest_run=599.0).health.alive() == []
    assert Parts(longest_run=601.0).health.alive() == [
        "the reconcile of a pool has taken 601 s so far"
    ]


def test_a_queue_that_stands_still_is() -> None:
    assert Parts(longest_wait=500.0, since_last_end=10.0).health.alive() == []
    (said,) = Parts(longest_wait=130.0, since_last_end=140.0).health.alive()
    assert said == "pools wait, and no reconcile has ended for 140 s"


def test_a_resync_that_stands_still_is() -> None:
    parts = Parts()
    parts.now += 200
    assert parts.health.alive() == []
    parts.now += 20
    (said,) = parts.health.alive()
    assert said == "the operator has not tried to list the pools for 250 s"


def test_a_resync_that_never_began_is() -> None:
    parts = Parts()
    parts.resync.tried = None
    assert parts.health.alive() == []
    parts.now += 241
    assert parts.health.alive() != []


def test_pools_that_wait_or_are_not_watched_are_not_served() -> None:
    assert Parts(longest_wait=31.0).health.ready() == ["a pool has waited 31 s for its reconcile"]
    parts = Parts()
    parts.watches.started(False)
    assert parts.health.ready() == ["kopf does not run: changes are seen late"]


@played
async def test_metrics_count_calls_reconciles_and_pools(world: World) -> None:
    world.make_pool(replicas=5)
    await world.ready(5)
    world.kubelet.exit(NAMESPACE, world.names()[0], 3)
    await world.until(lambda: world.status()["failures"]["total"] == 1)
    found = await metrics(world)
    pods = "fiber_operator_pods_created_total"
    assert found[pods,] == 5
    assert found["fiber_operator_api_requests_total", "200", "pods", "create"] == 6
    assert found["fiber_operator_api_request_duration_seconds_count", "pods", "list"] > 1
    assert found["fiber_operator_reconciles_total", "ok"] > 1
    assert found["fiber_operator_reconcile_duration_seconds_count",] > 1
    assert found["fiber_operator_watch_events_total", "pods"] > 5
    assert found["fiber_operator_pools",] == 1
    assert found["fiber_operator_lease_held",] == 1
    assert found["fiber_operator_last_resync_timestamp_seconds",] > 1e9
    assert found["fiber_pool_desired_pods", NAMESPACE, "es"] == 5
    assert found["fiber_pool_pods", NAMESPACE, "es", "ready"] == 4
    assert found["fiber_pool_problems", NAMESPACE, "es", "ContainerFailed"] == 1
    assert found["fiber_pool_lost_pods_total", "failed", NAMESPACE, "es"] == 1
    assert found["process_resident_memory_bytes",] > 0


@played
async def test_a_page_of_metrics_is_made_at_most_once_a_second(world: World) -> None:
    world.make_pool(replicas=1)
    await world.ready(1)
    await world.settled(2)
    wanted = ("fiber_pool_desired_pods", NAMESPACE, "es")
    assert (await metrics(world))[wanted] == 1
    world.edit(replicas=2)
    await world.settled(0.5)
    assert (await metrics(world))[wanted] == 1
    await world.settled(1)
    assert (await metrics(world))[wanted] == 2


@played
async def test_many_silent_connections_are_ended_and_probes_are_answered(world: World) -> None:
    async with contextlib.AsyncExitStack() as there:
        readers = []
        for _ in range(3 * MOST_CONNECTIONS):
            reader, writer = await asyncio.open_connection("127.0.0.1", world.program.port)
            there.callback(writer.close)
            readers.append(reader)
        assert await ask(world, "/healthz") == (200, "ok")
        await world.settled()
        ended = [reader.at_eof() or reader.exception() is not None for reader in readers]
    assert ended.count(False) <= MOST_CONNECTIONS
    assert not any(ended[-MOST_CONNECTIONS // 2 :]), "the latest ones go on"


@played
async def test_metrics_of_a_pool_go_with_it(world: World) -> None:
    world.make_pool(replicas=1)
    await world.ready(1)
    world.store.delete("fiberpools", NAMESPACE, "es")
    await world.settled()
    assert not [key for key in await metrics(world) if key[0].startswith("fiber_pool_")]


@pytest.mark.parametrize(
    "status",
    [{}, {"failures": 3, "problems": "x"}, {"problems": [None, {}], "desiredReplicas": "y"}],
)
def test_metrics_outlive_nonsense_in_a_status(status: dict[str, Any]) -> None:
    assert PoolSample.of(status, []).desired == 0


def test_metrics_that_the_chart_names_exist() -> None:
    """Dashboard and alerts."""
    found = Metrics()
    found.watch_queue(Parts().health.queue.statistics, lambda: True)
    known = set(re.findall(r"^# HELP (\w+)", found.render().decode(), re.MULTILINE))
    texts = [path.read_text() for path in (ROOT / "charts").rglob("*") if path.is_file()]
    asked = set(re.findall(r"\bfiber_(?:operator|pool)_[a-z_]+[a-z]", " ".join(texts)))
    assert {re.sub("_(bucket|count|sum)$", "", name) for name in asked} <= known
    assert asked


def test_states_of_pods_are_labels() -> None:
    assert [state.value.lower() for state in PodState] == [
        "pending",
        "starting",
        "ready",
        "notready",
        "terminating",
        "ended",
    ]


# -- The process

DEEP = 1200
"""More than Python reads by itself, and less than the API server takes."""


def environment(tmp_path: Path, server: str, **settings: str) -> dict[str, str]:
    kubeconfig = {
        "current-context": "test",
        "contexts": [{"name": "test", "context": {"cluster": "test", "user": "test"}}],
        "clusters": [{"name": "test", "cluster": {"server": server}}],
        "users": [{"name": "test", "user": {"token": "secret"}}],
    }
    (tmp_path / "config").write_text(yaml.safe_dump(kubeconfig))
    ours = {f"FIBER_OPERATOR_{name}": value for name, value in settings.items()}
    return {**os.environ, "KUBECONFIG": str(tmp_path / "config"), **ours}


async def begin(world: World, tmp_path: Path) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "fiber_operator",
        env=environment(tmp_path, world.api.url, LISTEN="127.0.0.1:0", NAMESPACE="fiber-system"),
        stderr=subprocess.PIPE,
    )


@pytest.mark.slow
def test_the_process_works_until_sigterm(tmp_path: Path) -> None:
    async def main() -> None:
        async with a_world(operator=False) as world:
            process = await begin(world, tmp_path)
            try:
                world.make_pool(replicas=3)
                await world.until_settled(3)
            finally:
                process.send_signal(signal.SIGTERM)
                _, said = await asyncio.wait_for(process.communicate(), PATIENCE)
            assert process.returncode == 0, said
            assert b'"message": "stopped"' in said
            lease = world.store.get("leases", "fiber-system", OWN_LEASE)
            assert lease["spec"]["holderIdentity"] == ""

    asyncio.run(main())


@pytest.mark.slow
def test_a_pool_that_is_nested_deeply_hides_no_other(tmp_path: Path) -> None:
    async def main() -> None:
        async with a_world(operator=False) as world:
            nested: Any = []
            for _ in range(DEEP):
                nested = [nested]
            template = {"spec": {"containers": [{"name": "worker", "image": "x"}], "x": nested}}
            world.make_pool("deep", replicas=1, template=template)
            process = await begin(world, tmp_path)
            try:
                world.make_pool(replicas=3)
                await world.until(lambda: "InvalidTemplate" in world.reasons("deep"))
                await world.until_settled(3)
            finally:
                process.terminate()
                _, said = await asyncio.wait_for(process.communicate(), PATIENCE)
            assert b"RecursionError" not in said

    limit = sys.getrecursionlimit()
    sys.setrecursionlimit(10 * DEEP)
    try:
        asyncio.run(main())
    finally:
        sys.setrecursionlimit(limit)


@pytest.mark.slow
def test_the_process_refuses_settings_that_make_no_sense(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "fiber_operator"],
        env=environment(tmp_path, "http://127.0.0.1:9", NAMESPCES="team"),
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 2
    assert "fiber_operator: FIBER_OPERATOR_NAMESPCES is not a setting" in done.stderr


def test_the_process_says_why_it_cannot_begin(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "fiber_operator"],
        env={**environment(tmp_path, "http://127.0.0.1:9"), "KUBECONFIG": "/nowhere/config"},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 1
    assert "KUBECONFIG" in done.stderr or "kube-config" in done.stderr
