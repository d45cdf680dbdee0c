"""Links between hosts: nng over TLS, both sides authenticated.  The only importer of pynng.

The master has one polyamorous Pair1 socket for all its agents, each of which is one pipe of it; an
agent has a socket of its own that dials the master, and dials again by itself when its pipe breaks.

What nng does behind one's back, and what follows from it:

* A pipe holds three messages that wait to be sent and drops the rest in silence: the session's window
  is two, and sending never blocks for longer than nng needs to pass a message to the pipe.
* Pipes come and go on nng's threads, whose callbacks only leave a note for the loop.
* A socket does not survive a fork: in the child it is made harmless, not closed.
"""

from __future__ import annotations

import atexit
import os
import secrets
import threading
import weakref
from collections.abc import Callable
from typing import Any

import pynng

from fiber._transport import handshake
from fiber._transport.credentials import Credentials
from fiber._transport.handshake import Hello, Identity, Refusal, Welcome
from fiber._transport.link import Link, LinkError, Patience, Poller
from fiber._transport.session import BUDGET
from fiber._transport.session_link import SessionLink
from fiber._wire.messages import ProtocolError
from fiber.errors import AuthenticationError, ConfigError, FiberError, TooManyOpenFiles

_LARGEST = 4 * BUDGET
"""nng refuses longer messages unread; no session sends one."""

_TURN = 64
"""Messages taken in one turn of the loop, so that a flood leaves others their turn."""

_REDIAL_MIN, _REDIAL_MAX = 0.1, 2.0
"""Seconds between attempts to dial, growing."""

_HANG_UP_AFTER = 1.0
"""Seconds for a refusal to arrive before its pipe is closed."""


class MasterListener:
    """The master's end of all its links: one socket that agents dial.

    ``address`` is ``host:port``; port 0 takes a free one, and ``address`` then says which.  The
    callbacks run on the loop's thread: ``on_agent`` must attach an observer to the new link,
    ``on_refused`` hears why someone who had the right credentials was turned away.
    """

    def __init__(
        self,
        loop: Poller,
        address: str,
        credentials: Credentials,
        *,
        on_agent: Callable[[Link], None],
        on_refused: Callable[[str], None],
        patience: Patience = Patience(),
    ) -> None:
        self._loop = loop
        self._on_agent = on_agent
        self._on_refused = on_refused
        self._patience = patience
        self._identity = Identity.of_this_process("the master")
        self._links: dict[str, SessionLink] = {}
        self._closing: list[Callable[[], None]] | None = None
        self._socket = _Socket(
            loop,
            _tls(pynng.TLSConfig.MODE_SERVER, credentials),
            on_message=self._message,
            on_gone=_disconnected,
        )
        try:
            self._listener, self.address = _listen(self._socket.nng, address)
        except BaseException:
            self._socket.close()
            raise
        self._socket.watch()

    def close(
        self,
        reason: str = "",
        *,
        linger: float = 1.0,
        then: Callable[[], None] | None = None,
    ) -> None:
        """Close every link as ``Link.close`` does, then the socket, then call ``then``."""
        self._loop.call_soon(self._close, reason, linger, then)

    def _close(self, reason: str, linger: float, then: Callable[[], None] | None) -> None:
        first = self._closing is None
        self._closing = [*(self._closing or ()), *([then] if then else ())]
        if first:
            self._listener.close()
            for link in list(self._links.values()):
                link.close(reason, linger=linger, then=self._finish_closing)
        self._finish_closing()

    def _finish_closing(self) -> None:
        if not self._links and self._closing is not None:
            self._socket.close()
            finished, self._closing = self._closing, []
            for then in finished:
                then()

    def _message(self, pipe: _Pipe, datagram: bytes) -> None:
        if pipe.link is not None:
            pipe.link.datagram(pipe, datagram)
        elif not pipe.refused:
            self._greet(pipe, datagram)

    def _greet(self, pipe: _Pipe, datagram: bytes) -> None:
        try:
            hello = handshake.decode(datagram)
        except ProtocolError as error:
            self._refuse(pipe, f"someone connected who is no agent of Fiber: {error}")
            return
        if not isinstance(hello, Hello):
            self._refuse(pipe, f"{hello.identity.name!r} connected and is no agent")
            return
        reason = self._objection(hello)
        if reason:
            self._refuse(pipe, reason)
        else:
            self._welcome(pipe, hello)

    def _objection(self, hello: Hello) -> str:
        error = handshake.mismatch(self._identity, hello.identity)
        if error is not None:
            return str(error)
        if self._closing is not None:
            return "this master is ending"
        if hello.welcomed and hello.session not in self._links:
            return (
                f"the session of {hello.identity.name!r} is not known here: this master began after "
                "it, or had given that agent up as lost"
            )
        return ""

    def _refuse(self, pipe: _Pipe, reason: str) -> None:
        pipe.refused = True
        pipe.put(Refusal(self._identity, reason).encode())
        self._loop.call_later(_HANG_UP_AFTER, pipe.close)
        self._on_refused(reason)

    def _welcome(self, pipe: _Pipe, hello: Hello) -> None:
        link = self._links.get(hello.session)
        new = link is None
        if link is None:
            link = SessionLink(
                self._loop,
                hello.identity,
                self._patience,
                on_end=lambda _: self._forget(hello.session),
            )
            self._links[hello.session] = link
        pipe.link = link
        pipe.put(Welcome(self._identity, link.arrived, self._patience.heartbeat).encode())
        link.connected(pipe, hello.arrived)
        if new:
            self._on_agent(link)

    def _forget(self, session: str) -> None:
        self._links.pop(session, None)


