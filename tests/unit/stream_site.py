"""Two multiplexers with a carrier between them, and the programs at the ends of their streams."""

from __future__ import annotations

import random
import socket
from collections.abc import Callable

from fiber._transport.multiplexer import Multiplexer, SocketCarrier, _Stream
from fiber._wire.streams import FrameDecoder, StreamFrame
from unit.stepped_loop import SteppedLoop


class Program:
    """Program at the end of a stream: its socket, what it has still to send, and what it got."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self.sock = sock
        self.got = bytearray()
        self.at_end = False
        self._unsent = memoryview(b"")

    def give(self, data: bytes) -> None:
        """Send ``data`` in the next turns."""
        self._unsent = memoryview(bytes(self._unsent) + data)

    @property
    def unsent(self) -> int:
        return len(self._unsent)

    def write(self) -> int:
        """Send what the socket takes now; return how much."""
        try:
            sent = self.sock.send(self._unsent) if self._unsent else 0
        except BlockingIOError:
            return 0
        except OSError:  # the stream is cut
            self._unsent = memoryview(b"")
            return 0
        self._unsent = self._unsent[sent:]
        return sent

    def read(self, most: int = 1 << 20) -> int:
        """Read what is there; return how much."""
        try:
            data = self.sock.recv(most)
        except BlockingIOError:
            return 0
        self.at_end |= not data
        self.got += data
        return len(data)

    def is_cut(self) -> bool:
        """Return whether the other end is closed, wholly or with an error; drops what is left."""
        try:
            while data := self.sock.recv(1 << 20):
                self.got += data
            self.sock.send(b"x")
        except BlockingIOError:
            return False
        except OSError:
            return True
        return False

    def close(self) -> None:
        self.sock.close()


class Tunnel:
    """Relay's end, which opens streams, and master's end, over a pair of sockets."""

    def __init__(self, loop: SteppedLoop) -> None:
        self.loop = loop
        self.programs: list[Program] = []
        self.masters: list[Program] = []
        self.origins: list[str] = []
        self.ends: list[str] = []
        self.hellos: list[StreamFrame] = []
        self.carriers = [SocketCarrier(sock) for sock in socket.socketpair()]
        self.relay = self.end(self.carriers[0])
        self.master = self.end(self.carriers[1], self.take)

    def end(
        self, carrier: SocketCarrier, on_open: Callable[[str], socket.socket] | None = None
    ) -> Multiplexer:
        return Multiplexer(
            self.loop,
            carrier,
            on_hello=self.hellos.append,
            on_end=self.ends.append,
            on_open=on_open,
        )

    def take(self, origin: str) -> socket.socket:
        """Return the socket of a new stream at the master."""
        near, far = socket.socketpair()
        self.origins.append(origin)
        self.masters.append(self._program(far))
        return near

    def stream(self, origin: str = "10.0.0.1:1") -> tuple[Program, Program]:
        """Open a stream; return the agent and its counterpart in the master."""
        end, agent = socket.socketpair()
        self.relay.open(end, origin)
        self.loop.settle()
        return self._program(agent), self.masters[-1]

    def _program(self, sock: socket.socket) -> Program:
        program = Program(sock)
        self.programs.append(program)
        return program

    def pump(self, *readers: Program) -> None:
        """Let all programs write and ``readers`` read until no byte moves any more."""
        moved = 1
        while moved:
            self.loop.settle()
            moved = sum(program.write() for program in self.programs if program.unsent)
            moved += sum(program.read() for program in readers)

    def close(self) -> None:
        self.relay.close()
        self.master.close()
        for program in self.programs:
            program.close()
        self.loop.settle()
        assert self.loop.watched() == 0


class Peer:
    """Other side of one multiplexer, which sends what the test wants."""

    def __init__(self, tunnel: Tunnel, end: Multiplexer, sock: socket.socket) -> None:
        sock.setblocking(False)
        self.sock = sock
        self.end = end
        self._loop = tunnel.loop
        self._decoder = FrameDecoder()

    def send(self, *frames: StreamFrame | bytes) -> None:
        """Send them, and run the loop until they have been taken."""
        data = b"".join(f if isinstance(f, bytes) else f.encode() for f in frames)
        while data and not self.end.is_over():
            try:
                data = data[self.sock.send(data) :]
            except BlockingIOError:
                pass  # the multiplexer has its turn
            except ConnectionError:
                break
            self._loop.settle()

    def frames(self) -> list[StreamFrame]:
        """Return what has arrived."""
        self._loop.settle()
        found: list[StreamFrame] = []
        try:
            while data := self.sock.recv(1 << 20):
                found += self._decoder.feed(data)
                self._loop.settle()
        except (BlockingIOError, ConnectionError):
            pass
        return found


def kept(end: Multiplexer) -> int:
    """Return the bytes that a multiplexer has taken and not passed on."""
    waiting = sum(len(stream.incoming) for stream in end._streams.values())
    return waiting + end._carrier.backlog


def only(end: Multiplexer) -> _Stream:
    """Return its only stream."""
    (stream,) = end._streams.values()
    return stream


def noise(size: int, seed: int = 1) -> bytes:
    return random.Random(seed).randbytes(size)
