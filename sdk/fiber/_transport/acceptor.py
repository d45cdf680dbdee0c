"""Takes connections, and lets pass who proves in time to have the pool's credentials.

It has a thread and a loop of its own.  TLS costs milliseconds of processor time for each who comes,
be it a thousand agents or strangers without end, and the program's own loop must not wait for that;
one thread is all that they get together.  Nothing on it blocks, OpenSSL runs without the
interpreter's lock, and who is slow holds up nobody but himself.
"""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import select
import socket
import ssl
from collections.abc import Callable

from fiber._transport import address as addresses
from fiber._transport import tls
from fiber._transport.admission import Admission
from fiber._transport.loop import Loop
from fiber._transport.refusals import Refusals
from fiber._transport.sealing import Secrets
from fiber._wire.messages import ProtocolError
from fiber.errors import LinkError, TooManyOpenFiles

_DEADLINE = 10.0
"""Seconds for a connection to prove itself, all in all."""

_MOST = 512
"""Pending connections at the same time; half of them from one address, as a relay or a NAT has one
for all.  Never more than a quarter of the descriptors that this process may have."""

_TURN = 16
"""Connections taken in one turn, so that those under way have theirs."""

_PAUSE = 0.2
"""Seconds without accepting when there is no descriptor left."""

_LAST_WORD = 1.0
"""Seconds for the peer to read why it was turned away: closing at once might destroy that."""

_BACKLOG = 1024

_SHORT_OF_DESCRIPTORS = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


