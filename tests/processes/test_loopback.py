"""The loopback backend: agents that fail, end and are replaced, and what they are told."""

from __future__ import annotations

import contextlib
import errno
import io
import itertools
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pynng
import pytest

import census
import fiber
from fiber import config
from fiber._agent.interface import ChildSpec
from fiber._agent.zygote_process import interpreter_arguments
from fiber._backends import loopback
from fiber._backends.remote import RemoteAgent, RemoteChild
from fiber._engine import start_failures
from fiber._engine.start_failures import TRIES
from fiber._hub.protocol import HubAddress
from fiber._logs import OutputWriter
from fiber._runtime import state
from fiber._transport import listener
from fiber._wire import messages
from fiber.errors import LinkError, StartError, TooManyOpenFiles
from memory_link import SimulatedLoop
from patience import PATIENCE
from unit.agent_children import ReadLink, Recorder, run_forever


@contextlib.contextmanager
def running(**settings: Any) -> Iterator[loopback.LoopbackBackend]:
    """The runtime of this process with the loopback backend."""
    state.shutdown()
    before = config._current
    config.install(config.load({"backend": "loopback", "agents": 1, **settings}))
    try:
        backend = state.runtime().backend
        assert isinstance(backend, loopback.LoopbackBackend)
        yield backend
    finally:
        state.shutdown()
        config._current = before


@pytest.fixture(scope="module")
def shared() -> Iterator[loopback.LoopbackBackend]:
    """Two agents, for tests that do not break them."""
    with running(agents=2, processes_per_agent=2) as backend:
        backend._output.write("test", "the thread that writes lives as long as the runtime")
        yield backend


def start(**options: Any) -> Any:
    child = fiber.Process(target=run_forever, **options)
    child.start()
    return child


def stop(*children: Any) -> None:
    for child in children:
        child.kill()
    for child in children:
        child.join(PATIENCE)
        assert child.exitcode == -signal.SIGKILL


def test_processes_go_to_the_agent_that_has_the_fewest(shared: Any) -> None:
    children = [start() for _ in range(3)]
    counts = sorted(shared.agents.placement.loads.values())
    assert counts == [1, 2]
    stop(*children)


def test_exceeding_the_agents_capacity_names_the_setting_to_raise(shared: Any) -> None:
    children = [start() for _ in range(4)]
    with pytest.raises(StartError, match="all 2 agents run 2 processes already") as caught:
        start()
    assert "FIBER_AGENTS" in str(caught.value)
    stop(*children)
    stop(start())


