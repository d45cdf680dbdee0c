"""Attacker on the path between an agent and its master, who sees and forwards each byte.

There is no network: the agent's end and the master's are sockets that were made by hand, as a relay
would have them.
"""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Callable, Iterator
from typing import NamedTuple

from fiber._transport.listener import MasterListener

TLS, GREETING, MESSAGE = "tls", "greeting", "message"
UP, DOWN = "up", "down"
CUT = None
"""Marker in place of a unit: the connection ends here."""

_RECORD = struct.Struct(">BHH")
_LENGTH = struct.Struct(">Q")
_GREETING = 8


class Unit(NamedTuple):
    """A TLS record, nng's greeting or a message of nng's, as it travels."""

    connection: int
    direction: str
    kind: str
    number: int
    """From 0, among those of its connection, direction and kind."""
    data: bytes


Meddle = Callable[[Unit], list[bytes | None]]


class Path:
    """Connects an agent to ``listener``; ``meddle`` says what is forwarded for each unit."""

    def __init__(self, listener: MasterListener, meddle: Meddle) -> None:
        self._listener = listener
        self._meddle = meddle
        self._threads: list[threading.Thread] = []
        self._sockets: list[socket.socket] = []
        self.connections = 0

    def connect(self, _address: str) -> socket.socket:
        """Connect, as an agent uses it in place of dialling."""
        agent, agents = socket.socketpair()
        master, masters = socket.socketpair()
        self._listener.take(master, f"the path, {self.connections}")
        for direction, source, target in ((UP, agents, masters), (DOWN, masters, agents)):
            thread = threading.Thread(
                target=self._pump, args=(self.connections, direction, source, target)
            )
            self._threads.append(thread)
            thread.start()
        self._sockets += agents, masters
        self.connections += 1
        return agent

    def close(self) -> None:
        """Cut everything."""
        for sock in self._sockets:
            _cut(sock)
        for thread in self._threads:
            thread.join()
        for sock in self._sockets:
            sock.close()

    def _pump(
        self, connection: int, direction: str, source: socket.socket, target: socket.socket
    ) -> None:
        counts = {TLS: 0, GREETING: 0, MESSAGE: 0}
        try:
            for kind, data in _units(source):
                unit = Unit(connection, direction, kind, counts[kind], data)
                counts[kind] += 1
                for forwarded in self._meddle(unit):
                    if forwarded is CUT:
                        return
                    target.sendall(forwarded)
        except (OSError, EOFError):
            pass  # one end hung up
        finally:
            _cut(source)
            _cut(target)


def _units(source: socket.socket) -> Iterator[tuple[str, bytes]]:
    greeted = False
    while True:
        if greeted:
            head = _exactly(source, _LENGTH.size)
            yield MESSAGE, head + _exactly(source, *_LENGTH.unpack(head))
            continue
        first = _exactly(source, 1)
        if first != b"\0":
            head = first + _exactly(source, _RECORD.size - 1)
            yield TLS, head + _exactly(source, _RECORD.unpack(head)[2])
        else:
            greeted = True
            yield GREETING, first + _exactly(source, _GREETING - 1)


def _exactly(source: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        more = source.recv(size - len(data))
        if not more:
            raise EOFError
        data += more
    return data


def _cut(sock: socket.socket) -> None:
    try:
        sock.shutdown(socket.SHUT_RDWR)
    except OSError:
        pass  # it is cut already