class AgentDialer:
    """An agent's end: dials the master at ``host:port`` until it answers or ``timeout`` is over.

    Calls back once, on the loop's thread: ``on_link`` with the link, or ``on_failed`` with an
    AuthenticationError, VersionMismatch or LinkError.  A link that breaks later is dialled again
    until it is lost.  The default patience is longer than the master's: an agent answers at all
    times, while user code in the master may hold the interpreter for long.
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
        timeout: float = 30.0,
        patience: Patience = Patience(lost_after=30.0),
    ) -> None:
        self._loop = loop
        self._address = address
        self._credentials = credentials
        self._identity = identity
        self._on_link = on_link
        self._on_failed = on_failed
        self._timeout = timeout
        self._patience = patience
        self._session = secrets.token_hex(16)
        self._link: SessionLink | None = None
        self._obstacle = "nothing was tried"
        self._over = threading.Event()
        url = _url(address)
        self._socket = _Socket(
            loop,
            _tls(pynng.TLSConfig.MODE_CLIENT, credentials),
            on_message=self._message,
            on_gone=_disconnected,
            on_pipe=self._introduce,
            redials=True,
        )
        self._socket.watch()
        self._deadline = loop.call_later(timeout, self._too_late)
        # A dial that does not block never reports a failure, so the first one gets a thread.
        threading.Thread(target=self._dial, args=(url,), name="fiber-dial", daemon=True).start()

    def close(self) -> None:
        """Give up dialling, or drop the link without a farewell.  Calls nobody back."""
        self._loop.call_soon(self._stop)

    def _dial(self, url: str) -> None:
        pause = _REDIAL_MIN
        while not self._over.is_set():
            try:
                self._socket.nng.dial(url, block=True)
                self._obstacle = "it took the connection and said nothing"
                return
            except pynng.CryptoError:
                self._loop.call_soon(self._fail, self._distrust())
                return
            except (pynng.Closed, pynng.Canceled):
                # The socket was closed: over.
                return
            except pynng.NNGException as error:
                # Nobody there yet, or no way yet.
                self._obstacle = str(error).lower()
            self._over.wait(pause)
            pause = min(2 * pause, _REDIAL_MAX)

    def _introduce(self, pipe: _Pipe) -> None:
        link = self._link
        arrived = link.arrived if link else 0
        pipe.put(Hello(self._identity, self._session, arrived, welcomed=link is not None).encode())

    def _message(self, pipe: _Pipe, datagram: bytes) -> None:
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

    def _welcomed(self, pipe: _Pipe, welcome: Welcome) -> None:
        link = self._link
        if link is None:
            patience = self._patience._replace(heartbeat=welcome.heartbeat)
            link = SessionLink(
                self._loop, welcome.identity, patience, on_end=lambda _: self._stop()
            )
        pipe.link = link
        link.connected(pipe, welcome.arrived)
        if self._link is None:
            self._deadline.cancel()
            self._link = link
            self._on_link(link)

    def _too_late(self) -> None:
        self._fail(
            LinkError(
                f"no master answered at {self._address} within {self._timeout:g} s: "
                f"{self._obstacle}. See that it runs and that this host can reach that address."
            )
        )

    def _distrust(self) -> AuthenticationError:
        expires = self._credentials.expires()
        return AuthenticationError(
            f"this agent and what answers at {self._address} do not trust each other: the TLS "
            f"handshake failed. The credentials are those of another run, or expired (this agent's "
            f"are for {self._credentials.server_name} until {expires:%Y-%m-%d %H:%M} UTC), or it "
            "is no master. Give the agent the credentials that this master made."
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
        self._deadline.cancel()
        self._socket.close()


class _Socket:
    """A Pair1 socket on the loop: tells ``owner`` of messages and of pipes that came or went."""

    def __init__(
        self,
        loop: Poller,
        tls: Any,
        *,
        on_message: Callable[[_Pipe, bytes], None],
        on_gone: Callable[[_Pipe], None],
        on_pipe: Callable[[_Pipe], None] | None = None,
        redials: bool = False,
    ) -> None:
        self._loop = loop
        self._on_message = on_message
        self._on_gone = on_gone
        self._on_pipe = on_pipe
        self._kind = _DialledPipe if redials else _Pipe
        self._pipes: dict[int, _Pipe] = {}
        self._closed = False
        self.nng = _opened(
            tls_config=tls,
            polyamorous=True,
            recv_max_size=_LARGEST,
            recv_buffer_size=_TURN,
            send_buffer_size=_TURN,
            send_timeout=1000,
            reconnect_time_min=int(_REDIAL_MIN * 1000),
            reconnect_time_max=int(_REDIAL_MAX * 1000),
        )
        # The first of these runs before the pipe can bring anything.
        self.nng.add_pre_pipe_connect_cb(self._note)
        self.nng.add_post_pipe_connect_cb(lambda pipe: loop.call_soon(self._came, pipe.id))
        self.nng.add_post_pipe_remove_cb(lambda pipe: loop.call_soon(self._went, pipe.id))
        self._fd: int = self.nng.recv_fd
        _live.add(self)

    def watch(self) -> None:
        """Begin to take messages."""
        self._loop.register(self._fd, self._readable)

    def close(self) -> None:
        """Close the socket and with it every pipe."""
        if not self._closed:
            self._closed = True
            self._loop.unregister(self._fd)
            self.nng.close()
            self._pipes.clear()

    def abandon_after_fork(self) -> None:
        """Let the parent keep what both share; nng aborts a child that touches it."""
        self._closed = True
        vars(self.nng).pop(
            "_socket", None
        )  # pynng's close(), also at garbage collection, asks for it

    def _note(self, pipe: Any) -> None:
        self._pipes[pipe.id] = self._kind(pipe)

    def _came(self, number: int) -> None:
        pipe = self._pipes.get(number)
        if pipe is not None and self._on_pipe is not None:
            self._on_pipe(pipe)

    def _went(self, number: int) -> None:
        # What it brought before it broke comes first.
        self._readable()
        pipe = self._pipes.pop(number, None)
        if pipe is not None:
            self._on_gone(pipe)

    def _readable(self) -> None:
        for _ in range(_TURN):
            if self._closed:
                return
            try:
                message = self.nng.recv_msg(block=False)
            except (pynng.TryAgain, pynng.Closed):
                return
            pipe = self._pipes.get(message.pipe.id) if message.pipe else None
            if pipe is not None:  # what a pipe that is gone still brings is sent again
                self._on_message(pipe, message.bytes)


class _Pipe:
    """One connection; a ``Wire``.  ``link`` is what it belongs to once the greetings are over."""

    def __init__(self, pipe: Any) -> None:
        self._pipe = pipe
        self.link: SessionLink | None = None
        self.refused = False

    def put(self, datagram: bytes) -> None:
        """Send it or lose it."""
        try:
            self._pipe.send(datagram)
        except (pynng.Closed, pynng.Timeout, pynng.ConnectionReset):
            # Lost, as it would be on the way; the session sends it again.
            pass

    def doubt(self) -> None:
        """Nothing: only the agent dials."""

    def close(self) -> None:
        """Hang up."""
        try:
            self._pipe.close()
        except pynng.Closed:
            # The peer was faster.
            pass


class _DialledPipe(_Pipe):
    """The agent's side of a connection."""

    def doubt(self) -> None:
        """Hang up: nng dials anew, past whatever on the way has forgotten the connection."""
        self.close()


