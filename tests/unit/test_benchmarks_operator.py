"""The operator's benchmark: its arithmetic and page, and trials against a small API in process."""

from __future__ import annotations

import itertools
import json
import queue
import signal
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks.operator_scale import (  # noqa: E402
    command,
    counters,
    floods,
    report,
    results,
    trial,
)
from benchmarks.operator_scale.cases import (  # noqa: E402
    BY_DEFAULT,
    CASES,
    FIBER,
    REPLICA_SET,
    SUBJECTS,
    Case,
    Subject,
    in_turn,
    is_settled,
)
from benchmarks.operator_scale.installed import (  # noqa: E402
    CannotMeasure,
    Operator,
    check_nodes,
    find_operator,
)
from benchmarks.operator_scale.results import OperatorUse, Result, Trial  # noqa: E402

from e2e.kube import Kube  # noqa: E402
from fiber_api.v1alpha1 import FiberPool  # noqa: E402

ABOUT = {
    "date": "2026-01-01 00:00 UTC",
    "command": "python -m benchmarks.operator_scale",
    "cores": 2,
    "processor": "a processor",
    "memory": "8.00 GB",
    "load": 0.0,
    "system": "Linux 6",
    "python": "3.11.0",
    "kubernetes": "v1.34.4",
    "operator": "fiber-operator:1",
    "nodes": 10,
    "rounds": 2,
}
OPERATOR_PAGE = """\
# HELP fiber_operator_api_requests_total Calls of the API server.
fiber_operator_api_requests_total{verb="create",resource="pods",code="201"} %(pods)d
fiber_operator_api_requests_total{verb="create",resource="pods",code="403"} 1
fiber_operator_api_requests_total{verb="patch",resource="fiberpools/status",code="200"} %(pods)d
process_resident_memory_bytes 9.5e+07
process_cpu_seconds_total %(pods)d
process_start_time_seconds %(born)f
"""
SERVER_PAGE = """\
apiserver_request_total{code="201",resource="pods",scope="resource",subresource="",verb="POST"} 7
apiserver_request_total{code="409",resource="pods",scope="resource",subresource="",verb="POST"} 1
apiserver_request_total{code="200",resource="pods",scope="r",subresource="status",verb="PATCH"} 9
apiserver_request_total{code="200",resource="pods",scope="namespace",subresource="",verb="LIST"} 50
apiserver_request_total{code="200",resource="leases",scope="r",subresource="",verb="PUT"} 60
apiserver_request_total_of_something_else{verb="POST",resource="pods"} 70
"""


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_the_fiber_pool_and_the_replica_set_make_the_same_pods(case: Case) -> None:
    pool, replica_set = (subject.manifest("x", case.size) for subject in SUBJECTS)
    assert replica_set["spec"]["replicas"] == case.size
    assert pool["spec"]["template"]["spec"] == replica_set["spec"]["template"]["spec"]
    pool["metadata"].update(uid="u", namespace="n")
    assert FiberPool.read(pool).wanted == case.size
    assert [in_turn(turn)[0] for turn in range(3)] == [FIBER, REPLICA_SET, FIBER]


@pytest.mark.parametrize(
    ("status", "settled"),
    [
        ({"observedGeneration": 2, "replicas": 5, "readyReplicas": 5}, True),
        ({"observedGeneration": 1, "replicas": 5, "readyReplicas": 5}, False),
        ({"observedGeneration": 2, "replicas": 6, "readyReplicas": 5}, False),
        ({"observedGeneration": 2, "replicas": 5}, False),
        ({}, False),
    ],
)
def test_a_status_is_settled_if_it_describes_this_spec(
    status: dict[str, int], settled: bool
) -> None:
    assert is_settled({"metadata": {"generation": 2}, "status": status}, 5) is settled


def test_requests_are_added_up_without_heartbeats_and_constant_parts() -> None:
    page = OPERATOR_PAGE % {"pods": 4, "born": 0}
    assert counters.operator_requests(page) == {"create pods": 5, "patch fiberpools/status": 4}
    assert counters.server_writes(SERVER_PAGE) == {"POST pods": 8, "PATCH pods/status": 9}
    assert counters.value(page, "process_resident_memory_bytes") == 95e6
    with pytest.raises(KeyError):
        counters.value(page, "process_open_fds")
    grown = counters.growth({"a": 1.0, "b": 2.0}, {"a": 3.0, "b": 2.0, "c": 5.0})
    assert list(grown.items()) == [("c", 5.0), ("a", 2.0)]


