"""Multiplexer: many streams over one connection, with separate flow control for each.

The relay and the master have one each, at the two ends of a port-forward.  Each stream ends at a
socket: in the relay at the TCP connection of an agent, in the master at one end of a socket pair.
A ``Multiplexer`` moves bytes between these sockets and its ``Carrier``, and cannot read them.

Memory is bounded.  The multiplexer reads a socket only while the stream has credit and the carrier
has little left to send.  For the other direction it grants each stream ``FIRST_CREDIT`` bytes.  It
grants more to streams whose socket takes the bytes at once, up to ``_LARGEST_WINDOW`` each and
``_SPARE`` for all together, and takes that back from streams whose socket is slow.  A peer that
makes the multiplexer answer, and does not read the answers, is cut off.

END closes one direction.  If the program at a socket has closed it wholly, ABORT follows END: then
the other side delivers what it has, and closes its socket too.
"""

from __future__ import annotations

import contextlib
import socket
from collections import deque
from collections.abc import Callable
from typing import Protocol

from fiber._transport.loop import Loop, LoopTimer
from fiber._wire.messages import ProtocolError
from fiber._wire.streams import FIRST_CREDIT, MOST_DATA, FrameDecoder, Kind, StreamFrame, credit

_LARGEST_WINDOW = 1 << 20
"""Bytes that one stream may have on their way, at most: 50 MB/s at a round trip of 20 ms."""

_SPARE = 64 << 20
"""Bytes that all streams may have on their way beyond their first credit."""

_FULL = 256 << 10
"""Bytes that the carrier has left to send, above which no socket is read."""

_UNREAD = 1 << 20
"""Bytes that the carrier has left to send, above which the other side counts as broken.  The bytes
of streams fill a quarter of it; the rest is for short frames."""

_LINGER = 10.0
"""Seconds for a socket to take the last bytes of a stream that the other side has closed."""

_PING_AFTER, _DEAD_AFTER = 3.0, 12.0
"""Seconds of silence until a PING, and until the connection counts as dead."""


class Carrier(Protocol):
    """Connection that carries the frames.  It never blocks.  Errors are OSError."""

    backlog: int
    """Bytes that are left to send."""

    def fileno(self) -> int:
        """Return the descriptor to watch; negative once it is closed."""

    def receive(self) -> bytes | None:
        """Return bytes; None if there are none now, and ``b""`` at the end."""

    def write(self, data: bytes) -> None:
        """Send ``data``, or keep what cannot be sent now."""

    def flush(self) -> None:
        """Send what was kept."""

    def close(self) -> None:
        """Close the connection."""


