"""Smoke tests of the benchmarks' measures: each one runs as small as it goes."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks import (  # noqa: E402
    agents,
    executors,
    kubernetes_report,
    kubernetes_run,
    large_messages,
    latency,
    link_floor,
    parallel_loops,
    peers,
    processes,
    rounds,
    vector,
    vector_peers,
    workers,
)
from benchmarks.agent_host import Order  # noqa: E402
from benchmarks.contender import Bench  # noqa: E402
from benchmarks.contenders import ALL, BY_NAME, ON_PODS, RELAYED, Contender  # noqa: E402
from benchmarks.environment import cart_pole  # noqa: E402
from benchmarks.fake_agents import FakeAgent, TaskRunner  # noqa: E402
from benchmarks.model import Case, Metric, Run  # noqa: E402
from benchmarks.session import Failed, Session  # noqa: E402
from benchmarks.suite import MEASURES  # noqa: E402
from benchmarks.tasks import no_op  # noqa: E402

from census import wait_until  # noqa: E402
from fiber._agent.interface import ChildSpec  # noqa: E402
from fiber._wire import work  # noqa: E402
from patience import PATIENCE  # noqa: E402

BASELINE = BY_NAME["multiprocessing"]


def test_each_case_has_a_unique_name_and_contenders_with_adapters() -> None:
    for name, measure in MEASURES.items():
        names = [case.name for case in measure.cases(1.0)]
        assert len(names) == len(set(names)), name
    for case in kubernetes_report.cases(1.0):
        able = {each.name for each in kubernetes_run.CONTENDERS if case.needs in each.offers}
        assert len(able & {ON_PODS.name, "fiber-executor-kubernetes"}) == 1, case.name
        assert case.baseline in able, case.name
    vectors = {"vector steps", "cart poles", "first ready"}
    offering = {each.name for each in (*ALL, ON_PODS, RELAYED) if each.offers & vectors}
    assert offering == set(vector_peers._ADAPTERS)
    started = {each.name for each in ALL if each.offers & {"executor", "parallel"}}
    assert started <= set(peers._ADAPTERS)


def test_a_contender_names_the_packages_that_it_lacks() -> None:
    modules = ("no_such_package", "no_such_package.part")
    peer = Contender("x", "X", modules, frozenset(), "#000000", "o")
    assert peer.missing() == "no_such_package, no_such_package.part"


def test_each_contender_is_first_in_turn() -> None:
    assert [rounds.in_turn(ALL[:3], turn)[0] for turn in range(3)] == list(ALL[:3])


def test_rounds_are_as_many_as_the_case_says_and_look_at_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rounds, "LONG", 0.0)
    shares, runs = iter([0.1, 0.2, 0.3]), {"latency": Run({}), "vector": Run({})}
    params, metrics = {"calls": 20, "seconds": 1.0}, latency.cases(0.01)[0].metrics
    short = Case("latency", "once", "", "apply", params, metrics)
    many = Case("latency", "twice", "", "apply", params, metrics, rounds=2)
    (skipped,) = (c for c in vector.cases(1.0) if c.name == vector.cart_poles(4096))
    able = [BASELINE, BY_NAME["async-vector-env"]]
    player = rounds.Rounds(tmp_path, runs, in_use=lambda: next(shares, 0.0))
    player.play([short, many, skipped], able, 3)
    assert len(runs["latency"].series("once", BASELINE.name, "p50")) == 1
    assert len(runs["latency"].series("twice", BASELINE.name, "p50")) == 2
    assert runs["latency"].in_use[0] == 0.1
    assert (runs["vector"].values, runs["vector"].failures) == ({}, {})


def test_a_message_that_memory_has_no_room_for_is_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = {"SC_PHYS_PAGES": 2 << 20, "SC_PAGE_SIZE": 4096}
    monkeypatch.setattr("os.sysconf", memory.__getitem__)
    cases = {case.name: case for case in large_messages.cases(1.0)}
    assert list(cases) == large_messages.CASES
    assert not cases["2 GB, Pipe"].not_run
    assert cases["4 GB, Pipe"].not_run["fiber-loopback"] == "it takes 16 GB of memory"


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add a contender whose workers are threads, so no process must be ended."""
    backend = peers.Joblib(2, None, "threading", lambda: None)

    class Threads(peers.Adapter):
        map = backend.map

        def submit(self, function: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
            return [function(item) for item in items]

        def apply(self, function: Callable[[Any], Any], item: Any) -> object:
            return function(item)

        def close(self) -> None:
            pass

    monkeypatch.setitem(peers._ADAPTERS, "threads", lambda _: Threads())


VECTORS = ("8 CartPoles", "8 that sleep 1 ms", vector.pixels(8), vector.uneven(8))


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize(
    ("measure", "contender", "case"),
    [
        *((executors, "threads", case) for case in executors.cases(0.02)),
        *((parallel_loops, "threads", case) for case in parallel_loops.cases(0.02)),
        *((vector, "sync-vector-env", c) for c in vector.cases(0.02) if c.name in VECTORS),
    ],
    ids=lambda value: value.name if isinstance(value, Case) else "",
)
def test_a_measure_runs_in_process(measure: Any, contender: str, case: Case) -> None:
    assert measure.run(Bench(contender, light=True), **case.params)["rate"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("measure", sorted(kubernetes_report.MEASURES.keys() - MEASURES.keys()))
def test_a_measure_of_pods_runs_without_them(measure: str) -> None:
    module = kubernetes_report.MEASURES[measure]
    for case in module.cases(0.02)[:2]:
        sample = module.run(Bench(BASELINE.name, light=True), **case.params)
        assert set(sample) == {metric.name for metric in case.metrics}
        assert all(value > 0 for value in sample.values())


FIRST_READY = next(
    case for case in vector.cases(0.02) if case.name == vector.uneven(8, first_ready=True)
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [agents.cases(0.002)[0], workers.cases(0.002)[0], FIRST_READY], ids=lambda c: c.measure
)
def test_a_measure_of_fiber_runs_and_leaves_no_process(case: Case, tmp_path: Path) -> None:
    session = Session(BY_NAME["fiber"], tmp_path)
    try:
        sample = session.run(case)
        left = processes.descendants(session.pid)
    finally:
        session.stop()
    assert set(sample) == {metric.name for metric in case.metrics}
    # A few links, as here, may fit into memory that the processes had already.
    assert all(value > 0 for name, value in sample.items() if "memory" not in name), sample
    assert not left or case is FIRST_READY


def test_the_floor_of_a_link_is_measured() -> None:
    floor = link_floor.measure(link_floor.PIECE + 1, rounds=2)
    assert floor.keys() == {"one copy", "seal", "carry", "open"}
    assert min(floor.values()) > 0
    order = Order("127.0.0.1:1", [{"name": "a"}, {"name": "b"}], 3.0)
    assert Order.from_line(order.to_line()) == order


def test_a_fake_agent_runs_the_tasks_of_its_child_and_ends_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The runner replaces these, as its process does nothing else.
    monkeypatch.setattr("benchmarks.tasks.pretend", None)
    monkeypatch.setattr("fiber._agent.worker.time", time)
    monkeypatch.setattr("fiber._agent.batch_results.time", time)
    calls: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
    heard: list[Any] = []
    loop = SimpleNamespace(
        call_soon=lambda call, *args: calls.append((call, args)),
        call_later=lambda _, call, *args: calls.append((call, args)),
    )
    observer = SimpleNamespace(
        started=lambda pid: heard.append("started"),
        received=lambda message: heard.append(pickle.loads(message.payload)),
        recalled=heard.append,
        exited=lambda report: heard.append((report.exitcode, report.host)),
    )
    agent = FakeAgent(loop, "host-1", TaskRunner())  # type: ignore[arg-type]  # all that it uses
    child = agent.child(ChildSpec("w", "fork", b"", b"", tasks=True), observer)
    child.start()
    child.deliver(7, work.pack_calls([(pickle.dumps((no_op, (42,), {})), ())]))
    child.recall()
    child.signal(signal.SIGKILL)
    child.deliver(8, work.STOP_MESSAGE)
    while calls:
        call, args = calls.pop(0)
        call(*args)
    seq, offset, kept, _, values, odd = heard[2]
    assert (seq, offset, kept, values, odd) == (7, 0, None, [42], ())
    assert (heard[:2], heard[3:]) == (
        ["started", (work.READY,)],
        [[], (-signal.SIGKILL, "host-1")],
    )


class FakeRay:
    """Stand-in for Ray's actors, which work when asked."""

    def remote(self, **options: Any) -> Callable[[Any], Any]:
        def method(made: Any, name: str) -> Any:
            def call(*args: Any, **kwargs: Any) -> tuple[Any, ...]:
                # Copies, as Ray makes: environments write each observation to one place.
                *arrays, infos = getattr(made, name)(*args, **kwargs)
                return (*map(np.array, arrays), infos)

            return SimpleNamespace(remote=call)

        def actor(made: Any) -> Any:
            return SimpleNamespace(reset=method(made, "reset"), step=method(made, "step"))

        return lambda cls: SimpleNamespace(
            remote=lambda *args, **kwargs: actor(cls(*args, **kwargs))
        )

    def get(self, references: list[Any]) -> list[Any]:
        return references

    def kill(self, actor: object) -> None:
        pass


def test_actors_of_ray_make_the_steps_of_one_vector(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "ray", lambda workers: FakeRay())
    actors = vector_peers.start("ray-actors", cart_pole, 8, 2, 0)
    alone = SyncVectorEnv([cart_pole] * 8)
    actors.reset(seed=1)
    alone.reset(seed=1)
    alone.action_space.seed(1)
    for _ in range(50):
        actions = alone.action_space.sample()
        for ours, theirs in zip(actors.step(actions), alone.step(actions)[:-1], strict=True):
            np.testing.assert_array_equal(ours, theirs)
    alone.close()


@pytest.fixture
def session(tmp_path: Path) -> Iterator[Session]:
    session = Session(BASELINE, tmp_path)
    yield session
    session.interrupt()


APPLY = (Metric("p50", "p50", "s"),)


@pytest.mark.parametrize(
    ("measure", "params", "said"),
    [
        ("latency", {"calls": 1}, r"TypeError: .*missing 1 required positional argument"),
        ("no_such_measure", {}, "exit status 1: ModuleNotFoundError"),
    ],
    ids=["exception", "death"],
)
def test_the_failure_of_a_contender_is_reported(
    session: Session, measure: str, params: dict[str, Any], said: str
) -> None:
    with pytest.raises(Failed, match=said):
        session.run(Case(measure, "apply", "", "apply", params, APPLY, limit=20.0))


@pytest.mark.slow
def test_a_contender_that_takes_too_long_is_stopped_with_its_workers(session: Session) -> None:
    endless = {"calls": 10**9, "seconds": 600.0}
    with pytest.raises(Failed, match="not finished after 1 s"):
        session.run(Case("latency", "apply", "", "apply", endless, APPLY, limit=1.0))
    assert wait_until(lambda: len(processes.descendants(session.pid)) == 5, PATIENCE)
    pids = session.pid, *processes.descendants(session.pid)
    session.interrupt()
    assert wait_until(lambda: not any(os.path.exists(f"/proc/{pid}") for pid in pids), PATIENCE)
