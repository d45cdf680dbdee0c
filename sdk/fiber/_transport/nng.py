"""nng over TLS, both sides authenticated.  The only importer of pynng.

The master has one polyamorous Pair1 socket for all its agents, each of which is one pipe of it; an
agent has a socket of its own with which it dials the master.

What nng does behind one's back, and what follows from it:

* A pipe holds three messages that wait to be sent and drops the rest in silence.  So a session has
  two datagrams under way, and sending takes no longer than passing a message to the pipe.
* A connection that breaks while no receive waits for it may break unnoticed: only silence tells,
  and so an agent that hears nothing hangs up and dials anew.
* Pipes come and go on nng's threads; their callbacks only leave a note for the loop.
* A socket does not survive a fork: in the child it is made harmless, not closed.
* A connection that nng makes waits for as long as the kernel and the peer let it, and nng would
  make the next one itself: so it is kept from that, and who dials sets the limits.
"""

from __future__ import annotations

import atexit
import os
import weakref
from collections.abc import Callable
from multiprocessing import util
from typing import Any

import pynng

from fiber._transport.credentials import Credentials
from fiber._transport.link import Poller
from fiber._transport.session import BUDGET
from fiber._transport.session_link import SessionLink
from fiber.errors import AuthenticationError, ConfigError, LinkError, TooManyOpenFiles

_LARGEST = 4 * BUDGET
"""nng refuses longer messages unread; no session sends one."""

_TURN = 64
"""Messages taken in one turn of the loop, so that a flood leaves others their turn."""

_SEND_TIMEOUT = 1.0
_NEVER = 2**31 - 1
"""Milliseconds, and the most that nng can count."""


class Untrusted(Exception):
    """The TLS handshake failed."""


class Unreachable(Exception):
    """Nobody took the connection."""


class SocketClosed(Exception):
    """The socket was closed meanwhile."""


class Socket:
    """A Pair1 socket on the loop: tells of messages, and of pipes that came or went."""

    def __init__(
        self,
        loop: Poller,
        credentials: Credentials,
        *,
        dials: bool,
        on_message: Callable[[Pipe, bytes], None],
        on_gone: Callable[[Pipe], None],
        on_pipe: Callable[[Pipe], None] | None = None,
    ) -> None:
        self._loop = loop
        self._on_message = on_message
        self._on_gone = on_gone
        self._on_pipe = on_pipe
        self._kind = DialledPipe if dials else Pipe
        self._pipes: dict[int, Pipe] = {}
        self._closed = False
        self._nng = _opened(
            tls_config=_tls(credentials, dials=dials),
            polyamorous=True,
            recv_max_size=_LARGEST,
            recv_buffer_size=_TURN,
            send_buffer_size=_TURN,
            send_timeout=int(_SEND_TIMEOUT * 1000),
            reconnect_time_min=_NEVER,
            reconnect_time_max=_NEVER,
        )
        # The first of these runs before the pipe can bring anything.
        self._nng.add_pre_pipe_connect_cb(self._note)
        self._nng.add_post_pipe_connect_cb(lambda pipe: loop.call_soon(self._came, pipe.id))
        self._nng.add_post_pipe_remove_cb(lambda pipe: loop.call_soon(self._went, pipe.id))
        self._fd: int = self._nng.recv_fd
        _live.add(self)
        loop.register(self._fd, self._readable)

    def listen(self, address: str) -> str:
        """Take connections at ``host:port``; the address with the port that it really has."""
        url = url_of(address)
        try:
            listener = self._nng.listen(url)
        except pynng.AddressInUse as error:
            raise LinkError(
                f"cannot listen on {address}: another program uses that port. Stop it, or choose "
                "another port; port 0 takes a free one."
            ) from error
        except pynng.OutOfFiles as error:
            raise TooManyOpenFiles(f"listening on {address}") from error
        except pynng.NNGException as error:
            raise LinkError(
                f"cannot listen on {address}: {str(error).lower()}. Use an address of this host "
                "and a port that this user may bind."
            ) from error
        port = str(listener.local_address).rpartition(":")[2]
        return f"{address.rpartition(':')[0]}:{port}"

    def dial(self, url: str) -> None:
        """Connect, on a thread that may block, and let go of what was dialled before.

        Untrusted, Unreachable (may pass) or SocketClosed (was given up) say why not.
        """
        try:
            for former in self._nng.dialers:
                former.close()
            self._nng.dial(url, block=True)
        except pynng.CryptoError as error:
            raise Untrusted(str(error)) from error
        except (pynng.Closed, pynng.Canceled) as error:
            raise SocketClosed from error
        except pynng.NNGException as error:
            raise Unreachable(str(error).lower()) from error

    def close(self) -> None:
        """Close the socket and with it every pipe."""
        if not self._closed:
            self._closed = True
            self._loop.unregister(self._fd)
            self._nng.close()
            self._pipes.clear()

    def abandon_after_fork(self) -> None:
        """Let the parent keep what both share; nng aborts a child that touches it."""
        self._closed = True
        # pynng closes what this attribute holds, when told to and at garbage collection.
        vars(self._nng).pop("_socket", None)

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
                message = self._nng.recv_msg(block=False)
            except (pynng.TryAgain, pynng.Closed):
                return
            pipe = self._pipes.get(message.pipe.id) if message.pipe else None
            if pipe is not None:  # what a pipe that is gone still brings is sent again
                self._on_message(pipe, message.bytes)