def done(subject: Subject, turn: int, seconds: float, memory: float = 0.0) -> Trial:
    use = OperatorUse(
        memory=[[0.5, memory], [1.0, memory - 1e6]],
        memory_before=60e6,
        memory_after=80e6,
        seconds_until_settled=4.0,
        seconds=6.0,
        requests_until_settled={"create pods": 1000.0, "patch fiberpools/status": 8.0},
    )
    return Trial(
        subject.name,
        turn,
        steps=dict.fromkeys(results.STEPS, seconds),
        writes={"POST pods": 1000.0, "POST events": 2000.0},
        operator=use if subject is FIBER else None,
    )


def result(*seconds: tuple[float, float], memory: float = 90e6) -> Result:
    trials = []
    for turn, (fiber, other) in enumerate(seconds):
        trials += [done(FIBER, turn, fiber, memory), done(REPLICA_SET, turn, other)]
    return Result(dict(ABOUT), trials)


def test_results_survive_their_file(tmp_path: Path) -> None:
    known = {"1000": result((10.0, 9.0), (11.0, 10.0))}
    results.save(tmp_path / "x.json", known)
    assert results.load(tmp_path / "x.json") == known
    assert results.load(tmp_path / "absent.json") == {}


def test_a_ratio_is_taken_within_a_round() -> None:
    # The machine was ten times slower in the second round.
    found = result((10.0, 10.0), (100.0, 80.0)).ratio("fiber", "replicaset", "settled")
    assert found is not None
    assert (found.least, found.greatest) == (1.0, 1.25)


@pytest.mark.parametrize(
    ("case", "seconds", "memory", "verdicts"),
    [
        ("1000", 11.9, 149e6, {"1,000 pods settled": "met", "memory": "met"}),
        (
            "1000",
            18.0,
            165e6,
            {"1,000 pods settled": "missed by 50.0 %", "memory": "missed by 10.0 %"},
        ),
        ("100x10", 24.0, 90e6, {"100 times 10 pods settled": "missed by 100.0 %"}),
        ("5000", 13.2, 90e6, {"5,000 pods settled": "missed by 10.0 %"}),
    ],
)
def test_a_case_is_judged_by_its_budgets(
    case: str, seconds: float, memory: float, verdicts: dict[str, str]
) -> None:
    found = report.budgets({case: result((seconds, 10.0), memory=memory)})
    measured = [line for line in found if line.verdict != "not measured"]
    assert len(measured) == len(verdicts)
    for line, (words, verdict) in zip(measured, verdicts.items(), strict=True):
        assert words in line.what
        assert line.verdict == verdict


@pytest.mark.parametrize(("seconds", "verdict"), [(9.9, "met"), (11.0, "missed by 10.0 %")])
def test_the_defaults_of_kubernetes_are_a_budget_and_a_row(seconds: float, verdict: str) -> None:
    known = result((seconds, 9.0), (99.0, 9.0))
    known.trials.append(done(BY_DEFAULT, 0, 10.0))
    found = [line for line in report.budgets({"1000": known}) if "of 20" in line.what]
    assert [line.verdict for line in found] == [verdict, "not measured"]
    assert f"| 10.0 s | {seconds / 10:.3g}" in report.page({"1000": known}, notes=False)


def test_the_page_has_ratio_memory_requests_and_origin() -> None:
    known = {"1000": result((10.0, 9.0), (11.0, 10.0)), "5000": result((50.0, 50.0))}
    page = report.page(known, notes=False)
    assert "| 10.5 s | 9.5 s | 1.11x (1.10x to 1.11x) |" in page
    assert "| 1,000 pods | 60.0 MB | 90.0 MB | 80.0 MB | 4.0 s | 4.00 ms | 6.0 s |" in page
    assert "| create pods | 1,000 | 1.000 |" in page
    assert "| patch fiberpools/status | 8 | 0.008 |" in page
    assert "| 1,000 pods | FiberPool | 3.00 | POST pods 1.00, POST events 2.00 |" in page
    assert "v1.34.4, 10 pretended nodes" in page
    assert "operator-notes.md" not in page
    assert "operator-notes.md" in report.page(known, notes=True)


# A cluster


