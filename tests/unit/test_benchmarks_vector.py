"""The measures of vector environments, executors and joblib's loops, and who takes part in them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks import (  # noqa: E402
    budgets,
    contenders,
    executors,
    parallel_loops,
    peers,
    report,
    rounds,
    vector,
    vector_peers,
)
from benchmarks.contender import Bench  # noqa: E402
from benchmarks.environment import cart_pole  # noqa: E402
from benchmarks.model import Case, Run  # noqa: E402
from benchmarks.session import Session, _environment  # noqa: E402

from unit.benchmark_runs import about  # noqa: E402

ABOUT = about()
MANY = vector.cart_poles(4096)


def case_of(measure: Any, name: str, size: float = 0.02) -> Case:
    return next(case for case in measure.cases(size) if case.name == name)


# Skipped cases


def test_thousands_of_processes_are_not_run_and_the_table_says_so() -> None:
    run = Run(dict(ABOUT))
    run.add(MANY, "fiber", 0, {vector.RATE.name: 100_000.0})
    rows = [line for line in report.page("vector", run).splitlines() if "4,096 processes" in line]
    assert rows[:2] == [
        "|  | AsyncVectorEnv | not run: 4,096 processes |  |  |  |  |",
        "|  | SubprocVecEnv | not run: 4,096 processes |  |  |  |  |",
    ]
    assert len(rows) == 2 * 4  # CartPoles, and the three others that have a process each


def test_skipped_contenders_are_not_started(tmp_path: Path) -> None:
    case, runs = case_of(vector, MANY, 1.0), {"vector": Run(dict(ABOUT))}
    contender = contenders.BY_NAME["async-vector-env"]
    assert case.needs in contender.offers
    rounds.Rounds(tmp_path, runs, in_use=lambda: 0.0).play([case], [contender], 1)
    assert (runs["vector"].values, runs["vector"].failures) == ({}, {})
    assert not list(tmp_path.iterdir())


# What ratios are to


def test_a_ratio_is_to_the_baseline_of_its_case() -> None:
    run = Run(dict(ABOUT))
    for name, rate in (("fiber-executor", 60e3), ("concurrent.futures", 10e3), ("loky", 5e3)):
        run.add(executors.SUBMIT, name, 0, {executors.RATE.name: rate})
    page = report.page("executors", run)
    assert "The ratio is to concurrent.futures in the same round" in page
    assert "| 60,000 /s | one round | 6.00x | ≥ 5x; ≥ 5x loky | met; met |" in page
    assert "| concurrent.futures | 10,000 /s | one round | — |" in page


def test_budgets_of_the_vector_are_on_its_sixty_four_environments() -> None:
    found = {
        (each.what, each.contender, each.against, each.to_case, each.bound)
        for each in budgets.BUDGETS
        if each.measure == "vector"
    }
    assert found == {
        ("vector: 64 CartPoles", "fiber", "async-vector-env", "", 3),
        ("vector: 64 CartPoles", "fiber", "pufferlib", "", 1),
        (
            "vector: uneven steps, first ready to waiting for all",
            "fiber",
            "multiprocessing",
            "64 uneven ones",
            1.5,
        ),
        (
            "vector: loopback to local, 64 with 84x84x4 bytes",
            "fiber-loopback",
            "fiber",
            "",
            0.5,
        ),
    }


# Measures, as small as they go


@pytest.mark.parametrize(
    "name", ["8 CartPoles", "8 that sleep 1 ms", vector.pixels(8), vector.uneven(8)]
)
def test_a_vector_is_stepped_for_the_time(name: str) -> None:
    sample = vector.run(Bench("sync-vector-env", light=True), **case_of(vector, name).params)
    assert sample["rate"] > 0


def test_the_first_three_steps_are_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(100))
    monkeypatch.setattr(vector, "time", SimpleNamespace(perf_counter=lambda: next(clock) * 0.1))
    made: list[None] = []
    # Four looks at the clock for the first three, one at the begin, then one after each step.
    assert vector._rate(lambda: made.append(None), 8, 2.0) == pytest.approx(8 / 0.1)
    assert len(made) == 3 + 20


def test_steps_as_long_as_the_measure_are_made_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(100))
    monkeypatch.setattr(vector, "time", SimpleNamespace(perf_counter=lambda: float(next(clock))))
    made: list[None] = []
    assert vector._rate(lambda: made.append(None), 8, 1.0) == pytest.approx(8.0)
    assert len(made) == 2


def test_fiber_sends_ready_environments_first(tmp_path: Path) -> None:
    session = Session(contenders.BY_NAME["fiber"], tmp_path)
    try:
        sample = session.run(case_of(vector, vector.uneven(8, first_ready=True)))
    finally:
        session.stop()
    assert sample["rate"] > 0


@pytest.mark.parametrize("name", [case.name for case in executors.cases(0.02)])
def test_an_executor_runs_its_tasks(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with_threads(monkeypatch)
    sample = executors.run(Bench("threads", light=True), **case_of(executors, name).params)
    assert sample["rate"] > 0


@pytest.mark.parametrize("name", [case.name for case in parallel_loops.cases(0.02)])
def test_a_loop_runs_its_tasks(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with_threads(monkeypatch)
    case = case_of(parallel_loops, name)
    sample = parallel_loops.run(Bench("threads", light=True), **case.params)
    assert sample["rate"] > 0


def test_contenders_with_servers_get_a_tenth_of_the_no_ops(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(executors, "rate", lambda batch, tasks: float(asked.append(tasks) or 1))
    with_threads(monkeypatch)
    for seconds in (0.0, 0.001):
        for light in (True, False):
            executors.run(Bench("threads", light=light), 0, seconds, 5000)
    assert asked == [5000, 500, 5000, 5000]


def with_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use a contender whose workers are threads, so no process must be ended."""
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


