"""Agents that are drained: told to end by SIGTERM, as pods are.  No finished work is lost."""

from __future__ import annotations

import os
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import fiber
from faults.program import wait_for
from faults.runtime import running
from fiber._backends.loopback import LoopbackBackend
from patience import PATIENCE


@pytest.fixture
def backend(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[LoopbackBackend]:
    """Two agents, whose hosts give them ``request.param`` seconds after SIGTERM."""
    usual = LoopbackBackend._environment
    grace = {"FIBER_AGENT_TERMINATION_GRACE": str(request.param)}
    monkeypatch.setattr(
        LoopbackBackend, "_environment", lambda self, name: usual(self, name) | grace
    )
    with running(backend="loopback", agents=2) as runtime:
        loopback = runtime.backend
        assert isinstance(loopback, LoopbackBackend)
        wait_for(lambda: len(loopback.agents.agents) == 2)
        yield loopback


patient = pytest.mark.parametrize("backend", [2 * PATIENCE], indirect=True)
hasty = pytest.mark.parametrize("backend", [1.0], indirect=True)


def drain(backend: LoopbackBackend, host: str) -> None:
    """Tell an agent to end, and wait until the program has heard of that."""
    agent = backend.agents.agents[host]
    (slot,) = (slot for slot in backend._slots if slot.name == host)
    assert slot.process.pid is not None
    os.kill(slot.process.pid, signal.SIGTERM)
    wait_for(lambda: bool(agent.leaving))


def note(directory: Path, word: str) -> None:
    with open(directory / "log", "a") as log:
        log.write(f"{word}\n")


def notes(directory: Path) -> list[str]:
    log = directory / "log"
    return log.read_text().split() if log.exists() else []


def ran(directory: Path, times: int) -> bool:
    return len(notes(directory)) >= times


def begin_and_wait(task: tuple[Path, int]) -> str:
    """Run until there is a file, and return the host."""
    directory, number = task
    note(directory, str(number))
    while not (directory / "go").exists():
        time.sleep(0.01)
    return str(number)


def block_unless_it_ran(directory: Path) -> int:
    """Block the first time, return the second."""
    note(directory, "run")
    while len(notes(directory)) < 2:
        time.sleep(0.01)
    return len(notes(directory))


def block(directory: Path) -> None:
    note(directory, "run")
    time.sleep(10 * PATIENCE)


def hosts_of(pool: Any) -> set[str]:
    return {handle.host for handle in pool._executor._scheduler.workers.members}


def wait_at_sigterm(directory: Path, ready: Any) -> None:
    """Handle SIGTERM as a program in an ordinary pod does."""
    signal.signal(signal.SIGTERM, lambda *_: note(directory, "heard"))
    ready.set()
    wait_for(lambda: "heard" in notes(directory))
    note(directory, "saved")


def go_on(directory: Path, ready: Any) -> None:
    ready.set()
    wait_for((directory / "go").exists)


@patient
def test_what_runs_ends_and_nothing_runs_twice(backend: LoopbackBackend, tmp_path: Path) -> None:
    with fiber.Pool(2, retries=1, disruptions=0) as pool:
        results = pool.map_async(begin_and_wait, [(tmp_path, n) for n in range(12)])
        wait_for(lambda: len(notes(tmp_path)) >= 2)
        assert hosts_of(pool) == {"loopback-0", "loopback-1"}
        drain(backend, "loopback-0")
        wait_for(lambda: "loopback-2" in hosts_of(pool))
        (tmp_path / "go").touch()
        assert results.get(PATIENCE) == [str(n) for n in range(12)]
    assert set(Counter(notes(tmp_path)).values()) == {1}


@patient
def test_an_agent_leaves_by_name_when_its_last_child_is_gone(backend: LoopbackBackend) -> None:
    agent = backend.agents.agents["loopback-0"]
    drain(backend, "loopback-0")
    wait_for(lambda: agent.lost is not None)
    assert agent.lost == agent.leaving
    assert agent.leaving.startswith("Drained: ")


@hasty
def test_what_does_not_end_in_time_runs_elsewhere_and_uses_up_no_retry(
    backend: LoopbackBackend, tmp_path: Path
) -> None:
    with fiber.Executor(1, retries=0, disruptions=1) as executor:
        future = executor.submit(block_unless_it_ran, tmp_path)
        wait_for(lambda: bool(notes(tmp_path)))
        (host,) = (agent.host for agent in backend.agents.agents.values() if agent._children)
        drain(backend, host)
        assert future.result(PATIENCE) == 2


@hasty
def test_a_task_that_is_disrupted_again_and_again_ends(
    backend: LoopbackBackend, tmp_path: Path
) -> None:
    with fiber.Executor(1, retries=3, disruptions=2) as executor:
        future = executor.submit(block, tmp_path)
        for runs in range(1, 4):
            wait_for(partial(ran, tmp_path, runs))
            agents = backend.agents.agents.values()
            (host,) = (agent.host for agent in agents if agent._children and not agent.leaving)
            drain(backend, host)
        with pytest.raises(fiber.errors.WorkerDied) as caught:
            future.result(PATIENCE)
    error = caught.value
    assert (error.attempts, error.disruptions) == (0, 3)
    assert "the cluster ended it 3 times" in str(error)
    assert error.reason.startswith("Drained: ")


@patient
@pytest.mark.parametrize(("target", "told"), [(wait_at_sigterm, ["heard", "saved"]), (go_on, [])])
def test_a_process_hears_sigterm_if_it_is_prepared_and_goes_on_if_not(
    backend: LoopbackBackend,
    tmp_path: Path,
    target: Callable[[Path, Any], None],
    told: list[str],
) -> None:
    ready = fiber.Event()
    process = fiber.Process(target=target, args=(tmp_path, ready))
    process.start()
    assert ready.wait(PATIENCE)
    popen: Any = process._popen
    drain(backend, popen._child.host)
    (tmp_path / "go").touch()
    process.join(PATIENCE)
    assert process.exitcode == 0
    assert notes(tmp_path) == told


@patient
def test_new_processes_are_placed_elsewhere(backend: LoopbackBackend, tmp_path: Path) -> None:
    ready = fiber.Event()
    process = fiber.Process(target=go_on, args=(tmp_path, ready))
    process.start()
    assert ready.wait(PATIENCE)
    popen: Any = process._popen
    host = popen._child.host
    drain(backend, host)
    others = [fiber.Process(target=go_on, args=(tmp_path, ready)) for _ in range(3)]
    for other in others:
        other.start()
    found: list[Any] = [other._popen for other in others]
    assert host not in {each._child.host for each in found}
    (tmp_path / "go").touch()
    for each in [process, *others]:
        each.join(PATIENCE)
        assert each.exitcode == 0
