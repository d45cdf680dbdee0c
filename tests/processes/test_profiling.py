"""Timelines and summaries of whole programs, on each backend."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import fiber
from census import wait_until
from faults.program import Program
from patience import PATIENCE

BACKENDS = ("local", "loopback")

WORK = """
import sys
import fiber

def square(number):
    return number * number

def nested(number):
    with fiber.Pool(1) as pool:
        return pool.apply(square, (number,))

if __name__ == "__main__":
    with fiber.Pool(2) as pool:
        print(sum(pool.map(square, range(100))), flush=True)
        {then}
"""


@pytest.fixture(params=BACKENDS)
def start(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[..., Program]]:
    """Starts a program whose timeline goes into the test's folder."""
    started: list[Program] = []

    def start(then: str = "pass", name: str = "run.json") -> Program:
        env = {
            "FIBER_BACKEND": request.param,
            "FIBER_AGENTS": "1",
            "FIBER_TIMELINE": str(tmp_path / name),
        }
        started.append(Program(WORK.format(then=then), env=env, stdin=subprocess.PIPE))
        return started[-1]

    yield start
    for program in started:
        end_input(program)
        program.close()


def end_input(program: Program) -> None:
    assert program.process.stdin is not None
    program.process.stdin.close()


def trace(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_bytes())
    return found


def tasks_of(path: Path) -> int:
    events = trace(path)["traceEvents"]
    return sum(event["args"]["tasks"] for event in events if event.get("cat") == "work")


@pytest.mark.parametrize(
    ("then", "status"),
    [("pass", 0), ("sys.exit(3)", 3), ("raise KeyError(1)", 1)],
    ids=["return", "exit", "exception"],
)
def test_a_program_writes_its_timeline_however_it_ends(
    then: str, status: int, start: Callable[..., Program], tmp_path: Path
) -> None:
    program = start(then)
    assert program.line() == "328350"
    assert program.wait() == status
    assert tasks_of(tmp_path / "run.json") == 100
    assert trace(tmp_path / "run.json")["otherData"]["name"] == f"program-{program.pid}"
    assert os.listdir(tmp_path) == ["run.json"]
    assert "fiber: " not in program.stderr


def test_children_that_use_fiber_write_none(start: Callable[..., Program], tmp_path: Path) -> None:
    program = start("print(pool.apply(nested, (3,)), pool.map(nested, [1, 2]))")
    program.line()
    assert program.line() == "9 [1, 4]"
    assert program.wait() == 0
    assert os.listdir(tmp_path) == ["run.json"]
    assert tasks_of(tmp_path / "run.json") == 103
    assert program.stderr == ""


def test_two_programs_at_a_time_write_two_files(
    start: Callable[..., Program], tmp_path: Path
) -> None:
    programs = [start("input()") for _ in range(2)]
    for program in programs:
        assert program.line() == "328350"
    for program in programs:
        end_input(program)
        program.wait()
    names = {"run.json", f"run-{programs[1].pid}.json"}
    assert set(os.listdir(tmp_path)) == names
    assert [tasks_of(tmp_path / name) for name in names] == [100, 100]
    assert "another program has written" not in programs[0].stderr
    assert "another program has written" in programs[1].stderr


@pytest.mark.parametrize("name", ["none/run.json", "run.txt"])
def test_a_timeline_that_cannot_be_written_costs_one_line(
    name: str, start: Callable[..., Program], tmp_path: Path
) -> None:
    program = start(name=name)
    assert program.line() == "328350"
    assert program.wait() == 0
    (line,) = program.stderr.splitlines()
    assert line.startswith(f"fiber: no timeline {tmp_path / name}: ")
    assert os.listdir(tmp_path) == []


def test_a_picture_at_the_end(start: Callable[..., Program], tmp_path: Path) -> None:
    program = start(name="run-%p.png")
    program.line()
    assert program.wait() == 0
    assert program.stderr == ""
    (path,) = tmp_path.iterdir()
    assert path.name == f"run-{program.pid}.png"
    assert path.read_bytes().startswith(b"\x89PNG")


# In this process


def work(seconds: float) -> None:
    time.sleep(seconds)


def die(_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.usefixtures("backend")
def test_the_summary_of_a_pool(tmp_path: Path) -> None:
    before = fiber.summary()
    with fiber.Pool(2) as pool:
        pool.map(work, [0.02] * 20, chunksize=1)
        found = fiber.summary()
        fiber.timeline(tmp_path / "run.json")
    assert found.tasks - before.tasks == 20
    (function,) = [one for one in found.functions if one.name == "work"]
    assert function.mean >= 0.02
    assert found.shares.work > 0
    assert tasks_of(tmp_path / "run.json") == found.tasks


@pytest.mark.usefixtures("backend")
@pytest.mark.usefixtures("backend")
def test_each_apply_counts_at_once_and_for_its_function() -> None:
    with fiber.Pool(2) as pool:
        for number in range(50):
            pool.apply(oct, (number,))
            pool.apply(hex, (number,))
        found = fiber.summary()
    tasks = {one.name: one.tasks for one in found.functions}
    assert (tasks["oct"], tasks["hex"]) == (50, 50)


def test_a_task_that_runs_counts_before_its_answer() -> None:
    with fiber.Pool(1) as pool:
        pool.apply(work, (0,))
        before = fiber.summary()
        pool.map_async(work, [3600])
        assert wait_until(
            lambda: fiber.summary().shares.unfinished > before.shares.unfinished, PATIENCE
        )
        pool.terminate()


@pytest.mark.usefixtures("backend")
def test_a_death_is_in_the_summary_and_in_the_timeline(tmp_path: Path) -> None:
    with fiber.Pool(1) as pool, pytest.raises(fiber.WorkerDied):
        pool.map_async(die, [0]).get(PATIENCE)
    deaths = fiber.summary().deaths
    assert "SIGKILL" in deaths[-1].reason
    fiber.timeline(tmp_path / "run.json")
    instants = [e for e in trace(tmp_path / "run.json")["traceEvents"] if e["ph"] == "i"]
    assert any(event["args"].get("reason") == deaths[-1].reason for event in instants)