# Peers


class FakeRay:
    """Stand-in for Ray's actors, which work when asked; the last one is ready first."""

    def remote(self, **options: Any) -> Callable[[Any], Any]:
        def actor(made: Any) -> Any:
            def method(name: str) -> Any:
                return SimpleNamespace(
                    remote=lambda *args, **kwargs: Reference(getattr(made, name)(*args, **kwargs))
                )

            return SimpleNamespace(reset=method("reset"), step=method("step"))

        return lambda cls: SimpleNamespace(
            remote=lambda *args, **kwargs: actor(cls(*args, **kwargs))
        )

    def get(self, references: list[Reference]) -> list[Any]:
        return [reference.value for reference in references]

    def wait(
        self, references: list[Reference], num_returns: int
    ) -> tuple[list[Reference], list[Reference]]:
        return references[-num_returns:], references[:-num_returns]

    def kill(self, actor: object) -> None:
        pass


class Reference:
    def __init__(self, value: Any) -> None:
        # A copy, as Ray makes one: environments write their next observations to the same place.
        self.value = (*(np.array(each) for each in value[:-1]), value[-1])


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
    assert actors.action_space == alone.action_space
    alone.close()


def test_actors_of_ray_get_their_actions_in_the_order_of_the_batch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(peers, "ray", lambda workers: FakeRay())
    actors = vector_peers.start("ray-actors", cart_pole, 8, 4, 4)
    alone = SyncVectorEnv([cart_pole] * 8)
    first, _ = alone.reset(seed=1)
    actors.reset_async(seed=1)
    (observations,) = actors.recv(4)
    np.testing.assert_array_equal(observations, first[4:])
    actions = np.array([0, 1, 1, 0])
    actors.send(actions)
    expected = alone.step(np.array([0, 0, 0, 0, 0, 1, 1, 0]))[0]
    np.testing.assert_array_equal(actors.recv(4)[0], expected[4:])
    actors.send(actions)
    # The slow ones are there at last, with those that have made a step.
    assert len(actors.recv(8)[0]) == 8
    alone.close()


def test_missing_packages_that_are_only_imported_have_stand_ins(tmp_path: Path) -> None:
    for names, there in ((("no_such_module",), True), (("json",), False), ((), False)):
        peer = contenders.Contender("x", "X", (), frozenset(), "#000000", "o", by_name=names)
        path = _environment(peer, tmp_path)["PYTHONPATH"]
        assert path.endswith("tests/stand_ins") is there, names


def test_each_contender_of_a_measure_has_an_adapter() -> None:
    vectors = {
        each.name
        for each in (*contenders.ALL, contenders.ON_PODS)
        if each.offers & {"vector steps", "cart poles", "first ready"}
    }
    assert vectors == set(vector_peers._ADAPTERS)
    started = {each.name for each in contenders.ALL if each.offers & {"executor", "parallel"}}
    assert started <= set(peers._ADAPTERS)
