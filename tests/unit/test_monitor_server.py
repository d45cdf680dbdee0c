"""Server and client of the monitor: clients that are refused, and programs that were killed."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from census import wait_until
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
    made = MonitorServer(loop, str(folder), lambda request: [request])
    yield str(folder / server.SOCKET)
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
    with socket.socket(socket.AF_UNIX) as sock:
        sock.bind(str(path))
    assert client.sockets(str(folder.parent)) == [str(path)]
    assert client.pid_of(str(path)) is None
    with pytest.raises(client.NoAnswer, match="the program has ended"):
        list(client.ask(str(path), {}))
    assert client.sockets(str(folder.parent)) == []


def test_a_program_that_does_not_answer_is_given_up(folder: Path) -> None:
    path = folder / server.SOCKET
    with socket.socket(socket.AF_UNIX) as sock:
        sock.bind(str(path))
        sock.listen()
        with pytest.raises(client.NoAnswer, match="does not answer within"):
            list(client.ask(str(path), {}, patience=0.05))
        assert client.pid_of(str(path)) == os.getpid()


def test_a_folder_that_others_may_write_to_is_left_out(folder: Path) -> None:
    (folder / server.SOCKET).touch()
    folder.chmod(0o777)
    assert client.sockets(str(folder.parent)) == []
