"""Agents that are killed or stopped: their processes count as dead, others take over."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest

import census
import fiber
from faults import targets
from faults.program import LOOPBACK, Program, alive, stop_and_wait, wait_for
from faults.runtime import running
from fiber._backends.loopback import LoopbackBackend
from patience import PATIENCE

LOST_AFTER = 1.5


@pytest.fixture
def backend() -> Iterator[LoopbackBackend]:
    settings = {"heartbeat_interval": 0.2, "suspect_after": 0.6, "lost_after": LOST_AFTER}
    with running(backend="loopback", agents=2, **settings) as runtime:
        loopback = runtime.backend
        assert isinstance(loopback, LoopbackBackend)
        wait_for(lambda: len(loopback.agents.agents) == 2)  # else one would get all processes
        yield loopback


def pid_of(backend: LoopbackBackend, host: str) -> int:
    for slot in backend._slots:
        if slot.name == host:
            pid = slot.process.pid
            assert pid is not None
            return pid
    raise AssertionError(f"{host} is gone")


def start(*args: Any) -> Any:
    child = fiber.Process(target=args[0], args=args[1:])
    child.start()
    return child


def host_of(child: Any) -> str:
    host: str = child._popen._child.host
    return host


@pytest.mark.parametrize("signum", [signal.SIGKILL, signal.SIGSEGV])
def test_a_killed_agent_ends_its_own_processes_and_no_other(
    backend: LoopbackBackend, signum: signal.Signals
) -> None:
    children = [start(targets.block) for _ in range(4)]
    doomed = [child for child in children if host_of(child) == "loopback-0"]
    spared = [child for child in children if child not in doomed]
    assert len(doomed) == len(spared) == 2
    os.kill(pid_of(backend, "loopback-0"), signum)
    for child in doomed:
        child.join(PATIENCE)
        assert child.exitcode == -signal.SIGKILL
        assert "agent loopback-0 lost" in child._popen.report.reason
        wait_for(partial(_gone, child.pid))
    for child in spared:
        assert child.is_alive()
        child.terminate()
        child.join(PATIENCE)
        assert child.exitcode == -signal.SIGTERM


def test_an_agent_that_gets_sigterm_gives_its_processes_time(backend: LoopbackBackend) -> None:
    ours, theirs = fiber.Pipe()
    child = start(targets.exit_on_sigterm, theirs)
    theirs.close()
    assert ours.recv() == "ready"
    os.kill(pid_of(backend, host_of(child)), signal.SIGTERM)
    child.join(PATIENCE)
    assert child.exitcode == 42
    ours.close()


def test_a_stopped_agent_gets_no_new_process_then_is_lost_and_replaced(
    backend: LoopbackBackend,
) -> None:
    child = start(targets.block)
    host, pid = host_of(child), child.pid
    agent_pid = pid_of(backend, host)
    stop_and_wait(agent_pid)
    agent = backend.agents.agents[host]
    wait_for(lambda: agent.suspect)
    others = [start(targets.nothing) for _ in range(3)]
    assert all(other._popen.report is not None or host_of(other) != host for other in others)
    for other in others:
        other.join(PATIENCE)
        assert other.exitcode == 0
    child.join(PATIENCE)
    assert child.exitcode == -signal.SIGKILL
    assert host in child._popen.report.reason
    wait_for(lambda: not alive(agent_pid), what="the end of the stopped agent")
    wait_for(lambda: not alive(pid), what="the end of its child")


def test_a_brief_stop_of_an_agent_loses_no_message(backend: LoopbackBackend) -> None:
    ours, theirs = fiber.Pipe()
    child = start(targets.echo, theirs)
    theirs.close()
    ours.send(0)
    assert ours.recv() == 0
    agent_pid = pid_of(backend, host_of(child))
    for number in range(3):
        stop_and_wait(agent_pid)
        ours.send(number)
        time.sleep(0.1)  # the length of the stop, which is tested
        os.kill(agent_pid, signal.SIGCONT)
        assert ours.recv() == number
    assert child.is_alive()
    ours.close()
    child.join(PATIENCE)


@pytest.mark.parametrize("fault", ["kill", "stop"])
def test_the_tasks_of_a_lost_agent_run_elsewhere_exactly_once_each(
    backend: LoopbackBackend, fault: str
) -> None:
    with fiber.Pool(4) as pool:
        pool.map(targets.slow_square, range(8), chunksize=1)
        result = pool.map_async(targets.slow_square, range(100), chunksize=1)
        agent_pid = pid_of(backend, "loopback-0")
        if fault == "kill":
            os.kill(agent_pid, signal.SIGKILL)
        else:
            stop_and_wait(agent_pid)
        assert result.get(PATIENCE) == [n * n for n in range(100)]
        assert pool.map(targets.slow_square, range(20)) == [n * n for n in range(20)]
    wait_for(lambda: not alive(agent_pid))


def test_every_agent_killed_again_and_again_the_pool_goes_on(backend: LoopbackBackend) -> None:
    with fiber.Pool(2, retries=20) as pool:
        assert pool.apply(abs, (-1,)) == 1
        result = pool.map_async(targets.slow_square, range(200), chunksize=1)
        for _ in range(3):
            hosts = [slot.name for slot in backend._slots]
            for host in hosts:
                os.kill(pid_of(backend, host), signal.SIGKILL)
            wait_for(partial(_joined, backend, hosts))
        assert result.get(PATIENCE) == [n * n for n in range(200)]


def _joined(backend: LoopbackBackend, old: list[str]) -> bool:
    joined = backend.agents.agents
    return all(slot.name in joined and slot.name not in old for slot in backend._slots)


def _gone(pid: int) -> bool:
    return not alive(pid)


def test_a_killed_zygote_of_an_agent_costs_its_children_only(backend: LoopbackBackend) -> None:
    child = start(targets.block)
    agent_pid = pid_of(backend, host_of(child))
    zygotes = [found.pid for found in census.everything() if found.parent == agent_pid]
    for zygote in zygotes:
        os.kill(zygote, signal.SIGKILL)
    child.join(PATIENCE)
    assert child.exitcode == -signal.SIGKILL
    assert "together with its zygote" in child._popen.report.reason
    assert alive(agent_pid)
    again = [start(targets.nothing) for _ in range(2)]
    for another in again:
        another.join(PATIENCE)
        assert another.exitcode == 0


def test_after_good_work_agents_end_with_status_0(launch: Callable[..., Program]) -> None:
    script = """
        import fiber
        from fiber._backends import loopback
        from fiber._runtime import state
        from patience import PATIENCE
        loopback._QUIT_TIMEOUT = PATIENCE
        if __name__ == "__main__":
            with fiber.Pool(2) as pool:
                pool.map(abs, range(10))
            child = fiber.Process(target=print)
            child.start()
            agents = [slot.process._process for slot in state.runtime().backend._slots]
            child.join()
            state.shutdown()
            print({agent.returncode for agent in agents})
    """
    program = launch(script, env=LOOPBACK)
    assert program.finish() == "{0}\n"
