"""An agent's end of its link to the master.

A master may have several addresses, for instance of both IP families.  The attempts begin a quarter
of a second apart and run at the same time.  The first that succeeds is used (RFC 8305, Happy
Eyeballs).  An address of a family without a route costs no wait.
"""

from __future__ import annotations

import contextlib
import errno
import os
import random
import secrets
import select
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain, zip_longest
from typing import NamedTuple

from fiber._exceptions import fresh
from fiber._transport import authentication
from fiber._transport.authentication import (
    AgentHello,
    Identity,
    MasterRefusal,
    MasterWelcome,
    Secrets,
    parse_addresses,
)
from fiber._transport.credentials import Credentials, ProvenMaster
from fiber._transport.link import Keepalive, Link, LinkConnection
from fiber._transport.loop import Loop
from fiber._transport.nng import SealedConnection
from fiber._wire.messages import ProtocolError
from fiber.errors import AuthenticationError, FiberError, LinkError

_PAUSE_MIN, _PAUSE_MAX = 0.1, 0.3
"""Seconds between attempts to dial; they grow.  A thousand agents that wait for a master must
neither flood its network nor keep it waiting."""

_CONNECT = 1.0
"""Seconds for a connection to be made.  Later the kernel would repeat its request (RFC 6298) at
growing intervals, and always to the pod that a Service chose at first, which may have ended."""

_GREET = 15.0
"""Seconds from the connection to the welcome and the end of TLS.  A thousand agents may dial one
master at the same time, and each costs it milliseconds.  The limit is for a host that vanishes in
the middle."""

_LONGER = 2
"""Factor by which an agent waits longer in silence than its master does."""


class MasterUnreachable(Exception):
    """Error: no master accepted the connection, or it ended before the welcome."""


class EarlierMaster(LinkError):
    """Error: the master came before one that the agent has served, or before the agent's pod."""