class Api:
    """Part of an API server that a trial needs. It carries out requests at once."""

    def __init__(self) -> None:
        self.idle = False
        """True if pods are never made."""
        self.restarts = False
        """True if another operator answers each time."""
        self.objects: dict[str, Any] = {}
        self.namespaces: set[str] = set()
        self.watches: list[queue.Queue[str | None]] = []
        self.lists: dict[str, list[Any]] = {}
        self._made = itertools.count()
        self._asked = itertools.count()
        self._lock = threading.Lock()

    def answer(self, method: str, path: str, body: Any) -> Any:
        with self._lock:
            return self._answer(method, path.removesuffix("/"), body)

    def follow(self, watch: queue.Queue[str | None]) -> None:
        """Report every change, also those since the list."""
        with self._lock:
            self.watches.append(watch)
            for body in self.objects.values():
                watch.put(_event(body))

    def _answer(self, method: str, path: str, body: Any) -> Any:
        collection = path.endswith(("fiberpools", "replicasets"))
        match method, path.rpartition("/")[2]:
            case "POST", "namespaces":
                name = f"{body['metadata']['generateName']}{next(self._made)}"
                self.namespaces.add(name)
                return {"metadata": {"name": name}}
            case "POST", _ if collection:
                self.objects[body["metadata"]["name"]] = body
                return self._settle(body, generation=1)
            case "PATCH", name:
                self.objects[name]["spec"].update(body["spec"])
                return self._settle(self.objects[name], generation=2)
            case "DELETE", _ if collection:
                self.objects.clear()
                return {"kind": "Status"}
            case "GET", "pods" if path.startswith("/api/v1/namespaces"):
                pods = 0 if self.idle else sum(o["spec"]["replicas"] for o in self.objects.values())
                more = {"remainingItemCount": pods - 1} if pods > 1 else {}
                return {"items": [{}] * min(pods, 1), "metadata": more}
            case "GET", "metrics" if path == "/metrics":
                return SERVER_PAGE
            case "GET", "metrics" if path == "/api/v1/namespaces/n/pods/o:8080/proxy/metrics":
                born = next(self._asked) if self.restarts else 0
                return OPERATOR_PAGE % {"pods": len(self.objects), "born": born}
            case "GET", "default":
                return {"metadata": {"name": "default"}}
            case "GET", _ if collection:
                items = list(self.objects.values())
                return {"items": items, "metadata": {"resourceVersion": "1"}}
            case "GET", _ if path in self.lists:
                return {"items": self.lists[path]}
        return None

    def _settle(self, body: Any, generation: int) -> Any:
        body["metadata"]["generation"] = generation
        replicas = body["spec"]["replicas"]
        if not self.idle:
            body["status"] = {
                "observedGeneration": generation,
                "replicas": replicas,
                "readyReplicas": replicas,
            }
        for watch in self.watches:
            watch.put(_event(body))
        return body


def _event(body: Any) -> str:
    return json.dumps({"type": "MODIFIED", "object": body})


class Fake(Kube):
    """The client, without kubectl."""

    def __init__(self, api: Api, port: int) -> None:
        self.kubeconfig = Path("fake")
        self.host, self.port = "127.0.0.1", port
        self._api = api

    def kubectl(self, *arguments: str, stdin: str = "", seconds: float = 60) -> str:
        if "delete" in arguments:
            self._api.namespaces -= {*arguments} if "--selector" not in arguments else set()
            return ""
        return "\n".join(self._api.namespaces & {*arguments})


@pytest.fixture
def api() -> Api:
    return Api()


@pytest.fixture
def kube(api: Api) -> Iterator[Fake]:
    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

        def _do(self) -> None:
            url = urlsplit(self.path)
            length = int(self.headers.get("Content-Length") or 0)
            body = json.loads(self.rfile.read(length)) if length else None
            if "watch" in parse_qs(url.query):
                self._watch()
                return
            answer = api.answer(self.command, url.path, body)
            self.send_response(404 if answer is None else 200)
            self.end_headers()
            text = answer if isinstance(answer, str) else json.dumps(answer or {})
            self.wfile.write(text.encode())

        def _watch(self) -> None:
            self.send_response(200)
            self.end_headers()
            lines: queue.Queue[str | None] = queue.Queue()
            api.follow(lines)
            while (line := lines.get()) is not None:
                self.wfile.write(f"{line}\n".encode())

        do_GET = do_POST = do_PATCH = do_DELETE = _do

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield Fake(api, server.server_address[1])
    for watch in api.watches:
        watch.put(None)
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def operator(kube: Fake) -> Operator:
    return Operator(kube, pod("o"))


@pytest.fixture(autouse=True)
def _no_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "_REST", 0.0)


CASE = Case("tiny", "3 times 4 pods", 3, 4, rounds=1, limit=5.0)


@pytest.mark.parametrize("subject", SUBJECTS, ids=lambda subject: subject.name)
def test_a_trial_times_each_step_and_leaves_no_object(
    kube: Fake, api: Api, operator: Operator, subject: Subject
) -> None:
    found = trial.run(kube, operator, CASE, subject, 1)
    assert list(found.steps) == ["created", "settled", "halved", "gone"]
    assert all(0 <= seconds < CASE.limit for seconds in found.steps.values())
    assert found.created[-1][1] == 12
    assert 12 in [ready for _, ready in found.ready]
    assert (found.subject, found.turn) == (subject.name, 1)
    assert not api.objects
    assert not api.namespaces
    assert (found.operator is not None) == (subject is FIBER)
    if found.operator:
        assert found.operator.requests_until_settled == {
            "create pods": 3,
            "patch fiberpools/status": 3,
        }
        assert found.operator.memory_after == 95e6


