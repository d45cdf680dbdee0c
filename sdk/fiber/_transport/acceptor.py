"""Acceptor of connections from agents that prove in time which pod of which pool they are.

The acceptor has its own thread and loop.  A TLS handshake costs milliseconds of processor time.  A
thousand agents, or strangers without end, must not hold up the program's loop: one thread serves
them all.  Nothing on this thread blocks, OpenSSL runs without the interpreter's lock, and a slow
peer delays only itself.

``Admission`` limits pending connections, so that strangers neither use up the program's descriptors
nor keep agents waiting.  One limit holds for all pending connections, another for those from one
address.  At a limit, a newcomer replaces the oldest connection: from the same address, or else from
the address with the most connections.  A connection is not replaced before it has had a fair
chance.

``Refusals`` chooses the refusals that are logged, so that strangers with many addresses or many
faults do not fill the log and do not hide refusals of the program's own agents.
"""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import select
import socket
import threading
from collections.abc import Callable, Hashable
from typing import NamedTuple

from fiber._transport import authentication
from fiber._transport.authentication import (
    AgentHello,
    Identity,
    MasterRefusal,
    Secrets,
    join_address,
    parse_address,
)
from fiber._transport.credentials import Certificate, MasterCredentials
from fiber._transport.loop import Loop
from fiber._wire.messages import ProtocolError
from fiber.errors import LinkError, TooManyOpenFiles

_DEADLINE = 10.0
"""Seconds in which a connection must have proved itself."""

_MOST = 512
"""Limit of pending connections.  Half of them may come from one address, as from behind a NAT.  The
limit is never more than a quarter of the descriptors that this process may have."""

_TURN = 16
"""Connections accepted in one turn of the loop.  Then pending connections get their turn."""

_PAUSE = 0.2
"""Seconds without accepting after the process ran out of descriptors."""

_PAST = 16
"""Ended pools whose agents are told why they are refused."""

_LAST_WORD = 1.0
"""Seconds for the peer to read the reason for a refusal.  Closing at once could destroy it."""

_BACKLOG = 1024

MASTER = "the master"
"""Name under which every master greets its agents."""

_SHORT_OF_DESCRIPTORS = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


class ServedPool(NamedTuple):
    """Pool whose agents dial the acceptor.  Both functions run on the acceptor's thread."""

    credentials: MasterCredentials
    on_agent: Callable[[PendingConnection, AgentHello], None]
    """Called with a connection that has proved to be an agent of the pool."""
    on_refused: Callable[[str], None]
    """Called with the reason for refusing a connection, once in some minutes for each address and
    reason.  Strangers from many addresses are summed up."""