class SocketCarrier:
    """Carrier over a connected socket."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        self.sock = sock
        self.backlog = 0
        self._kept: deque[memoryview] = deque()

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self.sock.fileno()

    def receive(self) -> bytes | None:
        """Return bytes from the socket."""
        return receive(self.sock, 4 * MOST_DATA)

    def write(self, data: bytes) -> None:
        """Send ``data``, or keep what cannot be sent now."""
        self._kept.append(memoryview(data))
        self.backlog += len(data)
        if len(self._kept) == 1:
            self.flush()

    def flush(self) -> None:
        """Send what was kept."""
        while self._kept:
            sent = send(self.sock, self._kept[0])
            self.backlog -= sent
            if sent == len(self._kept[0]):
                self._kept.popleft()
            else:
                self._kept[0] = self._kept[0][sent:]
                if not sent:
                    return

    def close(self) -> None:
        """Close the socket."""
        self.sock.close()


def receive(sock: socket.socket, most: int) -> bytes | None:
    """Return bytes from a socket; None if there are none now."""
    try:
        return sock.recv(most)
    except BlockingIOError:
        return None


def send(sock: socket.socket, data: memoryview) -> int:
    """Send bytes; return how many the socket took."""
    try:
        return sock.send(data)
    except BlockingIOError:
        return 0


class _Stream:
    """Stream with its socket."""

    __slots__ = (
        "closed",
        "credit",
        "ended",
        "held",
        "incoming",
        "number",
        "parked",
        "peer_ended",
        "sock",
        "taken",
        "window",
    )

    def __init__(self, number: int, sock: socket.socket) -> None:
        self.number = number
        self.sock = sock
        self.credit = FIRST_CREDIT
        """Bytes that may be sent to the other side."""
        self.window = FIRST_CREDIT
        """Bytes that the other side may have sent and the socket has not taken."""
        self.taken = 0
        """Bytes that the socket took and for which no credit was granted yet."""
        self.incoming = bytearray()
        """Bytes that the socket has not taken."""
        self.held = False
        """True while the socket is not read."""
        self.parked = False
        """True while the socket is not even watched, because its peer has closed it."""
        self.ended = False
        """True once the socket has reached its end."""
        self.peer_ended = False
        """True once the other side has sent END."""
        self.closed = False
        """True once the other side has sent ABORT after END."""


class Multiplexer:
    """End of a connection that streams share.  Runs on the thread of ``loop``.

    ``on_open`` gets the address of an agent and returns the socket for its stream.  ``on_hello``
    gets a HELLO frame.  ``on_end`` is called once, with the reason, when the connection is broken
    or the other side has broken the protocol.  After that all sockets are closed.
    """

    def __init__(
        self,
        loop: Loop,
        carrier: Carrier,
        *,
        on_hello: Callable[[StreamFrame], None],
        on_end: Callable[[str], None],
        on_open: Callable[[str], socket.socket] | None = None,
    ) -> None:
        self._loop = loop
        self._carrier = carrier
        self._on_hello = on_hello
        self._on_open = on_open
        self._on_end = on_end
        self._decoder = FrameDecoder()
        self._streams: dict[int, _Stream] = {}
        self._numbers = 0
        self._spare = _SPARE
        self._held: dict[_Stream, None] = {}
        """Streams that have bytes and wait until the carrier has sent its backlog."""
        self._reads_on = False
        """True while a call that reads the carrier is scheduled."""
        self._heard = loop.now()
        self._timer: LoopTimer | None = loop.call_later(_PING_AFTER, self._check_silence)
        self._writes = False
        self._over = False
        self._fd = carrier.fileno()
        loop.register(self._fd, self._read_carrier)

    def __len__(self) -> int:
        return len(self._streams)

    def is_over(self) -> bool:
        """Return whether the connection is closed."""
        return self._over

    def send(self, frame: StreamFrame) -> None:
        """Send a frame."""
        if self.is_over():
            return
        try:
            self._carrier.write(frame.encode())
        except OSError as error:
            self._loop.call_soon(self._break, _words(error))
            return
        self._watch_writes()
        if self._carrier.backlog > _UNREAD:
            self._loop.call_soon(self._break, "the other side does not read what it is sent")

    def open(self, sock: socket.socket, origin: str) -> None:
        """Open a stream for ``sock``, a connection from ``origin``."""
        if self.is_over():
            sock.close()
            return
        self._numbers += 1
        self.send(StreamFrame(Kind.OPEN, self._numbers, origin.encode()))
        self._add(self._numbers, sock)

    def close(self) -> None:
        """Close the connection and all sockets.  ``on_end`` is not called."""
        if self.is_over():
            return
        self._over = True
        if self._timer is not None:
            self._timer.cancel()
        self._loop.unregister(self._fd)
        for stream in list(self._streams.values()):
            self._remove(stream)
        with contextlib.suppress(OSError):
            self._carrier.close()

    def _break(self, reason: str) -> None:
        if not self.is_over():
            self.close()
            self._on_end(reason)

    def _check_silence(self) -> None:
        silence = self._loop.now() - self._heard
        if silence >= _DEAD_AFTER:
            self._break(f"it was silent for {silence:.0f} s")
            return
        if silence >= _PING_AFTER:
            self.send(StreamFrame(Kind.PING))
        self._timer = self._loop.call_later(_PING_AFTER, self._check_silence)

    # -- The carrier

    def _watch_writes(self) -> None:
        waits = self._carrier.backlog > 0
        if waits != self._writes:
            self._writes = waits
            self._loop.want_write(self._fd, self._flush if waits else None)

    def _flush(self) -> None:
        try:
            self._carrier.flush()
        except OSError as error:
            self._break(_words(error))
            return
        self._watch_writes()
        if self._carrier.backlog <= _FULL // 2:
            held, self._held = self._held, {}
            for stream in held:
                self._resume(stream)

    def _read_carrier(self) -> None:
        if self.is_over():
            return
        try:
            piece = self._carrier.receive()
            if piece:
                self._heard = self._loop.now()
                for frame in self._decoder.feed(piece):
                    self._take(frame)
                    if self.is_over():
                        return
                self._read_on()
        except OSError as error:
            self._break(_words(error))
        except ProtocolError as error:
            self._break(str(error))
        else:
            if piece == b"":
                self._break("it was closed by the other side")

    def _read_on(self) -> None:
        """Read the carrier again, after the sockets have had their turn.

        The descriptor need not become readable again, since TLS may have read more.
        """
        if not self._reads_on:
            self._reads_on = True
            self._loop.call_soon(self._read_again)

    def _read_again(self) -> None:
        self._reads_on = False
        self._read_carrier()

    def _take(self, frame: StreamFrame) -> None:
        if frame.kind is Kind.PING:
            self.send(StreamFrame(Kind.PONG))
        elif frame.kind is Kind.HELLO:
            self._on_hello(frame)
        elif frame.kind is Kind.OPEN:
            self._take_open(frame)
        elif (stream := self._streams.get(frame.stream)) is None:
            return  # it ended here while this frame was on its way
        elif frame.kind is Kind.DATA:
            self._take_data(stream, frame.payload)
        elif frame.kind is Kind.CREDIT:
            stream.credit += frame.credit
            self._resume(stream)
        elif frame.kind is Kind.END:
            stream.peer_ended = True
            self._write_socket(stream)
        elif frame.kind is Kind.ABORT:
            self._take_abort(stream)

    def _take_open(self, frame: StreamFrame) -> None:
        if self._on_open is None or frame.stream in self._streams:
            raise ProtocolError(f"the stream {frame.stream} cannot be opened")
        try:
            sock = self._on_open(frame.origin)
        except OSError:  # no descriptor is free; the agent dials again
            self.send(StreamFrame(Kind.ABORT, frame.stream))
            return
        self._add(frame.stream, sock)

    def _take_data(self, stream: _Stream, data: bytes) -> None:
        if len(stream.incoming) + stream.taken + len(data) > stream.window:
            raise ProtocolError("a stream has sent more than its credit")
        if stream.peer_ended:
            raise ProtocolError("a stream has sent bytes after its end")
        waited = bool(stream.incoming)
        stream.incoming += data
        if not waited:
            self._write_socket(stream)

    def _take_abort(self, stream: _Stream) -> None:
        if not stream.peer_ended or not stream.incoming:
            self._remove(stream)
        elif not stream.closed:
            stream.closed = True
            self._loop.call_later(_LINGER, self._remove, stream)

    # -- The sockets

    def _add(self, number: int, sock: socket.socket) -> None:
        sock.setblocking(False)
        self._streams[number] = stream = _Stream(number, sock)
        self._loop.register(sock.fileno(), lambda: self._read_socket(stream))

    def _is_open(self, stream: _Stream) -> bool:
        return self._streams.get(stream.number) is stream

    def _remove(self, stream: _Stream) -> None:
        if self._is_open(stream):
            del self._streams[stream.number]
            self._held.pop(stream, None)
            self._spare += stream.window - FIRST_CREDIT
            self._loop.unregister(stream.sock.fileno())
            stream.sock.close()

    def _abort(self, stream: _Stream) -> None:
        if self._is_open(stream):
            self.send(StreamFrame(Kind.ABORT, stream.number))
            self._remove(stream)

    def _hold(self, stream: _Stream) -> None:
        if not stream.held:
            stream.held = True
            self._loop.pause(stream.sock.fileno())

    def _park(self, stream: _Stream) -> None:
        """Stop watching the socket.  The loop reports one that its peer has closed all the time."""
        if not stream.parked:
            stream.parked = True
            self._loop.unregister(stream.sock.fileno())

    def _resume(self, stream: _Stream) -> None:
        if stream.held and stream.credit and not stream.ended and self._is_open(stream):
            stream.held = False
            if stream.parked:
                stream.parked = False
                self._loop.register(stream.sock.fileno(), lambda: self._read_socket(stream))
            else:
                self._loop.resume(stream.sock.fileno())

    def _read_socket(self, stream: _Stream) -> None:
        if stream.held:
            # Nobody waits for bytes, so the socket's peer has closed it wholly.
            if stream.ended:
                self._abort(stream)
            else:
                self._park(stream)
            return
        if not stream.credit or stream.closed:
            self._hold(stream)
            return
        if self._carrier.backlog > _FULL:
            self._hold(stream)
            self._held[stream] = None
            return
        try:
            data = receive(stream.sock, min(stream.credit, MOST_DATA))
        except OSError:
            self._abort(stream)
            return
        if data is None:
            return
        if data:
            stream.credit -= len(data)
            self.send(StreamFrame(Kind.DATA, stream.number, data))
            return
        stream.ended = True
        self.send(StreamFrame(Kind.END, stream.number))
        self._hold(stream)
        self._remove_if_over(stream)

    def _write_socket(self, stream: _Stream) -> None:
        try:
            while stream.incoming:
                with memoryview(stream.incoming) as waiting:
                    sent = send(stream.sock, waiting)
                if not sent:
                    break
                del stream.incoming[:sent]
                stream.taken += sent
            if stream.peer_ended and not stream.incoming:
                stream.sock.shutdown(socket.SHUT_WR)
        except OSError:
            self._abort(stream)
            return
        waits = (lambda: self._write_socket(stream)) if stream.incoming else None
        self._loop.want_write(stream.sock.fileno(), waits)
        self._grant(stream)
        self._remove_if_over(stream)

    def _grant(self, stream: _Stream) -> None:
        """Grant credit for the bytes that the socket took, in pieces of half a window."""
        if stream.taken < stream.window // 2 or stream.peer_ended:
            return
        granted = stream.taken
        if stream.incoming:
            back = min(stream.taken, stream.window - FIRST_CREDIT)
            self._spare += back
            stream.window -= back
            granted -= back
        else:
            more = min(stream.window, _LARGEST_WINDOW - stream.window, self._spare)
            self._spare -= more
            stream.window += more
            granted += more
        stream.taken = 0
        if granted:
            self.send(credit(stream.number, granted))

    def _remove_if_over(self, stream: _Stream) -> None:
        if (stream.ended or stream.closed) and stream.peer_ended and not stream.incoming:
            self._remove(stream)


def _words(error: OSError) -> str:
    return str(error.strerror or error).lower()