class AgentDialer:
    """Agent's end of the link: dials the master until it answers or ``timeout`` seconds are over.

    ``address`` is ``host:port``, with commas between several addresses.  With ``timeout`` None the
    dialer never gives up.  It calls back once, on the loop thread: ``on_link`` with the link, or
    ``on_failed`` with an AuthenticationError, VersionMismatch or LinkError.  If the connection
    breaks later, it dials again until the link is lost.  ``connect`` replaces the function that
    makes a connection.
    """

    def __init__(
        self,
        loop: Loop,
        address: str,
        credentials: Credentials,
        identity: Identity,
        *,
        on_link: Callable[[Link], None],
        on_failed: Callable[[FiberError | AuthenticationError], None],
        timeout: float | None = 30.0,
        connect: Callable[[str], socket.socket] | None = None,
    ) -> None:
        parse_addresses(address)
        self._loop = loop
        self._address = address
        self.credentials = credentials
        """Credentials of the agent, with the epoch of the last master that has proved itself."""
        self._context = authentication.agent_context()
        self._identity = identity
        self._on_link = on_link
        self._on_failed = on_failed
        self._timeout = timeout
        self._connect = connect or _connect
        self._name = secrets.token_hex(16)
        self._link: Link | None = None
        self._obstacle = "no attempt was made"
        self.lost_grace: float | None = None
        """Seconds to wait for another master if this one is lost, once there is a link."""
        self.local_host = ""
        """Address of this host on the way to the master; empty if there is none."""
        self._over = threading.Event()
        self._lock = threading.Lock()
        self._sock: socket.socket | None = None
        """Socket on which the dialling thread waits for the answer; under the lock."""
        self._deadline = None if timeout is None else loop.call_later(timeout, self._too_late)
        self._start()

    def close(self) -> None:
        """Stop dialling, or drop the link without closing it in order.  No callback follows."""
        self._loop.call_soon(self._stop)

    def _start(self, pause: float = 0.0) -> None:
        if self._over.is_set():
            return
        link = self._link
        welcomed, arrived = (link.has_received, link.arrived) if link else (False, 0)
        hello = AgentHello(self._identity, self._name, arrived, welcomed).encode()
        # The calls that resolve names and connect block, so they run on a thread.
        dial = threading.Thread(
            target=self._dial, args=(hello, pause), name="fiber-dial", daemon=True
        )
        try:
            dial.start()
        except RuntimeError as error:  # the system has no thread left; try again later
            self._obstacle = str(error)
            self._loop.call_later(_PAUSE_MAX, self._start)

    # On the thread that dials

    def _dial(self, hello: bytes, pause: float) -> None:
        began = time.monotonic()
        while not self._pause(began, pause):
            began = time.monotonic()
            try:
                exchanged = self._exchange_greetings(hello)
            except authentication.Untrusted as error:
                self._obstacle = str(error)
                if self._link is None:
                    self._loop.call_soon(self._distrust)
                    return
            except ProtocolError as error:
                self._loop.call_soon(self._no_master, error)
                return
            except (MasterUnreachable, authentication.PeerClosed) as error:
                # No master listens yet, or there is no route to it yet.
                self._obstacle = str(error)
            else:
                self._loop.call_soon(self._answered, *exchanged)
                return
            pause = min(max(2 * pause, _PAUSE_MIN), _PAUSE_MAX)

    def _pause(self, since: float, seconds: float) -> bool:
        """Wait until about ``seconds`` after ``since``; return True if dialling was stopped."""
        until = since + seconds * random.uniform(0.5, 1.0)
        return self._over.wait(max(until - time.monotonic(), 0.0))

    def _exchange_greetings(self, hello: bytes) -> tuple[bytes, ProvenMaster, int, Secrets]:
        """Connect and exchange greetings.

        Return the answer, the master, and the connection without TLS.
        """
        sock = self._connect(self._address)
        if sock.family in (socket.AF_INET, socket.AF_INET6):
            self.local_host = sock.getsockname()[0]
        tls_handshake = authentication.AgentHandshake(sock, self._context)
        try:
            with self._lock:
                self._sock = tls_handshake.sock
            deadline = time.monotonic() + _GREET
            answer, master = self._finish(
                tls_handshake, tls_handshake.ask(self.credentials, hello), deadline
            )
            return answer, master, *self._finish(tls_handshake, tls_handshake.end(), deadline)
        finally:
            with self._lock:
                self._sock = None
            tls_handshake.close()

    def _finish(
        self,
        tls_handshake: authentication.AgentHandshake,
        steps: authentication.Steps[authentication._T],
        deadline: float,
    ) -> authentication._T:
        """Take the steps, and wait before each until it is possible."""
        poller = select.poll()
        try:
            while not self._over.is_set():
                poller.register(tls_handshake.sock, next(steps))
                if not poller.poll(max(deadline - time.monotonic(), 0.0) * 1000):
                    raise MasterUnreachable("it took the connection and sent nothing")
        except StopIteration as finished:
            return finished.value  # type: ignore[no-any-return]  # typeshed cannot know
        raise MasterUnreachable("dialling was stopped")

    # On the loop thread

    def _answered(
        self, answer: bytes, master: ProvenMaster, descriptor: int, secrets: Secrets
    ) -> None:
        if self._over.is_set():
            os.close(descriptor)
            return
        try:
            self._check_epoch(master)
            welcome = self._check_answer(answer)
        except (FiberError, AuthenticationError) as error:
            os.close(descriptor)
            self._fail(error)
        else:
            self._welcomed(welcome, descriptor, secrets)

    def _check_epoch(self, master: ProvenMaster) -> None:
        """Note the master's epoch; EarlierMaster if the agent has met a later or an equal one."""
        met = self.credentials
        is_equal = master.epoch == met.epoch
        if master.epoch < met.epoch or (is_equal and met.met not in ("", master.certificate)):
            later = "another one of that epoch" if is_equal else f"one of epoch {met.epoch}"
            raise EarlierMaster(
                f"the master at {self._address} has epoch {master.epoch}, and this agent belongs "
                f"to {later}: another program has taken the pool. End the earlier program"
            )
        self.credentials = replace(met, epoch=master.epoch, met=master.certificate)

    def _check_answer(self, answer: bytes) -> MasterWelcome:
        """Return the welcome in the answer of the master; raise an error if it is a refusal."""
        try:
            greeting = authentication.decode_greeting(answer)
        except ProtocolError as error:
            raise self._stranger(error) from error
        mismatch = authentication.version_mismatch(self._identity, greeting.identity)
        if mismatch is not None:
            raise fresh(mismatch)
        if isinstance(greeting, MasterWelcome):
            return greeting
        reason = greeting.reason if isinstance(greeting, MasterRefusal) else "it is an agent itself"
        raise LinkError(f"the master at {self._address} refused this agent: {reason}")

    def _welcomed(self, welcome: MasterWelcome, descriptor: int, secrets: Secrets) -> None:
        link = self._link
        if link is None:
            # An agent answers soon.  User code in the master may hold the interpreter for long.
            lost_after = _LONGER * welcome.lost_after
            keepalive = Keepalive(welcome.heartbeat, welcome.suspect_after, lost_after)
            link = Link(self._loop, welcome.identity, keepalive, lambda _: self._stop(), dials=True)
        try:
            connection = SealedConnection(
                self._loop, descriptor, secrets, on_datagram=link.datagram, on_gone=self._gone
            )
        except FiberError as error:
            # No descriptors are free; try again later.
            self._obstacle = str(error)
            self._start(_PAUSE_MAX)
            return
        self.lost_grace = welcome.lost_grace
        link.connected(connection, welcome.arrived)
        if self._link is None:
            self._cancel_deadline()
            self._link = link
            self._on_link(link)

    def _gone(self, wire: LinkConnection) -> None:
        if self._link is not None:
            self._link.disconnected(wire)
        self._start(_PAUSE_MIN)

    def _too_late(self) -> None:
        self._fail(
            LinkError(
                f"no master answered at {self._address} within {self._timeout:g} s: "
                f"{self._obstacle}. Check that it runs and that this host can reach the address."
            )
        )

    def _no_master(self, error: ProtocolError) -> None:
        self._fail(self._stranger(error))

    def _stranger(self, error: ProtocolError) -> LinkError:
        return LinkError(f"the peer at {self._address} is no master: {error}")

    def _distrust(self) -> None:
        self._fail(
            AuthenticationError(
                f"this agent and the peer at {self._address} do not trust each other: "
                f"{self._obstacle}. The agent's credentials may come from another run's key or "
                "another pool's, or the peer is no master. Give the agent the credentials that "
                "this master made; in a pool, delete the pod."
            )
        )

    def _fail(self, error: FiberError | AuthenticationError) -> None:
        if self._over.is_set():
            return
        if self._link is not None:
            self._link.refused(str(error))
        else:
            self._stop()
            self._on_failed(error)

    def _stop(self) -> None:
        self._over.set()
        self._cancel_deadline()
        with self._lock, contextlib.suppress(OSError):
            if self._sock is not None:  # wakes the dialling thread
                socket.socket.shutdown(self._sock, socket.SHUT_RDWR)
        if self._link is not None:
            self._link.disconnect()

    def _cancel_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()


