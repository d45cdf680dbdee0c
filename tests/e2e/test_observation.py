"""Views of a program whose workers are pods: the page, metrics, the timeline, a notebook."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from conformance.notebook import bar, outputs_of
from e2e.accounts import ACCOUNT, may_run_programs
from e2e.clusters import Cluster
from e2e.kube import Body
from e2e.person import Person
from e2e.program import PROGRAMS, Programs
from e2e.scene import Scene
from e2e.test_program import workers
from fiber_api import names
from patience import PATIENCE

pytestmark = pytest.mark.timeout(300, func_only=True)

ADDRESS = re.compile(r"http://127\.0\.0\.1:\d+/\?token=\S+")
ROOT = Path(__file__).parents[2]
CELL = """
import socket
import fiber

def square(number):
    return number * number

with fiber.Pool(2) as pool:
    print(sum(pool.map(square, range(100), progress="squares")))
    hosts = set(pool.broadcast(socket.gethostname))  # both, though one may start after the map
print(" ".join(sorted(hosts)))
"""


@pytest.fixture
def person(scene: Scene, programs: Programs, cluster: Cluster, tmp_path: Path) -> Person:
    may_run_programs(scene)
    person = Person(scene, programs, tmp_path, cluster.images["fiber-worker"])
    (tmp_path / "observed.py").write_text((PROGRAMS / "observed.py").read_text(encoding="utf-8"))
    return person


async def last_update(address: str, deaths: int) -> dict[str, Any]:
    """Return what a page knows once so many workers have died."""
    origin = address.partition("/?")[0]
    merged: dict[str, Any] = {}
    async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as client:
        async with client.get(address) as response:
            assert response.status == 200
        async with client.ws_connect(f"{origin}/feed", headers={"Origin": origin}) as feed:
            while "state" not in merged or len(merged["state"]["deaths"]) < deaths:
                merged |= json.loads(await feed.receive_str(timeout=PATIENCE))
    return merged


def metrics_of(scene: Scene, pod: Body) -> dict[str, float]:
    """Return the pod's series without labels, scraped where the documented PodMonitor looks."""
    spec = pod_monitor()["spec"]
    (expression,) = spec["selector"]["matchExpressions"]
    assert expression["operator"] == "Exists"
    assert expression["key"] in pod["metadata"]["labels"]
    (endpoint,) = spec["podMetricsEndpoints"]
    (container,) = pod["spec"]["containers"]
    (port,) = (port for port in container["ports"] if port["name"] == endpoint["port"])
    place = f"{pod['metadata']['name']}:{port['containerPort']}/proxy"
    text = scene.kube.text(f"{scene.path('pods', place)}/metrics")
    families = text_string_to_metric_families(text)
    return {s.name: s.value for family in families for s in family.samples if not s.labels}


def pod_monitor() -> Body:
    """Return the PodMonitor of the documentation."""
    text = (ROOT / "docs" / "metrics.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```yaml\n(.*?)```", text, flags=re.DOTALL)
    monitor: Body = yaml.safe_load(block)
    return monitor


@pytest.fixture
def run(person: Person) -> Iterator[subprocess.Popen[str]]:
    """A program in a pod, which serves metrics and waits with two tasks."""
    variables = ("--env", "FIBER_METRICS_PORT=9100", "--env", "FIBER_METRICS_HOST=0.0.0.0")
    words = ("run", "--service-account", ACCOUNT, "--name", "mine", *variables)
    with ending(person.start(*words, "observed.py", "--stay")) as run:
        assert run.stdout is not None
        assert json.loads(run.stdout.readline())["total"] == 9900
        yield run


@pytest.fixture
def page(person: Person, run: subprocess.Popen[str]) -> Iterator[str]:
    """Address of the program's page."""
    with ending(person.start("dashboard", "mine", "--no-open")) as dashboard:
        assert dashboard.stdout is not None
        found = ADDRESS.search(dashboard.stdout.readline())
        assert found is not None
        yield found[0]


@contextmanager
def ending(command: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
    """Terminate a command at the end, also if the test has failed."""
    with command:
        try:
            yield command
        finally:
            command.terminate()


def test_a_program_in_a_pod_is_seen_in_its_page_and_its_metrics(
    person: Person, run: subprocess.Popen[str], page: str, cluster: Cluster
) -> None:
    scene = person.scene
    before = asyncio.run(last_update(page, deaths=0))
    scraped = metrics_of(scene, scene.now["pods"][person.pod("mine")])
    victims = workers(scene)
    for pod in victims:
        cluster.kill(pod, names.WORKER_CONTAINER)
    after = asyncio.run(last_update(page, deaths=len(victims)))
    run.send_signal(signal.SIGINT)
    output, errors = run.communicate(timeout=PATIENCE)
    assert run.returncode == 0, errors
    assert json.loads(output)["event"] == "left"
    hosts = {pod["metadata"]["name"] for pod in victims}
    assert {child["host"] for child in before["state"]["children"]} == hosts
    assert before["activity"]["tasks"] == scraped["fiber_program_tasks_done_total"] == 100
    assert scraped["fiber_program_hosts"] == len(hosts)
    deaths = after["state"]["deaths"]
    assert {death["host"] for death in deaths} == hosts
    assert all("137" in death["reason"] or "SIGKILL" in death["reason"] for death in deaths), deaths


def test_the_timeline_shows_pods_and_their_ends(
    programs: Programs, scene: Scene, cluster: Cluster, tmp_path: Path
) -> None:
    path = tmp_path / "run.json"
    program = programs.start("outside", "observed.py", timeline=path)
    program.says("waiting")
    victims = workers(scene)
    for pod in victims:
        cluster.kill(pod, names.WORKER_CONTAINER)
    program.ends()
    events = json.loads(path.read_text(encoding="utf-8"))["traceEvents"]
    hosts = {f"host {pod['metadata']['name']}": pod["spec"]["nodeName"] for pod in victims}
    numbers = {e["args"]["name"]: e["pid"] for e in events if e["name"] == "process_name"}
    nodes = {e["pid"]: e["args"]["labels"] for e in events if e["name"] == "process_labels"}
    deaths = {e["pid"] for e in events if e["name"].startswith("died: ")}
    assert {nodes[numbers[host]] for host in hosts} == {f"node {node}" for node in hosts.values()}
    assert {numbers[host] for host in hosts} == deaths
    work = [e for e in events if e.get("cat") == "work" and e["pid"] in deaths]
    assert sum(e["args"]["tasks"] for e in work if e["name"] == "double") == 100


def test_a_notebook_runs_its_cells_on_pods(
    programs: Programs, scene: Scene, cluster: Cluster, tmp_path: Path
) -> None:
    if cluster.outside is None:
        pytest.skip(f"{cluster.description}: pods cannot reach a program outside of it")
    variables = {
        "FIBER_BACKEND": "kubernetes",
        "FIBER_NAMESPACE": scene.namespace,
        "FIBER_IMAGE": cluster.images["fiber-worker"],
        "KUBECONFIG": str(programs.kubeconfig),
    }
    (output,) = outputs_of(tmp_path, variables, CELL)
    assert "100/100" in bar(output, "squares")
    total, *hosts = output["stdout"].split()
    assert total == "328350"
    assert set(hosts) <= {m.name for m in scene.moments if m.resource == "pods"}
    assert len(hosts) == 2
