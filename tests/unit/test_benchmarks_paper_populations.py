"""Populations that grow and shrink: the work, integrals of steps, demand, the page, bad input."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks.operator_scale.installed import CannotMeasure  # noqa: E402
from benchmarks.paper import (  # noqa: E402
    page,
    populations,
    populations_plan,
    recording,
)
from benchmarks.paper import populations_results as results  # noqa: E402
from benchmarks.paper.populations_results import Held, Open, Sample, Trace  # noqa: E402

# -- The work


def test_environments_are_added_and_the_oldest_dropped() -> None:
    assert list(populations_plan.populations([2, 3, 1, 2])) == [[0, 1], [0, 1, 2], [2], [2, 3]]


def test_the_population_grows_and_shrinks_and_is_the_same_each_time() -> None:
    (phase,) = populations_plan.poet(1.0)
    sizes = [len(wave) for wave in phase.waves]
    peak = sizes.index(phase.peak)
    assert sizes[: peak + 1] == sorted(sizes[: peak + 1])
    assert sizes[peak:] == sorted(sizes[peak:], reverse=True)
    assert sizes[0] < phase.peak > sizes[-1]
    assert populations_plan.poet(1.0) == [phase]


def test_the_work_and_the_bound_of_waves() -> None:
    phase = populations_plan.Phase(gpu=False, waves=[[1.0, 4.0], [2.0], [3.0, 1.0, 2.0]])
    assert (phase.work, phase.bound, phase.peak) == (13.0, 9.0, 3)


def test_a_task_is_a_sum_of_recorded_episodes() -> None:
    seconds = recording.read(recording.WALKER).seconds
    tasks = [task for wave in populations_plan.poet(1.0)[0].waves for task in wave]
    mean = populations_plan.EPISODES * sum(seconds) / len(seconds)
    assert sum(tasks) / len(tasks) == pytest.approx(mean, rel=0.1)
    assert len(set(tasks)) == len(tasks)


def test_exploration_has_no_gpu_and_robustification_has_one() -> None:
    explore, robustify = populations_plan.go_explore(1.0)
    assert (explore.gpu, robustify.gpu) == (False, True)
    assert explore.peak == populations_plan.AT_ONCE
    assert robustify.peak == populations_plan.POLICIES


@pytest.mark.parametrize("size", [0.02, 0.3])
def test_less_work_keeps_the_peak(size: float) -> None:
    for name, plan in populations_plan.plans(size).items():
        whole = populations_plan.plans(1.0)[name]
        assert [phase.peak for phase in plan] == [phase.peak for phase in whole]
        assert sum(phase.work for phase in plan) < 0.2 * sum(phase.work for phase in whole)


# -- Curves


@pytest.mark.parametrize(
    ("steps", "until", "integral"),
    [
        ([], 5.0, 0.0),
        ([(0.0, 2.0)], 5.0, 10.0),
        ([(0.0, 0.0), (1.0, 3.0), (2.0, 1.0)], 4.0, 5.0),
        ([(0.0, 1.0), (2.0, 4.0)], 1.5, 1.5),  # changes after the end do not count
        ([(1.0, 2.0), (1.0, 3.0)], 2.0, 3.0),  # the last value of a moment
    ],
)
def test_the_integral_of_steps(
    steps: list[tuple[float, float]], until: float, integral: float
) -> None:
    assert results.area(steps, until) == pytest.approx(integral)


def pod(phase: str, node: str | None = "node-1", gpus: str | None = None) -> dict[str, Any]:
    resources: dict[str, Any] = {"requests": {"cpu": "50m"}}
    if gpus:
        resources["limits"] = {"nvidia.com/gpu": gpus}
    containers = [{"resources": resources}, {}]
    place = {"nodeName": node} if node else {}
    return {"spec": {"containers": containers, **place}, "status": {"phase": phase}}


def test_a_pod_holds_room_from_its_node_to_its_end() -> None:
    assert results.held(pod("Pending", node=None)) is None
    assert results.held(pod("Pending")) == Held(0.05, 0)
    assert results.held(pod("Running", gpus="1")) == Held(0.05, 1)
    assert results.held(pod("Succeeded")) is None
    assert results.held(pod("Failed")) is None


@pytest.mark.parametrize(
    ("quantity", "number"), [("2", 2.0), ("1.5", 1.5), ("250m", 0.25), ("0", 0.0), ("1k", 1000.0)]
)
def test_a_quantity_of_processors(quantity: str, number: float) -> None:
    assert results.processors(quantity) == pytest.approx(number)


def test_samples_follow_the_pods() -> None:
    alone, with_gpu = Held(0.05, 0), Held(0.1, 1)
    changes = [
        (10.5, "a", alone),
        (11.5, "a", alone),  # nothing new
        (12.0, "b", with_gpu),
        (13.0, "a", None),
        (13.5, "a", None),
        (14.0, "b", None),
    ]
    assert results.samples(changes, 10.0) == [
        Sample(0.0, 0, 0, 0.0, 0),
        Sample(0.5, 1, 0, 0.05, 0),
        Sample(2.0, 2, 1, 0.15, 1),
        Sample(3.0, 1, 1, 0.1, 1),
        Sample(4.0, 0, 0, 0.0, 0),
    ]


def test_demand_begins_when_the_program_does() -> None:
    events = [("begin", 5.0, 0), ("open", 5.5, 3), ("open", 7.0, 2), ("end", 8.25, 0)]
    assert results.demand(events) == (5.0, 3.25, [Open(0.5, 3), Open(2.0, 2)])


def trace(pods: int, wall: float, gpus: int = 0) -> Trace:
    return Trace(
        wall=wall,
        bound=wall - 2,
        until=wall + 2,
        work=wall,
        demand=[Open(0.0, 2), Open(wall, 0)],
        samples=[
            Sample(0.0, pods, gpus, pods * 0.05, gpus),
            Sample(wall + 2, 0, 0, 0.0, 0),
        ],
        load_before=0.5,
        in_use=0.25,
    )


def test_pods_count_until_the_end_of_the_program() -> None:
    found = trace(4, 10.0, gpus=1)
    assert found.processor_seconds == pytest.approx(2.0)
    assert found.gpu_seconds == 10.0
    assert found.most_pods == 4
    assert found.at_work == 0.25


def test_processor_seconds_grow_until_the_end_of_the_program() -> None:
    samples = [Sample(0.0, 0, 0, 0.0, 0), Sample(2.0, 1, 0, 0.5, 0), Sample(9.0, 0, 0, 0.0, 0)]
    found = dataclasses.replace(trace(1, 6.0), samples=samples)
    assert found.growth == [(0.0, 0.0), (2.0, 0.0), (6.0, 2.0)]


# -- Page


def some_results() -> results.Results:
    about = {
        "date": "today",
        "command": "a command",
        "cores": 2,
        "processor": "a processor",
        "memory": "1 GB",
        "load": 0.5,
        "system": "Linux",
        "python": "3.11",
        "versions": {"fiber": "1.0"},
        "kubernetes": "v1.34",
        "nodes": 2,
        "cpu_request": 0.05,
    }
    traces = {
        "poet": {"dynamic": trace(3, 22.0), "static": trace(6, 20.0)},
        "go-explore": {"dynamic": trace(3, 20.0, gpus=1), "static": trace(6, 20.0, gpus=2)},
    }
    return results.Results(about, traces)


def test_results_are_read_as_they_were_written(tmp_path: Path) -> None:
    results.write(tmp_path, some_results())
    assert results.load(tmp_path) == some_results()


def test_the_table_has_the_ratios() -> None:
    text = results.text(some_results())
    assert "| POET-like, dynamic | 22.0 s | 20.0 s | 3 | 3.3 |  | 33 % |" in text
    assert "| POET-like, dynamic / static | 1.10x |  |  | 0.55x |  |  |" in text
    assert "| Go-Explore-like, dynamic / static | 1.000x |  |  | 0.50x | 0.50x |  |" in text
    assert "Load before the runs: 0.5, 0.5, 0.5, 0.5." in text


def test_the_page_without_these_results_stays(tmp_path: Path) -> None:
    assert page.generated(tmp_path, {}) == {}
    results.write(tmp_path, some_results())
    assert page.generated(tmp_path, {}) == {"populations": results.text(some_results())}


# -- Bad input


def said(capsys: pytest.CaptureFixture[str]) -> str:
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_no_kubeconfig_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("KUBECONFIG", raising=False)
    monkeypatch.setenv("FIBER_IMAGE", "an-image")
    assert populations.main([]) == 1
    line = said(capsys)
    assert "KUBECONFIG is not set" in line
    assert "--set-up" in line


def test_no_image_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("FIBER_IMAGE", raising=False)
    assert populations.main([]) == 1
    line = said(capsys)
    assert "FIBER_IMAGE is not set" in line
    assert 'eval "$(make -s cluster)"' in line


def test_a_missing_recording_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def missing(name: str) -> None:
        raise recording.BadRecording(f"there is no recording {name}: a command makes it")

    monkeypatch.setattr(recording, "read", missing)
    assert populations.main([]) == 1
    assert "there is no recording" in said(capsys)


def node(gpus: str | None) -> dict[str, Any]:
    return {"status": {"allocatable": {"cpu": "2", **({"nvidia.com/gpu": gpus} if gpus else {})}}}


@pytest.mark.parametrize(
    ("gpus", "why"), [([None, None], "no node has a GPU"), (["1", None], "the nodes have 1")]
)
def test_too_few_gpus_are_one_line(gpus: list[str | None], why: str) -> None:
    with pytest.raises(CannotMeasure, match=why) as caught:
        populations.check_gpus([node(each) for each in gpus], 2)
    assert "2 are needed" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_enough_gpus_may_be_on_several_nodes() -> None:
    populations.check_gpus([node("1"), node("1"), node(None)], 2)


def test_events_of_the_program_are_lines_of_json(capsys: pytest.CaptureFixture[str]) -> None:
    from benchmarks.paper import populations_program

    class Pool:
        def imap_unordered(self, function: Any, wave: list[float], chunksize: int) -> list[None]:
            return [function(seconds) for seconds in wave]

    populations_program.play_phase(Pool(), {"gpu": False, "waves": [[0.0, 0.0], [0.0]]})
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(name, number) for name, _, number in events] == [
        ("open", 2),
        ("open", 1),
        ("open", 0),
        ("open", 1),
        ("open", 0),
    ]
