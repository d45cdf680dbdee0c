"""Server and client of the monitor: clients that are refused, and programs that were killed."""

from __future__ import annotations

import errno
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from census import wait_until
from fiber._hub.directory import HUB_SOCKET
from fiber._monitor import client, server
from fiber._monitor.server import MonitorServer
from fiber._transport.loop import Loop
from patience import PATIENCE


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "fiber-x"
    made.mkdir(mode=0o700)
    return made


@pytest.fixture
def listening(loop: Loop, folder: Path) -> Iterator[str]:
    """The socket of a server that repeats the request."""
    made = MonitorServer(loop, str(folder), "train-1", lambda request: [request])
    yield str(folder / server.SOCKET)
    close(loop, made)


def close(loop: Loop, made: MonitorServer) -> None:
    """Close a server whose loop goes on."""
    loop.call_soon(loop.unregister, made._listener.fileno())
    settled = threading.Event()
    loop.call_soon(settled.set)
    assert settled.wait(PATIENCE)
    made.close()


def answer(path: str) -> list[dict[str, Any]]:
    """Answer of the server; empty if it closes the connection instead."""
    try:
        return list(client.ask(path, {"a": 1}))
    except client.NoAnswer:
        return []


def test_another_users_connection_is_closed(
    listening: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "PEER", _Stranger)
    assert answer(listening) == []


class _Stranger:
    size = server.PEER.size

    @staticmethod
    def unpack(_: bytes) -> tuple[int, int, int]:
        return 1, os.geteuid() + 1, 0


def test_nonsense_is_answered_by_an_error(listening: str) -> None:
    with socket.socket(socket.AF_UNIX) as sock:
        sock.settimeout(PATIENCE)
        sock.connect(listening)
        sock.sendall(b"nonsense\n")
        assert sock.recv(1 << 16).startswith(b'{"error": "JSONDecodeError')


def test_no_more_than_some_clients_are_served(
    listening: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "_MOST_CLIENTS", 1)
    with socket.socket(socket.AF_UNIX) as first:
        first.connect(listening)
        assert answer(listening) == []
    assert wait_until(lambda: answer(listening) == [{"a": 1}], PATIENCE)


def test_the_files_of_a_killed_program_are_removed(folder: Path) -> None:
    path = folder / server.SOCKET
    for left in (path, folder / HUB_SOCKET):
        with socket.socket(socket.AF_UNIX) as sock:
            sock.bind(str(left))
    assert client.sockets(str(folder.parent)) == [str(path)]
    assert client.pid_of(str(path)) is None
    with pytest.raises(client.NoAnswer, match="the program has ended"):
        list(client.ask(str(path), {}))
    assert client.sockets(str(folder.parent)) == []


def test_a_folder_that_is_not_fibers_is_kept(folder: Path) -> None:
    path, data = folder / server.SOCKET, folder / "data"
    data.touch()
    with socket.socket(socket.AF_UNIX) as sock:
        sock.bind(str(path))
    with pytest.raises(client.NoAnswer):
        list(client.ask(str(path), {}))
    assert data.exists()
    path.unlink()
    path.touch()
    assert client.sockets(str(folder.parent)) == []


def test_a_socket_has_its_name_once_it_listens(
    loop: Loop, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    class Listener(socket.socket):
        def listen(self, *args: int) -> None:
            seen.append(client.sockets(str(folder.parent)))
            super().listen(*args)

    monkeypatch.setattr(socket, "socket", Listener)
    made = MonitorServer(loop, str(folder), "train-1", lambda request: [request])
    assert seen == [[]]
    assert client.sockets(str(folder.parent)) == [str(folder / server.SOCKET)]
    close(loop, made)


def test_without_a_descriptor_the_loop_does_not_spin(
    listening: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusals = [OSError(errno.EMFILE, "too many open files")]
    accept = socket.socket.accept

    def refuse_once(sock: socket.socket) -> Any:
        if refusals:
            raise refusals.pop()
        return accept(sock)

    monkeypatch.setattr(socket.socket, "accept", refuse_once)
    with monkeypatch.context() as patch:
        patch.setattr(server, "_ACCEPT_AGAIN", 3600.0)
        with pytest.raises(client.NoAnswer, match="does not answer"):
            list(client.ask(listening, {}, patience=0.05))
        assert wait_until(lambda: not refusals, PATIENCE)


def test_a_program_for_which_too_many_wait_has_not_ended(folder: Path) -> None:
    path = folder / server.SOCKET
    with socket.socket(socket.AF_UNIX) as sock, socket.socket(socket.AF_UNIX) as first:
        sock.bind(str(path))
        sock.listen(0)
        first.connect(str(path))
        with pytest.raises(client.NoAnswer, match="does not answer"):
            list(client.ask(str(path), {}))


def test_a_program_that_does_not_answer_is_given_up(folder: Path) -> None:
    path = folder / server.SOCKET
    with socket.socket(socket.AF_UNIX) as sock:
        sock.bind(str(path))
        sock.listen()
        with pytest.raises(client.NoAnswer, match="does not answer within"):
            list(client.ask(str(path), {}, patience=0.05))
        assert client.pid_of(str(path)) == os.getpid()


def test_a_program_that_does_not_answer_is_named_among_all(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def silent(*_: object) -> Iterator[dict[str, Any]]:
        raise client.NoAnswer("the program does not answer within 10 s")

    monkeypatch.setattr(client, "sockets", lambda _: ["path"])
    monkeypatch.setattr(client, "ask", silent)
    (line,) = client.ask_all(str(folder.parent), {})
    assert line["error"].startswith("the program does not answer within 10 s")


def test_a_folder_that_others_may_write_to_is_left_out(folder: Path) -> None:
    (folder / server.SOCKET).touch()
    folder.chmod(0o777)
    assert client.sockets(str(folder.parent)) == []