def test_no_secret_is_on_a_command_line_or_in_the_environment_of_children(
    shared: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    child = start()
    agents = [slot.process.pid for slot in shared._slots]
    for found in census.everything():
        if found.pid in agents or found.parent in agents or found.pid == child.pid:
            assert shared._listener.address not in found.command
            assert "PRIVATE" not in found.command
    zygotes = [found.pid for found in census.everything() if found.parent in agents]
    assert zygotes
    for pid in zygotes:
        with open(f"/proc/{pid}/environ", "rb") as file:
            assert b"FIBER_AGENT_CREDENTIALS" not in file.read()
    stop(child)


def credentials_in_reach() -> list[str]:
    """Return where this process, which runs any user's code, finds a private key of Fiber's."""
    found = []
    family = [os.getpid()]
    ancestor = census.read(os.getpid())
    while ancestor is not None and ancestor.parent > 1:
        family.append(ancestor.parent)
        ancestor = census.read(ancestor.parent)
    for pid in family:
        for name in ("environ", "cmdline"):
            with contextlib.suppress(OSError), open(f"/proc/{pid}/{name}", "rb") as file:
                if b'"key"' in file.read():
                    found.append(f"{name} of {pid}")
    for fd in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            if os.readlink(f"/proc/self/fd/{fd}").startswith(("pipe:", "/memfd:credentials")):
                os.set_blocking(int(fd), False)
                if b'"key"' in os.read(int(fd), 1 << 16):
                    found.append(f"descriptor {fd}")
    return found


def tell_credentials(channel: Any) -> None:
    channel.send(credentials_in_reach())


def test_no_child_finds_the_credentials_of_its_agent(shared: Any) -> None:
    ours, theirs = fiber.Pipe()
    child = fiber.Process(target=tell_credentials, args=(theirs,))
    child.start()
    theirs.close()
    assert ours.recv() == []
    ours.close()
    child.join(PATIENCE)


def print_both() -> None:
    print("to stdout")
    print("to stderr", file=sys.stderr)


def test_output_of_children_reaches_stderr_with_their_names(
    shared: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Not capfd: it loses what another thread writes while it reads.
    written = io.StringIO()
    monkeypatch.setattr(sys, "stderr", written)
    child = fiber.Process(target=print_both, name="writer")
    child.start()
    child.join()
    assert census.wait_until(lambda: written.getvalue().count("\n") >= 2, PATIENCE)
    lines = sorted(written.getvalue().splitlines())
    assert [line.split("] ")[1] for line in lines] == ["to stderr", "to stdout"]
    assert all(line.startswith("[writer@loopback-") for line in lines)


@pytest.mark.slow
def test_a_killed_agent_ends_its_processes_and_is_replaced_under_a_new_name() -> None:
    with running() as backend:
        child = start()
        pid = child.pid
        os.kill(backend._slots[0].process.pid, signal.SIGKILL)  # type: ignore[arg-type]  # it runs
        child.join(PATIENCE)
        assert child.exitcode == -signal.SIGKILL
        assert "agent loopback-0 lost" in child._popen.report.reason
        assert census.wait_until(lambda: census.read(pid) is None, PATIENCE)
        another = start()  # at once: it waits for the next agent
        assert backend._slots[0].name == "loopback-1"
        stop(another)


@pytest.mark.slow
def test_agents_that_die_before_they_join_are_an_error_until_one_joins(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    dies, works = [sys.executable, "-c", "raise SystemExit(3)"], interpreter_arguments
    broken = True
    monkeypatch.setattr(
        loopback, "interpreter_arguments", lambda *them: dies if broken else works(*them)
    )
    with running():
        for _ in range(2):
            with pytest.raises(StartError, match="none joined") as caught:
                start()
            assert "its process ended with status 3" in str(caught.value)
            assert caught.value.attempts >= TRIES
        with fiber.Pool(1) as pool, pytest.raises(StartError, match="none joined"):
            pool.map(abs, range(3))
        broken = False
        stop(start())
        with fiber.Pool(1) as pool:
            assert pool.map(abs, range(3)) == [0, 1, 2]


@pytest.mark.slow
def test_agents_that_are_killed_while_they_start_only_delay_a_pool() -> None:
    with running() as backend, fiber.Pool(1) as pool:
        assert pool.map(abs, range(3)) == [0, 1, 2]
        killed: set[int | None] = {None}

        def kill_next() -> bool:
            pid = backend._slots[0].process.pid
            if pid is not None and pid not in killed:
                killed.add(pid)
                os.kill(pid, signal.SIGKILL)
            return len(killed) > TRIES + 2

        assert census.wait_until(kill_next, PATIENCE)
        assert pool.map(abs, range(3)) == [0, 1, 2]
        stop(start())


def gate_second_agent(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """The second agent is started once the event is set."""
    goes_on, popen, numbers = threading.Event(), subprocess.Popen, itertools.count()

    def start_one(*args: Any, **options: Any) -> Any:
        assert next(numbers) != 1 or goes_on.wait(PATIENCE)
        return popen(*args, **options)

    monkeypatch.setattr(subprocess, "Popen", start_one)
    return goes_on


def loads(backend: loopback.LoopbackBackend) -> list[int]:
    return sorted(backend.agents.placement.loads.values())


def test_a_pool_that_starts_before_its_agents_is_spread_over_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(loopback, "_EXPECTED_FOR", PATIENCE)
    goes_on = gate_second_agent(monkeypatch)
    with running(agents=2) as backend, fiber.Pool(4) as pool:
        assert census.wait_until(lambda: loads(backend) == [2], PATIENCE)
        goes_on.set()
        pool.wait_until_workers_up(PATIENCE)
        assert loads(backend) == [2, 2]


def test_an_agent_that_does_not_come_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loopback, "_EXPECTED_FOR", 0.0)
    goes_on = gate_second_agent(monkeypatch)
    with running(agents=2) as backend, fiber.Pool(4) as pool:
        pool.wait_until_workers_up(PATIENCE)
        assert loads(backend) == [4]
        goes_on.set()


class Reluctant:
    """Stand-in for subprocess.Popen that fails as at the system's limit."""

    def __init__(self, times: int, error: int) -> None:
        self.left = times
        self._error = OSError(error, os.strerror(error))
        self._popen = subprocess.Popen

    def __call__(self, *args: Any, **options: Any) -> Any:
        if self.left:
            self.left -= 1
            raise self._error
        return self._popen(*args, **options)


@pytest.mark.slow
def test_an_agent_that_cannot_be_replaced_at_once_is_replaced_later_and_that_is_said(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with running() as backend:
        child = start()
        reluctant = Reluctant(2, errno.EAGAIN)
        monkeypatch.setattr(subprocess, "Popen", reluctant)
        os.kill(backend._slots[0].process.pid, signal.SIGKILL)  # type: ignore[arg-type]  # it runs
        child.join(PATIENCE)
        assert child.exitcode == -signal.SIGKILL, "its end is reported in any case"
        another = start()
        assert reluctant.left == 0
        stop(another)
    said = capfd.readouterr().err
    assert "agent loopback-1 has to wait, its process cannot be started: [Errno 11]" in said
    assert "next attempt in 0.1 s" in said
    assert "next attempt in 0.2 s" in said


@pytest.mark.parametrize(
    "error", [TooManyOpenFiles("making a link"), LinkError("no memory is left for a link")]
)
def test_a_program_that_has_not_the_means_to_serve_agents_says_so_soon(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def refuse(loop: object, descriptor: int, *rest: object, **options: object) -> None:
        os.close(descriptor)
        raise error

    monkeypatch.setattr(start_failures, "KILLED_PATIENCE", 0.0)
    monkeypatch.setattr(listener, "SealedConnection", refuse)
    with running(), pytest.raises(StartError) as caught:
        stop(start())
    message = str(caught.value)
    assert "this program cannot serve them" in message
    assert str(error) in message


def test_a_system_that_starts_no_agents_is_not_asked_for_minutes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(start_failures, "KILLED_PATIENCE", 0.0)
    monkeypatch.setattr(loopback, "_LAUNCHING", 0.0)
    monkeypatch.setattr(subprocess, "Popen", Reluctant(1000, errno.EMFILE))
    with running(), pytest.raises(StartError, match="Too many open files"):
        stop(start())


@pytest.mark.slow
def test_the_loop_does_not_wait_for_a_process_to_start(monkeypatch: pytest.MonkeyPatch) -> None:
    with running() as backend:
        stop(start())
        goes_on, popen = threading.Event(), subprocess.Popen

        def slow(*args: Any, **options: Any) -> Any:
            assert goes_on.wait(PATIENCE)
            return popen(*args, **options)

        monkeypatch.setattr(subprocess, "Popen", slow)
        os.kill(backend._slots[0].process.pid, signal.SIGKILL)  # type: ignore[arg-type]  # it runs
        assert census.wait_until(lambda: backend._slots[0].name != "loopback-0", PATIENCE)
        turned = threading.Event()
        backend._loop.call_soon(turned.set)
        assert turned.wait(PATIENCE)
        goes_on.set()
        stop(start())


@pytest.mark.slow
def test_an_agent_that_cannot_be_watched_is_ended_before_the_next_attempt(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    started: list[int] = []
    watch = os.pidfd_open

    def refuse_first(pid: int, flags: int = 0) -> int:
        if threading.current_thread().name == "fiber-launch":
            started.append(pid)
            if len(started) == 1:
                raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        return watch(pid, flags)

    monkeypatch.setattr(os, "pidfd_open", refuse_first)
    with running() as backend:
        stop(start())
        first, second = started
        assert census.read(first) is None
        assert backend._slots[0].process.pid == second


def test_an_agent_that_can_never_be_started_is_an_error_with_the_cause(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(subprocess, "Popen", Reluctant(999, errno.ENOEXEC))
    with running(), pytest.raises(StartError, match="none joined") as caught:
        start()
    assert "its process cannot be started: [Errno 8]" in str(caught.value)


@pytest.mark.slow
def test_while_another_agent_is_there_no_place_is_given_up(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(start_failures, "SAID_AFTER", 0.0)
    with running(agents=2) as backend:
        assert census.wait_until(lambda: len(backend.agents.agents) == 2, PATIENCE)
        monkeypatch.setattr(subprocess, "Popen", Reluctant(4, errno.ENOEXEC))
        os.kill(backend._slots[0].process.pid, signal.SIGKILL)  # type: ignore[arg-type]  # it runs
        assert census.wait_until(lambda: backend._failures.count >= TRIES, PATIENCE)
        child = start()  # on the other one
        assert child._popen._child.host == "loopback-1"
        assert census.wait_until(lambda: len(backend.agents.agents) == 2, PATIENCE)
        stop(child)
    assert capfd.readouterr().err.count("no loopback agent has joined for") == 1


def test_a_port_in_use_is_named_and_leaves_no_process() -> None:
    before = len(os.listdir("/proc/self/fd"))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(LinkError, match=f"{port}: another program"), running(listen_port=port):
            pass
    assert len(os.listdir("/proc/self/fd")) == before


def test_an_address_of_another_host_is_named() -> None:
    with (
        pytest.raises(LinkError, match=r"203\.0\.113\.7:0: this machine"),
        running(listen_host="203.0.113.7"),
    ):
        pass


def test_a_program_with_agents_leaves_no_file(tmp_path: Any) -> None:
    with running(runtime_directory=str(tmp_path)):
        stop(start())
        assert "key" not in " ".join(path.name for path in tmp_path.rglob("*"))
    assert list(tmp_path.iterdir()) == []


def test_the_directory_of_an_agent_that_was_killed_while_it_made_it_is_removed(
    tmp_path: Any,
) -> None:
    with running(runtime_directory=str(tmp_path)) as backend:
        process = backend._slots[0].process
        assert census.wait_until(lambda: process.pid is not None, PATIENCE)
        directory = process._files.directory
        assert directory is not None
        assert os.path.dirname(directory) == str(tmp_path)
        os.makedirs(directory, exist_ok=True)  # the agent may have made it by now
        os.kill(process.pid, signal.SIGKILL)  # type: ignore[arg-type]
        assert census.wait_until(lambda: not os.path.exists(directory), PATIENCE)


def test_agents_that_do_not_answer_share_one_deadline_at_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, waits, wait = [0.0], [], loopback.AgentProcess.wait

    def stuck(process: loopback.AgentProcess, timeout: float) -> None:
        waits.append(timeout)
        clock[0] += timeout
        wait(process, PATIENCE)

    monkeypatch.setattr(loopback.AgentProcess, "wait", stuck)
    monkeypatch.setattr(loopback, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    with running(agents=3):
        pass
    assert waits == [loopback._QUIT_TIMEOUT, 0.0, 0.0]


def test_a_client_that_disconnects_during_the_end_is_not_reported(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with running() as backend:
        host, port = backend._listener.address.removeprefix("tcp://").rsplit(":", 1)
        caller = socket.create_connection((host, int(port)), PATIENCE)
        close = backend._launcher.close

        def refused_meanwhile() -> None:
            caller.sendall(b"GET / HTTP/1.1")
            while caller.recv(1 << 16):
                pass
            close()

        monkeypatch.setattr(backend._launcher, "close", refused_meanwhile)
    caller.close()
    assert "refused" not in capfd.readouterr().err


@pytest.mark.slow
def test_the_runtime_can_be_shut_down_and_made_again() -> None:
    with pynng.Pair1():
        pass  # nng's poller, made at the first use in a process, stays until the process ends
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(2):
        with running():
            stop(start())
    assert census.wait_until(lambda: len(os.listdir("/proc/self/fd")) <= before, PATIENCE)


# The master's side of one agent, without its process


class Silent(ReadLink):
    """A hub, and a link, that a test can do without."""

    def __init__(self) -> None:
        super().__init__()
        self.access = HubAddress("local", "nowhere", b"")

    def link(self, *_: Any, **__: Any) -> Silent:
        return self

    def unlink(self, *_: Any) -> None:
        pass

    def flush(self) -> None:
        pass


@pytest.fixture
def remote() -> tuple[RemoteAgent, Silent, Recorder]:
    link, unheard = Silent(), mock.Mock()
    agent = RemoteAgent("far", link, SimulatedLoop(), link, OutputWriter(), unheard)  # type: ignore[arg-type]
    observer = Recorder()
    RemoteChild(agent, ChildSpec("child", "fork", b"", b"", tasks=True), observer).start()
    return agent, link, observer


def test_late_messages_of_a_lost_agent_are_dropped(remote: Any) -> None:
    agent, _, observer = remote
    agent.on_frame(messages.Started(1, 77).encode())
    agent.on_frame(messages.FromChild(1, pickle.dumps("in time"), ()).encode())
    agent.on_lost("silence")
    agent.on_frame(messages.FromChild(1, pickle.dumps("late"), ()).encode())
    agent.on_frame(messages.Exited(1, 0, 0, "exit status 0").encode())
    assert observer.words == ["in time"]
    assert observer.events == ["started", "received", "exited"]
    assert observer.report.reason == "agent far lost: silence"
    assert observer.report.exitcode == -signal.SIGKILL


def test_a_child_of_a_lost_agent_gets_no_message(remote: Any) -> None:
    agent, _, observer = remote
    (child,) = agent._children.values()
    agent.on_lost("silence")
    assert not child.deliver(6, b"too late")
    assert observer.events == ["exited"]


def test_a_child_whose_agent_is_lost_before_it_starts_is_lost_with_it(remote: Any) -> None:
    agent, link, _ = remote
    observer = Recorder()
    child = RemoteChild(agent, ChildSpec("child", "fork", b"", b""), observer)
    agent.on_lost("silence")
    sent = len(link.sent)
    child.start()
    assert observer.events == ["exited"]
    assert observer.wait_for_exit().reason == "agent far lost: silence"
    assert len(link.sent) == sent


def test_an_agent_that_is_about_to_end_is_not_killed() -> None:
    """A drained agent without a link may still remove its directory."""
    process = mock.Mock()
    with running() as backend:
        backend._departing["gone"] = SimpleNamespace(name="gone", process=process)  # type: ignore[assignment]
    assert process.terminate.called
    assert not process.kill.called
