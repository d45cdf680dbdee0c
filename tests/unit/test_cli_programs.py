"""Pods of programs, the client of their launchers, and the output of a command."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fakes.program_nodes import Launched, ProgramNodes
from fakes.served import served
from fiber._backends.kubernetes.port_forward import PortForward
from fiber._cli import programs, streams
from fiber._cli.failures import CommandError
from fiber._cli.forward import open_socket
from fiber._cli.programs import LauncherClient, ProgramPod
from fiber._cli.session import Session, connect
from fiber.launcher import EXIT, RECORD, STATUS, STDOUT
from patience import PATIENCE
from unit.kubernetes_rig import kubeconfig


def pod(phase: str = "Running", deleted: str = "", **state: Any) -> ProgramPod:
    metadata = {"name": "p", **({"deletionTimestamp": deleted} if deleted else {})}
    containers = [
        {"name": "sidecar", "state": {"terminated": {"exitCode": 5}}},
        {"name": "program", "state": state},
    ]
    return ProgramPod(
        "p", {"metadata": metadata, "status": {"phase": phase, "containerStatuses": containers}}
    )


def test_the_program_ends_with_its_own_container() -> None:
    runs = pod(running={})
    assert (runs.runs, runs.has_ended, runs.exit_status) == (True, False, None)
    ended = pod(terminated={"exitCode": 3})
    assert (ended.runs, ended.has_ended, ended.exit_status) == (False, True, 3)
    assert ended.disaster == ""


def test_a_pod_runs_once_the_programs_container_does() -> None:
    waits = pod(waiting={"reason": "ErrImagePull", "message": "not\nfound"})
    assert not waits.runs
    assert waits.state == "waits: ErrImagePull: not found"
    assert not pod("Pending").runs


def test_a_pod_that_was_evicted_has_ended() -> None:
    evicted = ProgramPod("p", {"metadata": {}, "status": {"phase": "Failed", "reason": "Evicted"}})
    assert (evicted.runs, evicted.has_ended, evicted.exit_status) == (False, True, None)
    assert evicted.disaster == "Evicted"


def test_a_pod_is_lost_if_it_stays_after_its_end() -> None:
    assert pod(deleted="2020-01-01T00:00:00Z", running={}).is_lost
    assert not pod(deleted="9000-01-01T00:00:00Z", running={}).is_lost
    assert not pod(running={}).is_lost


# ---- the launcher's client


class Site:
    """A pod whose launcher is a listening socket of the test."""

    def __init__(self, nodes: ProgramNodes, session: Session, sock: socket.socket) -> None:
        self._sock = sock
        self.client = LauncherClient(session, "p")
        nodes.launched["p"] = ListeningSocket(sock)

    @contextlib.contextmanager
    def answering(self, answer: bytes, *, ends: bool = False) -> Iterator[None]:
        """Answer one connection with these bytes; close it then, or once the client does."""

        def serve() -> None:
            connection, _ = self._sock.accept()
            with connection:
                connection.recv(1000)
                connection.sendall(answer)
                while not ends and connection.recv(1000):
                    pass

        thread = threading.Thread(target=serve)
        thread.start()
        yield
        thread.join(PATIENCE)


class ListeningSocket(Launched):
    """Socket in the place of a launcher."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self.process = RunningProcess()  # type: ignore[assignment]  # all that is asked of it

    @property
    def port(self) -> int:
        return int(self._sock.getsockname()[1])


class RunningProcess:
    """Process that runs, and ends at once when it is killed."""

    pid = 2**22 + 1

    def poll(self) -> None:
        return None

    def kill(self) -> None:
        pass


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    with served() as server, socket.create_server(("127.0.0.1", 0)) as sock:
        monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, server.api.url)))
        nodes = ProgramNodes(server, tmp_path)
        session = connect(None, None)
        yield Site(nodes, session, sock)
        session.api.close()


HEAD = b"HTTP/1.0 200 OK\r\n\r\n"


def test_a_connection_that_is_silent_for_long_is_broken(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Read from a node that is gone, which nothing says."""
    sockets: list[socket.socket] = []

    def open_and_keep(forward: PortForward) -> socket.socket:
        sockets.append(open_socket(forward))
        return sockets[-1]

    monkeypatch.setattr(programs, "open_socket", open_and_keep)
    data = RECORD.pack(STDOUT, 3) + b"abc"
    with site.answering(HEAD + data):
        records = site.client.output(0)
        assert next(records) == (STDOUT, b"abc")
        (sock,) = sockets
        assert sock.gettimeout() == programs._SILENCE
        sock.settimeout(0.1)
        with pytest.raises(TimeoutError):
            next(records)


@pytest.mark.parametrize("size", [0, 3, RECORD.size, RECORD.size + 2])
def test_half_a_record_is_not_shown(site: Site, size: int) -> None:
    data = RECORD.pack(STDOUT, 3) + b"abc"
    with site.answering(HEAD + data[:size], ends=True), pytest.raises(ConnectionError):
        list(site.client.output(0))


def test_the_end_closes_the_connection(site: Site) -> None:
    data = RECORD.pack(STDOUT, 0) + RECORD.pack(EXIT, STATUS.size) + STATUS.pack(-1)
    with site.answering(HEAD + data):
        kinds = [kind for kind, _ in site.client.output(0)]
    assert kinds == [STDOUT, EXIT]


def test_an_answer_that_is_no_success_is_an_error(site: Site) -> None:
    with (
        site.answering(b"HTTP/1.0 404 Not Found\r\n\r\n"),
        pytest.raises(ConnectionError, match="404"),
    ):
        next(site.client.output(0))


# ---- output of a command


def test_a_terminal_that_does_not_block_gets_everything() -> None:
    read, write = os.pipe()
    os.set_blocking(write, False)
    data = bytes(range(256)) * 4096
    found = b""

    def reader() -> None:
        nonlocal found
        while len(found) < len(data):
            found += os.read(read, 4096)

    thread = threading.Thread(target=reader)
    with pytest.MonkeyPatch.context() as patch, open(write, "w") as stream:
        patch.setattr("sys.stdout", stream)
        thread.start()
        streams.write(data)
    thread.join()
    os.close(read)
    assert found == data


def test_a_closed_or_full_output(monkeypatch: pytest.MonkeyPatch) -> None:
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as closed, open("/dev/full", "w") as full:
        monkeypatch.setattr("sys.stdout", closed)
        with pytest.raises(streams.OutputClosed):
            streams.write(b"x")
        monkeypatch.setattr("sys.stdout", full)
        with pytest.raises(CommandError, match="cannot write the output"):
            streams.write(b"x")
        monkeypatch.setattr("sys.stdout", None)
        streams.write(b"x")
        monkeypatch.setattr("sys.stderr", None)
        streams.say("x")