def _disconnected(pipe: _Pipe) -> None:
    if pipe.link is not None:
        pipe.link.disconnected(pipe)


def _opened(**options: Any) -> Any:
    try:
        return pynng.Pair1(**options)
    except pynng.OutOfFiles as error:
        raise TooManyOpenFiles("opening an nng socket") from error


def _listen(socket: Any, address: str) -> tuple[Any, str]:
    """Bind; the listener and the address with the port that it really has."""
    url = _url(address)
    try:
        listener = socket.listen(url)
    except pynng.AddressInUse as error:
        raise LinkError(
            f"cannot listen on {address}: another program uses that port. Stop it, or choose "
            "another port; port 0 takes a free one."
        ) from error
    except pynng.OutOfFiles as error:
        raise TooManyOpenFiles(f"listening on {address}") from error
    except pynng.NNGException as error:
        raise LinkError(
            f"cannot listen on {address}: {str(error).lower()}. Use an address of this host and a "
            "port that this user may bind."
        ) from error
    host = address.rpartition(":")[0]
    port = str(listener.local_address).rpartition(":")[2]
    return listener, f"{host}:{port}"


def _url(address: str) -> str:
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f"{address!r} is no address: it must be host:port, as in 10.0.0.7:8642")
    return f"tls+tcp://{address}"


def _tls(mode: int, credentials: Credentials) -> Any:
    try:
        return pynng.TLSConfig(
            mode,
            server_name=credentials.server_name,
            ca_string=credentials.authority,
            own_key_string=credentials.key,
            own_cert_string=credentials.certificate,
            auth_mode=pynng.TLSConfig.AUTH_MODE_REQUIRED,
        )
    except pynng.NNGException as error:
        raise AuthenticationError(
            f"the credentials for {credentials.server_name} cannot be used: "
            f"{str(error).lower()}. They are cut short or not PEM."
        ) from error


_live: weakref.WeakSet[_Socket] = weakref.WeakSet()


def _after_fork_in_child() -> None:
    for socket in _live:
        socket.abandon_after_fork()
    atexit.unregister(pynng.nng._pynng_atexit)  # it would close the parent's sockets at our exit


os.register_at_fork(after_in_child=_after_fork_in_child)