class Pipe:
    """One connection; a ``Wire``.  ``link`` is what it belongs to once the greetings are over."""

    def __init__(self, pipe: Any) -> None:
        self._pipe = pipe
        self.link: SessionLink | None = None
        self.refused = False

    def put(self, datagram: bytes) -> None:
        """Send it or lose it."""
        try:
            self._pipe.send(datagram)
        except pynng.NNGException:
            # Lost, as it would be on the way; the session sends it again.
            pass

    def disconnected(self) -> None:
        """It is gone; tell the link."""
        if self.link is not None:
            self.link.disconnected(self)

    def doubt(self) -> None:
        """Nothing: only the agent dials."""

    def close(self) -> None:
        """Hang up."""
        try:
            self._pipe.close()
        except pynng.NNGException:
            # It is closed already.
            pass


class DialledPipe(Pipe):
    """The agent's side of a connection."""

    def doubt(self) -> None:
        """Hang up, whereupon the agent dials anew."""
        self.close()


def _opened(**options: Any) -> Any:
    try:
        return pynng.Pair1(**options)
    except pynng.OutOfFiles as error:
        raise TooManyOpenFiles("opening an nng socket") from error


def url_of(address: str) -> str:
    """The address as nng spells it."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ConfigError(f"{address!r} is no address: it must be host:port, as in 10.0.0.7:8642")
    return f"tls+tcp://{address}"


def _tls(credentials: Credentials, *, dials: bool) -> Any:
    config = pynng.TLSConfig
    try:
        return config(
            config.MODE_CLIENT if dials else config.MODE_SERVER,
            # The master's name.  A listener that is given one expects it of its agents.
            server_name=credentials.server_name if dials else None,
            ca_string=credentials.authority,
            own_key_string=credentials.key,
            own_cert_string=credentials.certificate,
            auth_mode=config.AUTH_MODE_REQUIRED,
        )
    except pynng.NNGException as error:
        raise AuthenticationError(
            f"the credentials for {credentials.server_name} cannot be used: "
            f"{str(error).lower()}. They are cut short or not PEM."
        ) from error


_live: weakref.WeakSet[Socket] = weakref.WeakSet()


def _after_fork_in_child() -> None:
    for socket in _live:
        socket.abandon_after_fork()


os.register_at_fork(after_in_child=_after_fork_in_child)

# pynng ends nng before multiprocessing's exit functions run, which still need our links; and in a
# forked child it would close the parent's sockets.  A Finalize runs after them, in this process
# only.
atexit.unregister(pynng.nng._pynng_atexit)
util.Finalize(None, pynng.nng._pynng_atexit, exitpriority=-200)
