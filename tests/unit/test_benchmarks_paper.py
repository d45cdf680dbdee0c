"""The paper's experiments: the bound of list scheduling, recordings, PPO's arithmetic, the page."""

from __future__ import annotations

import json
import pickle
import shutil
import sys
import time
from pathlib import Path
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks import fake_agents, tasks  # noqa: E402
from benchmarks.model import Run  # noqa: E402
from benchmarks.paper import (  # noqa: E402
    atari,
    breakout,
    command,
    evolution,
    packages,
    page,
    parts,
    ppo,
    recording,
    walker,
)
from benchmarks.paper.schedule import list_schedule  # noqa: E402

from fiber._agent import batch_results, worker  # noqa: E402
from fiber._wire import work  # noqa: E402
from fiber._wire.packet import Message  # noqa: E402

# -- The bound


@pytest.mark.parametrize(
    ("seconds", "workers", "end"),
    [
        ([3.0, 2.0, 2.0, 1.0], 2, 4.0),  # 3 + 1 beside 2 + 2
        ([1.0, 1.0, 4.0], 2, 5.0),  # in the order of the list: the long one comes last
        ([1.0, 2.0], 8, 2.0),
        ([1.0, 2.0], 1, 3.0),
        ([], 3, 0.0),
    ],
)
def test_each_idle_worker_takes_the_next_task(
    seconds: list[float], workers: int, end: float
) -> None:
    assert list_schedule(seconds, workers) == end


def test_a_schedule_needs_a_worker() -> None:
    with pytest.raises(ValueError, match="at least 1, not 0"):
        list_schedule([1.0], 0)


def test_more_workers_have_a_lower_bound_and_the_same_episodes() -> None:
    bounds = [evolution.bound(1, 256, workers) for workers in (16, 64, 256)]
    jobs = evolution.population_of(0, 256)
    assert sorted(bounds, reverse=True) == bounds
    assert bounds[-1] == max(job.seconds for job in jobs)
    assert bounds[0] >= sum(job.seconds for job in jobs) / 16
    assert jobs == evolution.population_of(0, 256) != evolution.population_of(1, 256)


def test_both_halves_of_a_pair_have_the_same_noise() -> None:
    jobs = evolution.population_of(0, 64)
    for plus, minus in zip(jobs[::2], jobs[1::2], strict=True):
        assert (plus.noise_index, plus.sign, minus.sign) == (minus.noise_index, 1, -1)


# -- Recordings


def written(folder: Path, **changes: object) -> Path:
    fields: dict[str, object] = {
        "environment": "an environment",
        "how": "somehow",
        "command": "a command",
        "machine": "a machine",
        "microseconds": [1000, 2500],
        "steps": [10, 25],
    }
    text = json.dumps({**fields, **changes})
    (folder / "some.json").write_text(text, encoding="utf-8")
    return folder


def test_a_recording_is_read_in_seconds(tmp_path: Path) -> None:
    assert recording.read("some", written(tmp_path)).seconds == [0.001, 0.0025]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"microseconds": [], "steps": []}, "it has no times"),
        ({"microseconds": [5, 0]}, "a time is not positive"),
        ({"steps": [1]}, "other numbers of steps"),
        ({"pace": 1}, "unexpected keyword argument"),
    ],
)
def test_a_bad_recording_says_how_to_make_another(
    tmp_path: Path, changes: dict[str, object], why: str
) -> None:
    with pytest.raises(recording.BadRecording, match=why) as caught:
        recording.read("some", written(tmp_path, **changes))
    assert "python -m benchmarks.paper.record" in str(caught.value)


def test_a_missing_recording_says_how_to_make_it(tmp_path: Path) -> None:
    with pytest.raises(recording.BadRecording, match="there is no recording"):
        recording.read("other", tmp_path)


@pytest.mark.parametrize("name", [recording.WALKER, recording.BREAKOUT])
def test_the_recordings_of_the_repository_are_whole(name: str) -> None:
    found = recording.read(name)
    assert len(found.seconds) >= 200
    assert found.command.startswith("python -m benchmarks.paper.record --")


# -- Fake children that are busy


class Loop:
    """Loop that runs calls at once, and delayed ones when it is told."""

    def __init__(self) -> None:
        self.later: list[tuple[float, Any]] = []

    def call_soon(self, function: Any, *arguments: Any) -> None:
        function(*arguments)

    def call_later(self, seconds: float, function: Any, *arguments: Any) -> None:
        self.later.append((seconds, lambda: function(*arguments)))


