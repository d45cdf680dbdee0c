"""The command on programs of this machine: ``fiber ps``, ``logs``, ``stop`` and ``stack``."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from census import wait_until
from faults.program import Program, stop_and_wait
from fiber._monitor import client
from patience import PATIENCE
from unit.pool_command_rig import run

_SCRIPT = """
import time, fiber

def hang():
    time.sleep(3600)

if __name__ == "__main__":
    fiber.Process(target=hang, name="Simulator", daemon=True).start()
    print("begun", flush=True)
    hang()
"""


_SCRIPT_WITH_TWO_RUNTIMES = """
import fiber
from fiber._runtime.state import shutdown

if __name__ == "__main__":
    for _ in range(2):
        process = fiber.Process(target=print, args=("begun",))
        process.start()
        process.join()
        input()
        shutdown()
"""


pytestmark = pytest.mark.usefixtures("only_this_machine")


@pytest.fixture
def start() -> Iterator[Callable[..., Program]]:
    """Starts a program that hangs in a process."""
    started: list[Program] = []

    def start(**options: Any) -> Program:
        started.append(Program(_SCRIPT, **options))
        return started[-1]

    yield start
    for program in started:
        program.close()


@pytest.fixture
def program(start: Callable[..., Program]) -> Program:
    made = start()
    assert made.line() == "begun"
    return made


def name_of(program: Program) -> str:
    return f"program-{program.pid}"


def test_a_program_is_listed(program: Program) -> None:
    (row,) = json.loads(run("ps", "--output", "json").out)
    facts = ("name", "state", "workers", "pid", "job")
    assert [row[key] for key in facts] == [name_of(program), "running", 1, program.pid, False]
    assert row["command"].endswith(str(program.script))
    assert row["created"].endswith("Z")
    assert name_of(program) in run("ps").out


def test_a_program_is_listed_although_the_cluster_does_not_answer(
    program: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "config").write_text("nonsense")
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "config"))
    outcome = run("ps")
    assert outcome.status == 4
    assert name_of(program) in outcome.out
    assert "cannot connect to a cluster" in outcome.err


def test_a_program_is_listed_again_after_its_runtime_has_ended() -> None:
    program = Program(_SCRIPT_WITH_TWO_RUNTIMES, stdin=subprocess.PIPE)
    stdin = program.process.stdin
    assert stdin is not None
    try:
        for _ in range(2):
            assert program.line() == "begun"
            (row,) = json.loads(run("ps", "--output", "json").out)
            assert (row["state"], row["pid"]) == ("running", program.pid)
            stdin.write(b"\n")
            stdin.flush()
    finally:
        program.close()
        stdin.close()


def test_no_program_is_listed_without_an_error() -> None:
    outcome = run("ps")
    assert outcome == (0, "", "no program runs on this machine\n")


@pytest.mark.parametrize("command", ["logs", "stop", "stack"])
def test_an_unknown_program_is_named_with_the_nearest_one(program: Program, command: str) -> None:
    outcome = run(command, f"progam-{program.pid}")
    assert outcome.status == 3
    assert f"there is no program 'progam-{program.pid}'" in outcome.err
    assert f"did you mean {name_of(program)!r}?" in outcome.err


def test_a_stopped_program_is_listed_as_silent(
    program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fiber._cli.local._PATIENCE", 0.05)
    name = name_of(program)
    stop_and_wait(program.pid)
    try:
        (row,) = json.loads(run("ps", "--output", "json").out)
        assert (row["state"], row["name"], row["pid"]) == ("silent", name, program.pid)
    finally:
        os.kill(program.pid, signal.SIGCONT)


def test_a_program_is_asked_to_end(program: Program) -> None:
    name = name_of(program)
    assert run("stop", name) == (0, f"asked the program {name!r} to end\n", "")
    assert program.process.wait(PATIENCE) == -signal.SIGTERM


def test_a_program_is_killed_by_its_pid(program: Program) -> None:
    outcome = run("stop", str(program.pid), "--now")
    assert outcome == (0, f"killed the program {name_of(program)!r}\n", "")
    assert program.process.wait(PATIENCE) == -signal.SIGKILL


def test_the_stacks_of_a_program_and_its_process_are_shown(program: Program) -> None:
    def shows_both() -> bool:
        return run("stack", name_of(program)).out.count(" in hang\n") == 2

    assert wait_until(shows_both, PATIENCE)
    out = run("stack", name_of(program)).out
    assert out.startswith(f"program (pid {program.pid})\nThread MainThread")
    assert "\nSimulator (pid " in out


def test_the_stack_of_one_worker_is_shown(program: Program) -> None:
    outcome = run("stack", name_of(program), "--worker", "Simulator", "--output", "json")
    (stack,) = json.loads(outcome.out)
    assert (stack["name"], stack["state"]) == ("Simulator", "running")


def test_the_state_of_the_only_program_is_shown(program: Program) -> None:
    outcome = run("top", "--once")
    assert outcome.status == 0, outcome.err
    assert outcome.out.startswith(name_of(program))
    assert "RUNNING" in outcome.out


def test_a_state_without_a_name_needs_one_program() -> None:
    outcome = run("top", "--once")
    assert outcome.status == 1
    assert "no programs run on this machine" in outcome.err


def test_an_unknown_worker_is_named_with_the_nearest_one(program: Program) -> None:
    outcome = run("stack", name_of(program), "--worker", "Simulatr")
    assert outcome.status == 3
    assert "there is no worker 'Simulatr'" in outcome.err
    assert "did you mean 'Simulator'?" in outcome.err


def test_the_log_of_a_program_is_the_file_that_it_writes_to(
    start: Callable[..., Program], tmp_path: Path
) -> None:
    with (tmp_path / "log").open("wb") as log:
        program = start(stdout=log)
    assert wait_until(lambda: "begun" in (tmp_path / "log").read_text(), PATIENCE)
    name = name_of(program)
    following = subprocess.Popen(
        [sys.executable, "-m", "fiber._cli.main", "logs", name, "--follow"], stdout=subprocess.PIPE
    )
    assert following.stdout is not None
    assert following.stdout.readline() == b"begun\n"
    outcome = run("logs", name, "--since", "5m")
    program.process.kill()
    assert following.stdout.read() == b""
    following.stdout.close()
    assert following.wait(PATIENCE) == 0
    assert outcome.status == 2
    assert "--since is for programs in pods" in outcome.err


def test_the_log_of_a_worker_is_its_file(start: Callable[..., Program], tmp_path: Path) -> None:
    program = start(env={"FIBER_LOG_TO": str(tmp_path / "logs")})
    name = name_of(program)
    assert program.line() == "begun"
    path = tmp_path / "logs" / f"{name}.Simulator.log"
    path.write_text("an earlier one\n")
    os.utime(path, (1, 1))
    path.with_suffix(".2.log").write_text("step 1\n")
    command = [sys.executable, "-m", "fiber._cli.main", "logs", name, "--worker", "Simulator"]
    assert subprocess.check_output(command) == b"step 1\n"
    outcome = run("logs", name, "--worker", "Simulater")
    assert outcome.status == 3
    assert "choose one of Simulator" in outcome.err


def test_without_files_the_workers_of_a_program_share_its_log(program: Program) -> None:
    outcome = run("logs", name_of(program), "--worker", "Simulator")
    assert outcome.status == 2
    assert 'fiber.init(log_to="logs")' in outcome.err


def test_a_program_whose_output_is_no_file_has_no_log(program: Program) -> None:
    outcome = run("logs", name_of(program))
    assert outcome.status == 1
    assert f"there is no log of {name_of(program)!r}" in outcome.err
    assert "its output goes to pipe:" in outcome.err


def test_programs_are_asked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    both = threading.Barrier(2, timeout=PATIENCE)

    def silent(path: str) -> None:
        both.wait()

    monkeypatch.setattr(client, "sockets", lambda _: ["first", "second"])
    monkeypatch.setattr("fiber._cli.local._program", silent)
    assert run("ps").err == "no program runs on this machine\n"


def test_a_worker_of_one_of_a_pods_programs_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    stack = {"name": "Simulator", "pid": 7, "text": "here"}
    lines = [{"unknown": "Simulator", "names": ["Other"]}, {"stack": stack}]
    monkeypatch.setattr("fiber._cli.stack.answer_of", lambda *_: iter(lines))
    assert run("stack", "train", "--worker", "Simulator") == (0, "Simulator (pid 7)\nhere\n\n", "")


def test_one_program_that_does_not_answer_hides_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [{"error": "silent"}, {"stack": {"name": "program", "text": "here"}}]
    monkeypatch.setattr("fiber._cli.stack.answer_of", lambda *_: iter(lines))
    outcome = run("stack", "train")
    assert "here" in outcome.out
    assert "silent" in outcome.err


def test_no_cluster_is_asked_without_the_package_for_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "config").touch()
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "config"))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert run("ps") == (0, "", "no program runs on this machine\n")