class Acceptor:
    """Listens on ``address`` (port 0: a free one), which then says where it really does.

    ``on_hello`` is called on its thread with a connection that has proved itself, and its first
    words; ``on_refused`` with why one was turned away, once in some minutes for each address and
    reason.  Strangers from many addresses are summed up.
    """

    def __init__(
        self,
        address: str,
        context: ssl.SSLContext,
        *,
        on_hello: Callable[[PendingConnection, bytes], None],
        on_refused: Callable[[str], None],
    ) -> None:
        self.context = context
        self.on_hello = on_hello
        self.loop = Loop()
        self._on_refused = on_refused
        self._refusals = Refusals()
        descriptors = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        most = min(_MOST, max(descriptors // 4, 2))
        self._admission = Admission(most, most // 2)
        try:
            self._listener = _listen(address)
        except BaseException:
            self.loop.stop()
            raise
        self.address = f"{address.rpartition(':')[0]}:{self._listener.getsockname()[1]}"
        self.loop.register(self._listener.fileno(), self._accept)
        self._pending: set[PendingConnection] = set()
        self.loop.start_thread("fiber-accept")

    def take(self, sock: socket.socket, origin: str) -> None:
        """Treat a connection that came by another way, a relay's say, as if it were accepted."""
        self.loop.call_soon(self._admit, sock, origin, origin)

    def close(self) -> None:
        """Take nobody any more and hang up on who is under way.  Not on its own thread."""
        self.loop.call_soon(self._close)
        self.loop.stop()

    # On its own thread

    def report(self, host: str, origin: str, reason: str, *, proven: bool = False) -> None:
        """Somebody was turned away; ``proven``: one with the pool's credentials."""
        news = self._refusals.news(host, origin, reason, self.loop.now(), own=proven)
        if news:
            self._on_refused(news)

    def forget(self, connection: PendingConnection) -> None:
        """It is gone, or in."""
        self._admission.leave(connection)
        self._pending.discard(connection)

    def _accept(self) -> None:
        for _ in range(_TURN):
            try:
                sock, (host, port, *_) = self._listener.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno in _SHORT_OF_DESCRIPTORS:
                    self._pause(error)
                    return
                continue  # that connection broke before it was taken
            self._admit(sock, host, f"{host}:{port}")

    def _pause(self, error: OSError) -> None:
        self.report("", "whoever comes now", f"{error.strerror}; it is tried again all the time")
        self.loop.unregister(self._listener.fileno())
        self.loop.call_later(_PAUSE, self._resume)

    def _resume(self) -> None:
        if self._listener.fileno() >= 0:
            self.loop.register(self._listener.fileno(), self._accept)

    def _admit(self, sock: socket.socket, host: str, origin: str) -> None:
        connection = PendingConnection(self, host, origin)
        admitted, leaves = self._admission.enter(connection, host, self.loop.now())
        if isinstance(leaves, PendingConnection):
            leaves.refuse("it said nothing, and others want to come in")
        if not admitted:
            self.report("", origin, "too many come at the same time")
            sock.close()
            return
        self._pending.add(connection)
        try:
            connection.start(sock)
        except tls.HungUp:
            self.forget(connection)

    def _close(self) -> None:
        if self._listener.fileno() >= 0:
            self.loop.unregister(self._listener.fileno())
            self._listener.close()
        for connection in list(self._pending):
            connection.hang_up()


class PendingConnection:
    """A connection from its first byte to its last in TLS."""

    def __init__(self, acceptor: Acceptor, host: str, origin: str) -> None:
        self.origin = origin
        self._host = host
        self._acceptor = acceptor
        self._loop = acceptor.loop
        self._watched: int | None = None

    def start(self, sock: socket.socket) -> None:
        """Prove each other and hear its first words; HungUp if it has gone already."""
        with contextlib.suppress(OSError):  # no TCP, or broken already
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._handshake = tls.Handshake(sock, self._acceptor.context)
        self._timer = self._loop.call_later(_DEADLINE, self._too_late)
        self._run(self._handshake.listen(), lambda hello: self._acceptor.on_hello(self, hello))

    def welcome(self, greeting: bytes, then: Callable[[int, Secrets], None]) -> None:
        """Answer it and end TLS; ``then`` gets the connection, on the acceptor's thread.  Any
        thread.
        """
        self._loop.call_soon(self._answer, greeting, lambda end: then(*end))

    def turn_away(self, greeting: bytes, reason: str) -> None:
        """Answer it, hang up and tell whom it concerns.  Any thread."""
        self.report_proven(reason)
        self._loop.call_soon(self._answer, greeting, lambda end: os.close(end[0]))

    def report_proven(self, reason: str) -> None:
        """It has the pool's credentials, and is nobody who can be served.  Any thread."""
        self._loop.call_soon(
            lambda: self._acceptor.report(self._host, self.origin, reason, proven=True)
        )

    def _answer(self, greeting: bytes, then: Callable[[tuple[int, Secrets]], None]) -> None:
        if self.gone:
            return

        def passed(end: tuple[int, Secrets]) -> None:
            self._leave()
            then(end)

        self._run(
            self._handshake.answer(greeting), lambda _: self._run(self._handshake.end(), passed)
        )

    @property
    def gone(self) -> bool:
        """Whether it hung up or was hung up on."""
        return self._handshake.sock.fileno() < 0

    def refuse(self, what: str) -> None:
        """Hang up, and tell whom it concerns."""
        self._acceptor.report(self._host, self.origin, what)
        self.hang_up()

    def hang_up(self) -> None:
        """Let go of it."""
        self._unwatch()
        self._handshake.close()
        self._leave()

    def _leave(self) -> None:
        self._timer.cancel()
        self._acceptor.forget(self)

    def _run(self, steps: tls.Steps[tls._T], then: Callable[[tls._T], None]) -> None:
        """Go on with ``steps`` whenever the connection is ready."""

        def step() -> None:
            try:
                self._watch(next(steps), step)
            except StopIteration as finished:
                self._unwatch()
                then(finished.value)
            except (tls.Untrusted, tls.HungUp, ProtocolError) as error:
                self._acceptor.report(self._host, self.origin, str(error))
                self._part()

        step()

    def _watch(self, event: int, step: Callable[[], None]) -> None:
        fd = self._handshake.sock.fileno()
        if self._watched is None:
            self._watched = fd
            self._loop.register(fd, step)
        self._loop.want_write(fd, step if event == select.POLLOUT else None)

    def _unwatch(self) -> None:
        if self._watched is not None:
            self._loop.unregister(self._watched)
            self._watched = None

    def _part(self) -> None:
        """Let it read the alert that says why, then hang up."""
        self._unwatch()
        sock = self._handshake.sock
        try:
            socket.socket.shutdown(sock, socket.SHUT_WR)
        except OSError:  # it has hung up itself
            self.hang_up()
            return
        self._timer.cancel()
        self._timer = self._loop.call_later(_LAST_WORD, self.hang_up)
        self._watched = sock.fileno()
        self._loop.register(self._watched, self._drain)

    def _drain(self) -> None:
        try:
            rest = os.read(self._handshake.sock.fileno(), 1 << 16)
        except BlockingIOError:
            return
        except OSError:
            rest = b""
        if not rest:
            self.hang_up()

    def _too_late(self) -> None:
        self.refuse(f"it did not prove itself within {_DEADLINE:g} s")


def _listen(address: str) -> socket.socket:
    host, port = addresses.parse(address)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise LinkError(
                f"cannot listen on {address}: another program uses that port. Stop it, or choose "
                "another port; port 0 takes a free one."
            ) from error
        if error.errno in (errno.EMFILE, errno.ENFILE):
            raise TooManyOpenFiles(f"listening on {address}") from error
        raise LinkError(
            f"cannot listen on {address}: {str(error.strerror or error).lower()}. Use an address "
            "of this host and a port that this user may bind."
        ) from error
    listener.setblocking(False)
    return listener