class Acceptor:
    """Listener on ``address`` for the agents of any number of pools.

    Port 0 takes a free port, and a range such as 9000-9009 its first free port; the attribute
    ``address`` has the port.  Connections are accepted once there is a pool.

    All pools show the same ``certificate``.  An agent does not name its pool: its proof tells the
    pool (decision 6).  A stranger has no pool, and is reported to the first one.
    """

    def __init__(self, address: str, certificate: Certificate) -> None:
        self.certificate = certificate
        self.context = authentication.master_context(certificate)
        self.loop = Loop()
        self._lock = threading.Lock()
        self._pools: tuple[ServedPool, ...] = ()
        self._past: tuple[ServedPool, ...] = ()
        """The last pools that were removed.  Their agents get that as the reason."""
        self._refusals = Refusals()
        descriptors = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        most = min(_MOST, max(descriptors // 4, 2))
        self._admission = Admission(most, most // 2)
        self._pending: set[PendingConnection] = set()
        with contextlib.ExitStack() as undo:
            undo.callback(self.loop.stop)
            self._listener = undo.enter_context(_listen(address))
            host = address.rpartition(":")[0].strip("[]")
            self.address = join_address(host, self._listener.getsockname()[1])
            self.loop.start_thread("fiber-accept")
            undo.pop_all()

    def add(self, pool: ServedPool) -> None:
        """Serve the agents of ``pool`` too.  Any thread."""
        with self._lock:
            first = not self._pools and not self._past
            self._pools += (pool,)
        if first:
            self.loop.call_soon(self._resume)

    def remove(self, pool: ServedPool) -> None:
        """Refuse the agents of ``pool`` from now on.  Any thread."""
        past = ServedPool(pool.credentials, _turn_away, on_refused=lambda reason: None)
        with self._lock:
            if pool in self._pools:
                self._pools = tuple(other for other in self._pools if other is not pool)
                self._past = (*self._past, past)[-_PAST:]

    def take(self, sock: socket.socket, origin: str) -> None:
        """Treat a connection from ``origin``, ``host:port``, as if it were accepted.

        For connections that come another way, for example through a relay.
        """
        self.loop.call_soon(self._admit, sock, origin.rpartition(":")[0], origin)

    def close(self) -> None:
        """Stop accepting, and close pending connections.  Do not call it on its own thread."""
        self.loop.call_soon(self._close)
        self.loop.stop()

    # On its own thread

    def report(
        self, host: str, origin: str, reason: str, *, pool: ServedPool | None = None
    ) -> None:
        """Report that a connection was refused: an agent of ``pool``, or a stranger."""
        own = pool is not None
        if news := self._refusals.news(host, origin, reason, self.loop.now(), own=own):
            for served in (pool,) if pool else self._pools[:1]:
                served.on_refused(news)

    def pool_of(self, believes: Callable[[MasterCredentials], bool]) -> ServedPool | None:
        """Return the pool with the credentials for which ``believes`` is true."""
        for pool in (*self._pools, *self._past):
            if believes(pool.credentials):
                return pool
        return None

    def make_room(self, connection: PendingConnection) -> None:
        """Stop counting ``connection`` as a stranger."""
        self._admission.leave(connection)

    def forget(self, connection: PendingConnection) -> None:
        """Forget ``connection``, which has ended or belongs to a link now."""
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
                continue  # that connection broke before it was accepted
            self._admit(sock, host, join_address(host, port))

    def _pause(self, error: OSError) -> None:
        self.report("", "new connections", f"{error.strerror}; Fiber tries again all the time")
        self.loop.unregister(self._listener.fileno())
        self.loop.call_later(_PAUSE, self._resume)

    def _resume(self) -> None:
        if self._listener.fileno() >= 0:
            self.loop.register(self._listener.fileno(), self._accept)

    def _admit(self, sock: socket.socket, host: str, origin: str) -> None:
        connection = PendingConnection(self, host, origin)
        admitted, leaves = self._admission.enter(connection, host, self.loop.now())
        if isinstance(leaves, PendingConnection):
            leaves.refuse("it sent nothing while other connections waited")
        if not admitted:
            self.report("", origin, "too many connections come at the same time")
            sock.close()
            return
        self._pending.add(connection)
        try:
            connection.start(sock)
        except authentication.PeerClosed:
            self.forget(connection)

    def _close(self) -> None:
        if self._listener.fileno() >= 0:
            self.loop.unregister(self._listener.fileno())
            self._listener.close()
        for connection in list(self._pending):
            connection.close()


class PendingConnection:
    """Connection from its first byte to its last byte in TLS."""

    def __init__(self, acceptor: Acceptor, host: str, origin: str) -> None:
        self.origin = origin
        self._host = host
        self._acceptor = acceptor
        self._loop = acceptor.loop
        self._watched: int | None = None
        self._awaited = ""
        self._pool: ServedPool | None = None
        self._agent = Identity("", 0, "", "")

    def start(self, sock: socket.socket) -> None:
        """Begin the handshake; PeerClosed if the peer has closed it already."""
        with contextlib.suppress(OSError):  # no TCP, or broken already
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        acceptor = self._acceptor
        self._handshake = authentication.MasterHandshake(
            sock, acceptor.context, acceptor.certificate
        )
        self._timer = self._loop.call_later(_DEADLINE, self._too_late)
        self._run(self._handshake.listen(), self._on_hello)

    def _on_hello(self, greeting: bytes) -> None:
        """Find the pool of the agent by its greeting and its proof."""
        try:
            hello = authentication.decode_greeting(greeting)
        except ProtocolError as error:
            self._distrust(f"it is no agent of Fiber: {error}")
            return
        if not isinstance(hello, AgentHello):
            self._distrust(f"{hello.identity.name!r} is no agent")
            return
        self._agent = agent = hello.identity
        self._pool = self._acceptor.pool_of(
            lambda credentials: self._handshake.believes(credentials, agent)
        )
        if self._pool is None:
            reason = f"it cannot prove that it is {agent.name!r}"
            self._acceptor.report(self._host, self.origin, reason)
            self._run(self._handshake.disbelieve(), lambda _: self._close_after_alert())
        else:
            self._acceptor.make_room(self)
            self._pool.on_agent(self, hello)

    def _distrust(self, reason: str) -> None:
        self._acceptor.report(self._host, self.origin, reason)
        self._close_after_alert()

    def waits_for(self, what: str) -> None:
        """Note what the agent waits for, as the reason if the deadline passes.  Any thread."""
        self._awaited = what

    def drop(self) -> None:
        """Close the connection without an answer.  Any thread."""
        self._loop.call_soon(lambda: None if self.gone else self.close())

    def welcome(self, greeting: bytes, then: Callable[[int, Secrets], None]) -> None:
        """Answer the agent and end TLS.  Any thread.

        ``then`` is called with the connection, on the acceptor's thread.
        """
        self._loop.call_soon(self._answer, greeting, lambda end: then(*end))

    def turn_away(self, greeting: bytes, reason: str) -> None:
        """Answer the agent, close the connection, and report the refusal.  Any thread."""
        self.report_proven(reason)
        if self._pool is None or not self._pool.credentials.complete:
            self.drop()  # the agent would not believe an answer
            return
        self._loop.call_soon(self._answer, greeting, lambda end: os.close(end[0]))

    def report_proven(self, reason: str) -> None:
        """Report an agent that has the pool's credentials and cannot be served.  Any thread."""
        self._loop.call_soon(
            lambda: self._acceptor.report(self._host, self.origin, reason, pool=self._pool)
        )

    def _answer(self, greeting: bytes, then: Callable[[tuple[int, Secrets]], None]) -> None:
        if self.gone or self._pool is None:
            return

        def passed(end: tuple[int, Secrets]) -> None:
            self._leave()
            then(end)

        answer = self._handshake.answer(self._pool.credentials, self._agent, greeting)
        self._run(answer, lambda _: self._run(self._handshake.end(), passed))

    @property
    def gone(self) -> bool:
        """True if one of the two sides has closed the connection."""
        return self._handshake.sock.fileno() < 0

    def refuse(self, what: str) -> None:
        """Close the connection, and report the reason."""
        self._acceptor.report(self._host, self.origin, what)
        self.close()

    def close(self) -> None:
        """Close the connection without an answer."""
        self._unwatch()
        self._handshake.close()
        self._leave()

    def _leave(self) -> None:
        self._timer.cancel()
        self._acceptor.forget(self)

    def _run(
        self,
        steps: authentication.Steps[authentication._T],
        then: Callable[[authentication._T], None],
    ) -> None:
        """Take one of the ``steps`` each time the connection is ready."""

        def step() -> None:
            try:
                self._watch(next(steps), step)
            except StopIteration as finished:
                self._unwatch()
                then(finished.value)
            except (authentication.Untrusted, authentication.PeerClosed, ProtocolError) as error:
                self._acceptor.report(self._host, self.origin, str(error))
                self._close_after_alert()

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

    def _close_after_alert(self) -> None:
        """Give the peer time to read the TLS alert, then close the connection."""
        self._unwatch()
        sock = self._handshake.sock
        try:
            socket.socket.shutdown(sock, socket.SHUT_WR)
        except OSError:  # the peer has closed it
            self.close()
            return
        self._timer.cancel()
        self._timer = self._loop.call_later(_LAST_WORD, self.close)
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
            self.close()

    def _too_late(self) -> None:
        if self._awaited:  # a proven agent: no number of strangers suppresses this report
            self.report_proven(f"{self._awaited} did not appear within {_DEADLINE:g} s")
            self.close()
        else:
            self.refuse(f"it did not prove itself within {_DEADLINE:g} s")


def _turn_away(connection: PendingConnection, hello: AgentHello) -> None:
    reason = "this master no longer uses the pool of this agent"
    refusal = MasterRefusal(Identity.of_this_process(MASTER), reason)
    connection.turn_away(refusal.encode(), reason)


def _listen(address: str) -> socket.socket:
    host, _, ports = address.rpartition(":")
    first, _, last = ports.partition("-")
    # Raise the last error: a wrong host is wrong at each port.
    for port in range(int(first), int(last)) if last else ():
        with contextlib.suppress(LinkError):
            return _listen_at(address, host.strip("[]"), port)
    return _listen_at(address, *parse_address(f"{host}:{last or first}"))


def _listen_at(address: str, host: str, port: int) -> socket.socket:
    try:
        families = [found[0] for found in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)]
        family = socket.AF_INET if socket.AF_INET in families else socket.AF_INET6
        both = host == "::" and socket.has_dualstack_ipv6()
        listener = socket.create_server(
            (host, port), family=family, backlog=_BACKLOG, dualstack_ipv6=both
        )
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise LinkError(
                f"cannot listen on {address}: another program uses that port, or other programs "
                "use all ports of the range. Stop one of them, or choose another port; port 0 "
                "takes a free one."
            ) from error
        if error.errno == errno.EADDRNOTAVAIL:
            raise LinkError(
                f"cannot listen on {address}: this machine does not have that address. Set "
                "listen_host to an address of this machine. Where agents dial another one, as "
                "behind NAT or port forwarding, set advertised_host to that."
            ) from error
        if error.errno in (errno.EMFILE, errno.ENFILE):
            raise TooManyOpenFiles(f"listening on {address}") from error
        raise LinkError(
            f"cannot listen on {address}: {str(error.strerror or error).lower()}. Use an address "
            "of this host and a port that this user may bind."
        ) from error
    listener.setblocking(False)
    return listener


_FAIR_CHANCE = 1.0
"""Seconds for which a newcomer replaces no connection; a handshake takes some hundredths of one."""


class AdmissionDecision(NamedTuple):
    """Decision about a newcomer, and the connection that it replaces, if any."""

    admitted: bool
    leaves: Hashable | None = None


class Admission:
    """Table of pending connections by address and age.  Pure: the caller passes the time."""

    def __init__(self, total: int, per_address: int) -> None:
        self._total = total
        self._per_address = per_address
        self._waiting: dict[str, dict[Hashable, float]] = {}
        self._addresses: dict[Hashable, str] = {}

    def __len__(self) -> int:
        return len(self._addresses)

    def enter(self, newcomer: Hashable, address: str, now: float) -> AdmissionDecision:
        """Decide whether ``newcomer`` is admitted."""
        crowd = self._crowd(address)
        leaves = None
        if crowd:
            leaves, since = next(iter(crowd.items()))
            if now - since < _FAIR_CHANCE:
                return AdmissionDecision(False)
            self.leave(leaves)
        self._waiting.setdefault(address, {})[newcomer] = now
        self._addresses[newcomer] = address
        return AdmissionDecision(True, leaves)

    def leave(self, one: Hashable) -> None:
        """Remove a connection that has proved itself, or has ended."""
        address = self._addresses.pop(one, None)
        if address is not None:
            crowd = self._waiting[address]
            del crowd[one]
            if not crowd:
                del self._waiting[address]

    def _crowd(self, address: str) -> dict[Hashable, float] | None:
        """Return the connections of which one must leave for a newcomer; None if there is room."""
        own = self._waiting.get(address, {})
        if len(own) >= self._per_address:
            return own
        if len(self) >= self._total:
            return max(self._waiting.values(), key=lambda crowd: (len(crowd), -_oldest(crowd)))
        return None


def _oldest(crowd: dict[Hashable, float]) -> float:
    return next(iter(crowd.values()))


_REMEMBERED = 256
"""Limit of remembered refusals: of strangers, and of the program's own agents."""

_FORGET = 300.0
"""Seconds until the same refusal is logged again, and between two summaries of strangers."""


class Refusals:
    """Refusals that were logged, and when.  Pure: the caller passes the time.

    An own agent is one that has proved to have the pool's credentials.
    """

    def __init__(self) -> None:
        self._strangers: dict[tuple[str, str], float] = {}
        self._own: dict[tuple[str, str], float] = {}
        self._suppressed = 0
        self._next_summary = 0.0

    def news(self, host: str, origin: str, reason: str, now: float, *, own: bool = False) -> str:
        """Return the text to log for a refusal; empty if the same was logged lately.

        ``own`` marks a refusal of an agent of the program: no number of strangers suppresses it.
        """
        logged = self._own if own else self._strangers
        _forget(logged, now)
        if (host, reason) in logged:
            return ""
        if len(logged) >= _REMEMBERED:
            if not own:
                return self._summary(origin, reason, now)
            del logged[next(iter(logged))]
        logged[host, reason] = now
        return f"{reason} ({origin})" if own else f"{origin} was turned away: {reason}"

    def _summary(self, origin: str, reason: str, now: float) -> str:
        self._suppressed += 1
        if now < self._next_summary:
            return ""
        count, self._suppressed = self._suppressed, 0
        self._next_summary = now + _FORGET
        return (
            f"strangers come from many addresses: {count} more turned away, the last was {origin} "
            f"({reason}). The next message about them comes in {_FORGET / 60:.0f} minutes"
        )


def _forget(logged: dict[tuple[str, str], float], now: float) -> None:
    for refusal, when in list(logged.items()):
        if now - when < _FORGET:
            return  # the others were logged later
        del logged[refusal]