@pytest.mark.parametrize(
    ("harm", "limit", "error", "said"),
    [
        ("idle", 0.2, trial.TooSlow, r"FiberPool, 3 times 4 pods: .* does not watch all namesp"),
        ("restarts", 5.0, CannotMeasure, "the operator was restarted during a trial"),
    ],
)
def test_a_trial_that_fails_is_reported_and_leaves_no_namespace(
    kube: Fake,
    api: Api,
    operator: Operator,
    harm: str,
    limit: float,
    error: type[Exception],
    said: str,
) -> None:
    setattr(api, harm, True)
    with pytest.raises(error, match=said):
        trial.run(kube, operator, replace(CASE, limit=limit), FIBER, 0)
    assert not api.namespaces


def pod(name: str, ready: str = "True") -> dict[str, Any]:
    return {
        "metadata": {"name": name, "namespace": "n"},
        "spec": {
            "containers": [
                {
                    "name": "operator",
                    "image": "i:1",
                    "ports": [{"name": "metrics", "containerPort": 8080}],
                }
            ]
        },
        "status": {"conditions": [{"type": "Ready", "status": ready}]},
    }


def test_a_missing_operator_is_reported(kube: Fake, api: Api) -> None:
    with pytest.raises(CannotMeasure, match=r"does not know FiberPools .* --set-up"):
        find_operator(kube)
    kube.get = lambda path, **query: {}  # type: ignore[method-assign]
    api.lists["/api/v1/pods"] = [pod("a", ready="False")]
    with pytest.raises(CannotMeasure, match="no ready pod of the operator"):
        find_operator(kube)
    api.lists["/api/v1/pods"] = [pod("a"), pod("b")]
    with pytest.raises(CannotMeasure, match=r"more than one operator \(n/a, n/b\)"):
        find_operator(kube)
    api.lists["/api/v1/pods"] = [pod("a")]
    assert find_operator(kube).image == "i:1"


def test_nodes_without_room_are_reported(kube: Fake, api: Api) -> None:
    conditions = [{"type": "Ready", "status": "True"}]
    node = {"status": {"allocatable": {"pods": "500"}, "conditions": conditions}}
    api.lists["/api/v1/nodes"] = []
    with pytest.raises(CannotMeasure, match=r"1,001 pods need .* there is none: .* fake-nodes 3"):
        check_nodes(kube, 1001)
    api.lists["/api/v1/nodes"] = [node, node]
    with pytest.raises(CannotMeasure, match="room for 1,000 on 2 that are ready, of 2"):
        check_nodes(kube, 1001)
    assert check_nodes(kube, 1000) == 2


@pytest.mark.parametrize(
    ("arguments", "kubeconfig", "said"),
    [
        ((), "", "KUBECONFIG is not set, so there is no cluster to measure on"),
        ((), "/nowhere", "KUBECONFIG is /nowhere, and there is no such file"),
        (("--set-up",), "/nowhere", "--set-up is for the cluster of tests/cluster"),
    ],
)
def test_a_run_without_a_cluster_prints_the_remedy(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    kubeconfig: str,
    said: str,
) -> None:
    monkeypatch.setenv("KUBECONFIG", kubeconfig)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    assert command.main(["--output", str(tmp_path), *arguments]) == 1
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_unknown_case_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command.main(["--cases", "1000,10"])
    assert "no case '10'; there are 1000, 100x10, 5000" in capsys.readouterr().err


def test_the_page_of_floods_compares_delays_with_and_without_a_flood() -> None:
    usual = floods.Measured([0.5, 0.5, 2.0], changes=10, seconds=2.0, memory=9e7)
    flooded = floods.Measured([1.0, 1.0, 3.0], changes=10, seconds=2.0, memory=2.5e8)
    page = floods.page(ABOUT, dict.fromkeys(floods.FLOODS, usual) | {"large": flooded})
    assert "| no flood | 5 | 500 ms | 2.00 s | 1.000x | 90.0 MB |" in page
    assert "| 40 pools of 1.3 MB | 5 | 1.00 s | 3.00 s | 2.00x | 250 MB |" in page
    assert "with 40 pools of 1.3 MB: missed." in page


@pytest.mark.parametrize("name", ["large", "changed", "broken"])
def test_the_pools_of_a_flood_are_fiber_pools(name: str) -> None:
    for body in floods.FLOODS[name].pools:
        FiberPool.model_validate(body)
