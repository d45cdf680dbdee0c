"""Server of the monitor: a socket in the program's private directory.

A client sends a request, one line of JSON.  The answer is lines of JSON, until the server closes
the connection.  The loop accepts connections, and a thread answers each of them.  So the monitor
costs nothing while there is no client.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
import threading
from collections.abc import Callable, Iterable
from typing import Any

from fiber import _logs
from fiber._transport.loop import Loop

SOCKET = "monitor"
"""Name of the socket in the program's directory."""

NAME = "name"
"""Name of the file beside it that has the program's name, for a program that does not answer."""

_UNFINISHED = "mon"
"""Name of the socket until it listens; short, as paths of sockets are."""

PEER = struct.Struct("iII")
"""Credentials of the other end of a socket: pid, uid, gid."""

_MOST_CLIENTS = 32
_BACKLOG = 4096
"""Clients that may wait for a program that is stopped.  Those that gave up count, too."""
_ACCEPT_AGAIN = 0.1
"""Seconds until the next attempt to accept a client, if no descriptor is free."""
_LONGEST = 1 << 16
"""Bytes of a request."""
_PATIENCE = 10.0
"""Seconds that a client may take to send its request, and to take a part of the answer."""

AnswerLines = dict[str, Any] | list[dict[str, Any]]
"""A line of an answer, or lines that are sent together."""

Answer = Callable[[dict[str, Any]], Iterable[AnswerLines]]


class MonitorServer:
    """Server of one program.  ``answer`` runs on a thread for each client."""

    def __init__(self, loop: Loop, directory: str, name: str, answer: Answer) -> None:
        """Listen in ``directory``; OSError if that is not possible.  Any thread."""
        self._loop = loop
        self._answer = answer
        self._clients: set[socket.socket] = set()
        self.path = os.path.join(directory, SOCKET)
        with open(os.path.join(directory, NAME), "w", encoding="utf-8") as file:
            file.write(name)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        try:
            self._listen(os.path.join(directory, _UNFINISHED))
        except BaseException:
            self._listener.close()
            raise
        loop.call_soon(loop.register, self._listener.fileno(), self._accept)

    def _listen(self, unfinished: str) -> None:
        # A socket that does not listen yet would look like that of a killed program.
        self._listener.bind(unfinished)
        self._listener.listen(_BACKLOG)
        os.rename(unfinished, self.path)

    def close(self) -> None:
        """Refuse clients, and end the answers.  Runs after the end of the loop."""
        self._listener.close()
        with contextlib.suppress(OSError):
            os.unlink(self.path)
        for client in list(self._clients):
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def forget(self) -> None:
        """Close this process's copies of the sockets, after a fork."""
        self._listener.close()
        for client in list(self._clients):
            client.close()

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except BlockingIOError:  # the client is gone
            return
        except OSError:  # no descriptor is free, and the loop would spin
            self._loop.pause(self._listener.fileno())
            self._loop.call_later(_ACCEPT_AGAIN, self._accept_again)
            return
        _, uid, _ = PEER.unpack(client.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, PEER.size))
        if uid not in (os.geteuid(), 0) or len(self._clients) >= _MOST_CLIENTS:
            client.close()
            return
        self._clients.add(client)
        try:
            threading.Thread(
                target=self._serve, args=(client,), name="fiber-monitor", daemon=True
            ).start()
        except RuntimeError as error:  # the system has no room for a thread
            _logs.debug("no thread for a client of the monitor: %s", error)
            self._clients.discard(client)
            client.close()

    def _accept_again(self) -> None:
        if self._listener.fileno() >= 0:
            self._loop.resume(self._listener.fileno())

    def _serve(self, client: socket.socket) -> None:
        try:
            client.settimeout(_PATIENCE)
            with client, contextlib.suppress(OSError):
                for lines in self._lines(client):
                    client.sendall(_encoded(lines))
        finally:
            self._clients.discard(client)

    def _lines(self, client: socket.socket) -> Iterable[AnswerLines]:
        try:
            with client.makefile("rb") as stream:
                request = json.loads(stream.readline(_LONGEST))
            yield from self._answer(request)
        except OSError:
            raise
        except Exception as error:  # the client shows it
            yield {"error": f"{type(error).__name__}: {error}"}


def _encoded(lines: AnswerLines) -> bytes:
    # Each call of the system lets a busy thread take Python's lock, so many lines need one call.
    listed = lines if isinstance(lines, list) else [lines]
    return b"".join(json.dumps(line).encode() + b"\n" for line in listed)