class Runner:
    """Runner whose tasks take the seconds that their payload says, and that answers with them."""

    def run(self, message: Message) -> tuple[list[fake_agents.Answer], float, bool]:
        payload = bytes(message.payload[work.SEQ.size :])
        return [(payload, ())], float(payload), True


def test_a_busy_child_answers_and_goes_on_when_its_task_ends() -> None:
    loop, observer = Loop(), Mock()
    agent = fake_agents.FakeAgent(cast(Any, loop), "a host", cast(Any, Runner()))
    child = agent.child(Mock(), observer)

    def answers() -> list[bytes]:
        return [bytes(call.args[0].payload) for call in observer.received.mock_calls]

    for seq, payload in enumerate((b"0", b"2", b"3", b"4")):
        child.deliver(seq, payload)
    assert answers() == [b"0"]
    child.recall()
    observer.recalled.assert_called_once_with([2, 3])
    child.deliver(4, b"5")
    for seconds in (2.0, 5.0):
        (after, run) = loop.later.pop()
        assert after == seconds
        run()
    assert answers() == [b"0", b"2", b"5"]
    assert not loop.later


def _pretend(seconds: float) -> None:
    tasks.pretend(seconds)


def test_the_clock_of_a_worker_includes_the_seconds_that_its_tasks_pretend(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A pool that is told of tasks without a duration sends several to a worker, one after
    the other, while other workers wait."""
    monkeypatch.setattr(tasks, "pretend", tasks.pretend)
    for module in (worker, batch_results):
        monkeypatch.setattr(module, "time", time)
    runner = fake_agents.TaskRunner()
    call = pickle.dumps((_pretend, (1000.0,), {}))
    payload = work.SEQ.pack(1) + work.pack_calls([(call, ())])
    answers, seconds, goes_on = runner.run(Message(memoryview(payload), [], []))
    assert (seconds, goes_on) == (1000.0, True)
    ((answer, _),) = answers
    took = pickle.loads(answer)[3]
    assert 1000.0 <= took < 1100.0


# -- Learning


def test_advantages_end_where_a_game_ends() -> None:
    rewards = np.array([[0.0], [1.0], [0.0]], np.float32)
    values = np.zeros((4, 1), np.float32)
    goes_on = np.array([[1.0], [0.0], [1.0]], np.float32)
    found = ppo.advantages(rewards, values, goes_on)
    assert found.ravel() == pytest.approx([ppo.DISCOUNT * ppo.SMOOTHING, 1.0, 0.0])


def test_the_policy_learns_the_action_that_pays() -> None:
    learner = ppo.Learner(np.random.default_rng(1))
    features = np.ones((256, ppo.FEATURES), np.float32)
    for _ in range(5):
        actions, chances, _ = learner.act(features)
        paid = (actions == 2).astype(np.float32)
        learner.learn(features, actions, chances, paid, paid)
    actions, _, _ = learner.act(features)
    assert (actions == 2).mean() > 0.5


def test_a_frame_is_reduced_to_means() -> None:
    frames = np.zeros((2, atari.SIDE, atari.SIDE, 1), np.uint8)
    frames[1, :4, 4:8] = 255
    means = ppo.reduced(frames)
    assert means.shape == (2, ppo.FEATURES // 2)
    assert means[1, 1] == 1.0
    assert means.sum() == 1.0


def test_the_walker_moves_to_the_better_half() -> None:
    noise = np.zeros((2, 4, 24))
    noise[0, 0, 0] = noise[1, 1, 1] = 1.0
    returns = np.array([[10.0, 0.0], [1.0, 2.0]])
    moved = walker.improved(np.zeros((4, 24)), noise, returns)
    assert moved[0, 0] > 0
    assert np.count_nonzero(moved) == 1


# -- Command and page


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--only", "poet"], "invalid choice: 'poet'"),
        (["--contenders", "slurm"], "no contender 'slurm'; there are fiber,"),
        (["--rounds", "0"], "0 is less than 1"),
        (["--size", "2"], "2 is not above 0 and up to 1"),
        (["--minutes", "nan"], "nan is not a number of minutes, 0 or more"),
        (["--minutes", "ten"], "ten is not a number of minutes, 0 or more"),
        (["--minutes", "-1"], "-1 is not a number of minutes, 0 or more"),
    ],
)
def test_a_wrong_argument_is_refused(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        command.main(arguments)
    assert caught.value.code == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("part", "module", "install"),
    [
        ("breakout", "ale_py", "ale-py"),
        ("walker", "gymnasium", "gymnasium[box2d]"),
    ],
)
def test_a_missing_package_is_one_line(
    part: str,
    module: str,
    install: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    assert command.main(["--only", part]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "is not installed" in line
    assert f"pip install '{install}'" in line


def test_a_missing_cluster_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("FIBER_IMAGE", raising=False)
    assert command.main(["--only", "overhead", "--contenders", "fiber-kubernetes"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "needs a cluster: set KUBECONFIG and FIBER_IMAGE" in line


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["breakout", "--contenders", "dask"], "part breakout has no contender dask; it has fiber"),
        (["evolution", "--workers", "33"], "part evolution has no case with 33 workers; it has 32"),
    ],
)
def test_a_part_without_anything_to_measure_is_one_line(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command.main(["--only", *arguments, "--output", str(tmp_path)]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert [line for line in lines if line.startswith(said)] == [lines[-1]]
    assert not list(tmp_path.iterdir())


def test_a_walker_that_fails_leaves_what_was_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    written: list[list[str]] = []
    monkeypatch.setattr(command, "_problems", lambda *_: [])
    monkeypatch.setattr(command, "_measure", lambda *_: Run({}))
    monkeypatch.setattr(command, "_write", lambda _folder, runs: written.append(list(runs)))
    monkeypatch.setattr("benchmarks.processes.adopt_orphans", lambda: None)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    monkeypatch.setattr("subprocess.call", lambda *_, **__: 3)
    arguments = ["--only", "overhead", "walker", "--output", str(tmp_path)]
    assert command.main(arguments) == 1
    assert written == [["overhead"], ["overhead"]]
    assert "the walker failed with status 3" in capsys.readouterr().err


def test_contenders_leave_out_more_processes_than_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1})
    out = {case.params["workers"]: set(case.not_run) for case in evolution.cases(0.02)}
    assert not out[64]
    assert out[128] == out[256] == {"ipyparallel", "ray", "dask"}
    assert out[2048] == out[512] == {*out[128], "fiber", "multiprocessing"}


def test_pods_take_part_if_they_are_named() -> None:
    part = parts.PARTS["overhead"]
    names = {each.name for each in parts.contenders_of(part, None)}
    assert {"fiber", "fiber-loopback", "multiprocessing", "spark", "ray"} <= names
    assert "fiber-kubernetes" not in names
    chosen = parts.contenders_of(part, ["ray", "fiber-kubernetes"])
    assert [each.name for each in chosen] == ["ray", "fiber-kubernetes"]


def test_only_marked_text_is_filled() -> None:
    text = "a\n<!-- one: begin (made) -->\nold\n<!-- one: end -->\nb\n"
    filled = page.filled(text, {"one": "new", "two": "other"})
    assert filled == "a\n<!-- one: begin (made) -->\n\nnew\n\n<!-- one: end -->\nb\n"
    assert page.filled(filled, {"one": "new"}) == filled
    assert page.filled(text, {}) == text


def test_the_page_has_the_figures_of_the_results() -> None:
    texts = page.generated(page.FOLDER, page.load(page.FOLDER))
    written = page.PAGE.read_text(encoding="utf-8")
    assert page.filled(written, texts) == written, "python -m benchmarks.paper writes the page"
    assert texts
    for name in texts:
        assert texts[name] in written
        assert name.endswith(page.PODS) or (page.FOLDER / f"{name}.png").exists()


def test_runs_with_a_cluster_have_tables_of_their_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / page.PODS).mkdir()
    shutil.copy(page.FOLDER / page.RESULTS, tmp_path / page.PODS)
    written = tmp_path / "page.md"
    written.write_text("<!-- evolution_pods: begin -->\n<!-- evolution_pods: end -->\n")
    monkeypatch.setattr(page, "FOLDER", tmp_path)
    monkeypatch.setattr(page, "PAGE", written)
    assert page.write(tmp_path / page.PODS, {}) == written
    assert "| 32 |" in written.read_text(encoding="utf-8")


def test_the_names_of_the_cases_tell_the_kind_of_steps() -> None:
    names = [case.name for case in breakout.cases(1.0)]
    assert names[0] == breakout.played(8)
    assert names[1:] == [breakout.recorded(count) for count in breakout.WORKERS]
    assert recording.read(recording.BREAKOUT).environment == packages.BREAKOUT
