"""The loopback backend: agents that fail, end and are replaced, and what they are told."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import socket
import sys
from collections.abc import Iterator
from typing import Any

import pytest

import census
import fiber
from fiber import config
from fiber._agent.interface import ChildSpec
from fiber._backends import loopback
from fiber._backends.output import Output
from fiber._backends.remote import RemoteAgent
from fiber._hub.access import Access
from fiber._runtime import state
from fiber._wire import messages
from fiber.errors import LinkError, StartError
from unit.agent_children import Recorder, run_forever

PATIENCE = 15


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
    counts = sorted(process.agent.children for process in shared._processes)
    assert counts == [1, 2]
    stop(*children)


def test_more_than_the_agents_may_run_is_an_error_that_says_what_to_raise(shared: Any) -> None:
    children = [start() for _ in range(4)]
    with pytest.raises(StartError, match="all 2 agents run 2 processes already") as caught:
        start()
    assert "FIBER_AGENTS" in str(caught.value)
    stop(*children)
    stop(start())


def test_nothing_secret_is_on_a_command_line_or_in_the_environment_of_children(
    shared: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    child = start()
    agents = [process._process.pid for process in shared._processes]
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


def print_both() -> None:
    print("to stdout")
    print("to stderr", file=sys.stderr)


def test_what_children_write_reaches_stderr_with_their_names(
    shared: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    child = fiber.Process(target=print_both, name="writer")
    child.start()
    child.join()
    seen: list[str] = []

    def complete() -> bool:
        seen.append(capfd.readouterr().err)
        return "".join(seen).count("\n") >= 2

    assert census.wait_until(complete, PATIENCE)
    lines = sorted("".join(seen).splitlines())
    assert [line.split("] ")[1] for line in lines] == ["to stderr", "to stdout"]
    assert all(line.startswith("[writer@loopback-") for line in lines)


def test_a_killed_agent_ends_its_processes_and_is_replaced_under_a_new_name() -> None:
    with running() as backend:
        child = start()
        pid = child.pid
        process = backend._processes[0]
        os.kill(process._process.pid, signal.SIGKILL)
        child.join(PATIENCE)
        assert child.exitcode == -signal.SIGKILL
        assert "agent loopback-0 lost" in child._popen.report.reason
        assert census.wait_until(lambda: census.read(pid) is None, PATIENCE)
        another = start()  # at once: it waits for the next agent
        assert backend._processes[0].agent.host == "loopback-1"
        stop(another)


def test_agents_that_die_before_they_join_are_not_started_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    dies = [sys.executable, "-c", "raise SystemExit(3)"]
    monkeypatch.setattr(loopback, "interpreter_arguments", lambda *_: dies)
    with running(start_timeout=PATIENCE) as backend:
        with pytest.raises(StartError, match="its process ended with status 3"):
            start()
        assert census.wait_until(lambda: len(backend._failures) == 3, PATIENCE)
        with pytest.raises(StartError, match="none joined") as caught:
            start()
    assert "loopback-2: its process ended with status 3" in str(caught.value)


def test_a_port_in_use_is_named_and_leaves_nothing() -> None:
    before = len(os.listdir("/proc/self/fd"))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(LinkError, match=f"{port}: another program"), running(listen_port=port):
            pass
    assert len(os.listdir("/proc/self/fd")) == before


def test_an_address_that_is_not_ours_is_named() -> None:
    with pytest.raises(LinkError, match=r"203\.0\.113\.7"), running(listen_host="203.0.113.7"):
        pass


def test_it_leaves_no_file(tmp_path: Any) -> None:
    with running(runtime_directory=str(tmp_path)):
        stop(start())
        assert "key" not in " ".join(path.name for path in tmp_path.rglob("*"))
    assert list(tmp_path.iterdir()) == []


def test_the_runtime_can_be_shut_down_and_made_again() -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(2):
        with running():
            stop(start())
    assert census.wait_until(lambda: len(os.listdir("/proc/self/fd")) <= before, PATIENCE)


# The master's side of one agent, without its process


class Silent:
    """A hub, and a link, that a test can do without."""

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.access = Access("local", "nowhere", b"")

    def link(self, *_: Any, **__: Any) -> Silent:
        return self

    def unlink(self, *_: Any) -> None:
        pass

    def attach(self, _observer: Any) -> None:
        pass

    def send(self, frame: Any) -> None:
        self.sent.append(messages.decode(frame))


@pytest.fixture
def remote() -> tuple[RemoteAgent, Silent, Recorder]:
    link = Silent()
    agent = RemoteAgent("far", link, Output(), on_lost=lambda *_: None)  # type: ignore[arg-type]
    observer = Recorder()
    agent.start(ChildSpec("child", "fork", b"", b"", tasks=True), observer)
    return agent, link, observer


def test_what_comes_late_from_a_lost_agent_is_dropped(remote: Any) -> None:
    agent, link, observer = remote
    agent.join(link)
    agent.on_frame(messages.Started(1, 77).encode())
    agent.on_frame(messages.Said(1, pickle.dumps("in time"), ()).encode())
    agent.on_lost("silence")
    agent.on_frame(messages.Said(1, pickle.dumps("late"), ()).encode())
    agent.on_frame(messages.Exited(1, 0, 0, "exit status 0").encode())
    assert observer.words == ["in time"]
    assert observer.events == ["started", "received", "exited"]
    assert observer.report.reason == "agent far lost: silence"
    assert observer.report.exitcode == -signal.SIGKILL


def test_what_was_asked_before_it_joined_is_sent_when_it_does(remote: Any) -> None:
    agent, link, observer = remote
    (child,) = agent._children.values()
    for seq in (3, 4, 5):
        child.deliver(seq, b"work")
    agent.join(link)
    assert [message.seq for message in link.sent[1:]] == [3, 4, 5]
    agent.on_lost("silence")
    assert not child.deliver(6, b"too late")
    assert observer.events == ["exited"]


def test_a_lost_agent_starts_nothing_more(remote: Any) -> None:
    agent, _, _ = remote
    agent.on_lost("silence")
    with pytest.raises(RuntimeError, match="agent far cannot start child: silence"):
        agent.start(ChildSpec("child", "fork", b"", b""), Recorder())
