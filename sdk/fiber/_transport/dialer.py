"""An agent's end of its link to the master."""

from __future__ import annotations

import random
import secrets
import socket
import threading
import time
from collections.abc import Callable

from fiber._transport import handshake
from fiber._transport.credentials import Credentials
from fiber._transport.handshake import Hello, Identity, Refusal, Welcome
from fiber._transport.link import Link, Patience, Poller, Timer
from fiber._transport.nng import Pipe, Socket, SocketClosed, Unreachable, Untrusted, url_of
from fiber._transport.session_link import SessionLink
from fiber._wire.messages import ProtocolError
from fiber.errors import AuthenticationError, FiberError, LinkError

_PAUSE_MIN, _PAUSE_MAX = 0.1, 0.3
"""Seconds from one attempt to dial to the next, growing: a thousand agents that wait for a master
must neither flood its network nor keep it waiting."""

_CONNECT = 1.0
"""Seconds for a connection to be taken.  The kernel would then ask again (RFC 6298), more and more
seldom, and always where a Service led when it asked first: to a pod that is gone, say."""

_GREET = 15.0
"""Seconds from there to the welcome.  A thousand agents may dial one master at the same time, each
of which costs it milliseconds; but its host may vanish in the middle and say no more."""

_LONGER = 2
"""How much more patient an agent is than its master."""


class AgentDialer:
    """An agent's end: dials the master at ``host:port`` until it answers or ``timeout`` is over
    (None: for as long as it takes).

    Calls back once, on the loop's thread: ``on_link`` with the link, or ``on_failed`` with an
    AuthenticationError, VersionMismatch or LinkError.  A link that breaks later is dialled again
    until it is lost.
    """

    def __init__(
        self,
        loop: Poller,
        address: str,
        credentials: Credentials,
        identity: Identity,
        *,
        on_link: Callable[[Link], None],
        on_failed: Callable[[FiberError | AuthenticationError], None],
        timeout: float | None = 30.0,
    ) -> None:
        self._loop = loop
        self._address = address
        self._credentials = credentials
        self._identity = identity
        self._on_link = on_link
        self._on_failed = on_failed
        self._timeout = timeout
        self._session = secrets.token_hex(16)
        self._link: SessionLink | None = None
        self._obstacle = "nothing was tried"
        self.lost_grace: float | None = None
        """What the master says of its loss, once there is a link."""
        self._over = threading.Event()
        self._url = url_of(address)
        self._socket = self._open()
        self._deadline = None if timeout is None else loop.call_later(timeout, self._too_late)
        self._greeting: Timer | None = None
        self._start()

    def close(self) -> None:
        """Give up dialling, or drop the link without a farewell.  Calls nobody back."""
        self._loop.call_soon(self._stop)

    def _open(self) -> Socket:
        return Socket(
            self._loop,
            self._credentials,
            dials=True,
            on_message=self._message,
            on_gone=self._gone,
            on_pipe=self._introduce,
        )

    def _start(self, *, pause: float = 0.0) -> None:
        # A dial that does not block never reports a failure, so it gets a thread.
        dial = threading.Thread(
            target=self._dial, args=(self._socket, pause), name="fiber-dial", daemon=True
        )
        dial.start()

    def _dial(self, ours: Socket, pause: float) -> None:
        began = time.monotonic()
        while not self._pause(began, pause) and ours is self._socket:
            began = time.monotonic()
            try:
                _reach(self._address)
                self._loop.call_soon(self._await_welcome)
                ours.dial(self._url)
                self._obstacle = "it took the connection and said nothing"
                return
            except Untrusted as error:
                self._obstacle = str(error)
                if self._link is None:
                    self._loop.call_soon(self._distrust)
                    return
            except SocketClosed:
                return
            except Unreachable as error:
                # Nobody there yet, or no way there yet.
                self._obstacle = str(error)
            pause = min(max(2 * pause, _PAUSE_MIN), _PAUSE_MAX)

    def _pause(self, since: float, seconds: float) -> bool:
        """Let so much time pass since then, more or less; whether all is over meanwhile."""
        until = since + seconds * random.uniform(0.5, 1.0)
        return self._over.wait(max(until - time.monotonic(), 0.0))

    def _await_welcome(self) -> None:
        self._cancel_greeting()
        self._greeting = self._loop.call_later(_GREET, self._hang_up)

    def _hang_up(self) -> None:
        """Drop a connection that came to nothing, in whatever state, and dial anew."""
        if self._over.is_set():
            return
        self._socket.close()
        try:
            self._socket = self._open()
        except FiberError as error:
            self._fail(error)
        else:
            self._start()

    def _gone(self, pipe: Pipe) -> None:
        pipe.disconnected()
        if not self._over.is_set():
            self._start(pause=_PAUSE_MIN)

    def _introduce(self, pipe: Pipe) -> None:
        link = self._link
        arrived = link.arrived if link else 0
        pipe.put(Hello(self._identity, self._session, arrived, welcomed=link is not None).encode())

    def _message(self, pipe: Pipe, datagram: bytes) -> None:
        if pipe.link is not None:
            pipe.link.datagram(pipe, datagram)
            return
        try:
            greeting = handshake.decode(datagram)
        except ProtocolError as error:
            self._fail(LinkError(f"what answers at {self._address} is no master: {error}"))
            return
        mismatch = handshake.mismatch(self._identity, greeting.identity)
        if mismatch is not None:
            self._fail(mismatch)
        elif isinstance(greeting, Welcome):
            self._welcomed(pipe, greeting)
        else:
            reason = greeting.reason if isinstance(greeting, Refusal) else "it is an agent itself"
            self._fail(LinkError(f"the master at {self._address} refused this agent: {reason}"))

    def _welcomed(self, pipe: Pipe, welcome: Welcome) -> None:
        link = self._link
        if link is None:
            # An agent answers at all times; user code in the master may hold the interpreter long.
            lost_after = _LONGER * welcome.lost_after
            patience = Patience(welcome.heartbeat, welcome.suspect_after, lost_after)
            link = SessionLink(
                self._loop, welcome.identity, patience, on_end=lambda _: self._stop()
            )
        self._cancel_greeting()
        self.lost_grace = welcome.lost_grace
        pipe.link = link
        link.connected(pipe, welcome.arrived)
        if self._link is None:
            self._cancel_deadline()
            self._link = link
            self._on_link(link)

    def _too_late(self) -> None:
        self._fail(
            LinkError(
                f"no master answered at {self._address} within {self._timeout:g} s: "
                f"{self._obstacle}. See that it runs and that this host can reach that address."
            )
        )

    def _distrust(self) -> None:
        self._fail(
            AuthenticationError(
                f"this agent and what answers at {self._address} do not trust each other: the TLS "
                "handshake failed. The credentials are those of another run, or expired (this "
                f"agent's are for {self._credentials.server_name} until "
                f"{self._credentials.expires():%Y-%m-%d %H:%M} UTC), or it is no master. Give the "
                "agent the credentials that this master made."
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
        self._cancel_greeting()
        self._socket.close()

    def _cancel_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()

    def _cancel_greeting(self) -> None:
        if self._greeting is not None:
            self._greeting.cancel()


def _reach(address: str) -> None:
    """Raise Unreachable, soon, if no connection can be made at this moment: nng sets no limit."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), _CONNECT).close()
    except TimeoutError as error:
        raise Unreachable(f"no answer within {_CONNECT:g} s") from error
    except OSError as error:
        raise Unreachable(str(error.strerror or error).lower()) from error