def _connect(address: str) -> socket.socket:
    """Return a connection; MasterUnreachable, soon, if none can be made now."""
    try:
        sock = connect(parse_addresses(address), _CONNECT)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    except TimeoutError as error:
        raise MasterUnreachable(f"no answer within {_CONNECT:g} s") from error
    except OSError as error:
        raise MasterUnreachable(str(error.strerror or error).lower()) from error
    except UnicodeError as error:
        raise MasterUnreachable(f"its name is malformed: {error}") from error
    return sock


_STAGGER = 0.25
"""Seconds between the beginnings of two attempts, as RFC 8305 recommends."""


class _Target(NamedTuple):
    family: socket.AddressFamily
    where: tuple[str | int, ...] | tuple[int, bytes]


def connect(addresses: Sequence[tuple[str, int]], patience: float) -> socket.socket:
    """Connect to the first of ``addresses`` that answers, each within ``patience`` seconds.

    TimeoutError if an address has not answered; otherwise the first OSError or UnicodeError.
    """
    failures: list[OSError | UnicodeError] = []
    targets = _resolve(addresses, failures)
    attempts: dict[int, socket.socket] = {}
    poller = select.poll()
    deadline = 0.0
    try:
        while targets or attempts:
            if targets:
                try:
                    sock = _begin(targets.pop(0))
                except OSError as error:
                    failures.append(error)
                    continue
                attempts[sock.fileno()] = sock
                poller.register(sock, select.POLLOUT)
                deadline = time.monotonic() + patience
            wait = _STAGGER if targets else deadline - time.monotonic()
            if wait <= 0:
                raise TimeoutError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
            for descriptor, _ in poller.poll(wait * 1000):
                poller.unregister(descriptor)
                code = attempts[descriptor].getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
                if not code:
                    return attempts.pop(descriptor)
                failures.append(OSError(code, os.strerror(code)))
                attempts.pop(descriptor).close()
        raise failures.pop(0)
    finally:
        for late in attempts.values():
            late.close()


def _resolve(
    addresses: Sequence[tuple[str, int]], failures: list[OSError | UnicodeError]
) -> list[_Target]:
    """Return all targets, IPv4 and IPv6 in turn, and add to ``failures`` for names without one."""
    found = []
    for host, port in addresses:
        try:
            answers = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            failures.append(error)
        else:
            found += [_Target(family, where) for family, _, _, _, where in answers]
    first = [target for target in found if target.family == found[0].family]
    others = [target for target in found if target.family != found[0].family]
    return [target for target in chain(*zip_longest(first, others)) if target is not None]


def _begin(target: _Target) -> socket.socket:
    """Begin to connect, without waiting for an answer."""
    sock = socket.socket(target.family, socket.SOCK_STREAM)
    try:
        sock.setblocking(False)
        code = sock.connect_ex(target.where)
        if code not in (0, errno.EINPROGRESS):
            raise OSError(code, os.strerror(code))
    except BaseException:
        sock.close()
        raise
    return sock
