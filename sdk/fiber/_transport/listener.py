"""The master's end of its agents' links."""

from __future__ import annotations

from collections.abc import Callable

from fiber._transport import handshake
from fiber._transport.credentials import Credentials
from fiber._transport.handshake import Hello, Identity, Refusal, Welcome
from fiber._transport.link import DEFAULT_PATIENCE, Link, Patience, Poller
from fiber._transport.nng import Pipe, Socket
from fiber._transport.session_link import SessionLink
from fiber._wire.messages import ProtocolError

_HANG_UP_AFTER = 1.0
"""Seconds for a refusal to arrive before its pipe is closed."""


class MasterListener:
    """The master's end of all its links: one socket that agents dial.

    ``address`` is ``host:port``; port 0 takes a free one, and ``address`` then says which.  The
    callbacks run on the loop's thread: ``on_agent`` must attach an observer to the new link,
    ``on_refused`` hears why someone who had the right credentials was turned away.  ``lost_grace``
    is told to the agents: for so many seconds they wait for another master if this one is lost.
    """

    def __init__(
        self,
        loop: Poller,
        address: str,
        credentials: Credentials,
        *,
        on_agent: Callable[[Link], None],
        on_refused: Callable[[str], None],
        patience: Patience = DEFAULT_PATIENCE,
        lost_grace: float | None = None,
    ) -> None:
        self._loop = loop
        self._on_agent = on_agent
        self._on_refused = on_refused
        self._patience = patience
        self._lost_grace = lost_grace
        self._identity = Identity.of_this_process("the master")
        self._links: dict[str, SessionLink] = {}
        self._closing: list[Callable[[], None]] | None = None
        self._socket = Socket(
            loop,
            credentials,
            dials=False,
            on_message=self._message,
            on_gone=Pipe.disconnected,
        )
        try:
            self.address = self._socket.listen(address)
        except BaseException:
            self._socket.close()
            raise

    def close(
        self,
        reason: str = "",
        *,
        linger: float = 1.0,
        then: Callable[[], None] | None = None,
    ) -> None:
        """Close every link as ``Link.close`` does, then the socket, then call ``then``.

        Who dials meanwhile is refused: nng cannot stop listening without breaking its pipes.
        """
        self._loop.call_soon(self._close, reason, linger, then)

    def _close(self, reason: str, linger: float, then: Callable[[], None] | None) -> None:
        first = self._closing is None
        self._closing = [*(self._closing or ()), *([then] if then else ())]
        if first:
            for link in list(self._links.values()):
                link.close(reason, linger=linger, then=self._finish_closing)
        self._finish_closing()

    def _finish_closing(self) -> None:
        if not self._links and self._closing is not None:
            self._socket.close()
            finished, self._closing = self._closing, []
            for then in finished:
                then()

    def _message(self, pipe: Pipe, datagram: bytes) -> None:
        if pipe.link is not None:
            pipe.link.datagram(pipe, datagram)
        elif not pipe.refused:
            self._greet(pipe, datagram)

    def _greet(self, pipe: Pipe, datagram: bytes) -> None:
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
                f"the session of {hello.identity.name!r} is not known here: this master began "
                "after it, or had given that agent up as lost"
            )
        return ""

    def _refuse(self, pipe: Pipe, reason: str) -> None:
        pipe.refused = True
        pipe.put(Refusal(self._identity, reason).encode())
        self._loop.call_later(_HANG_UP_AFTER, pipe.close)
        self._on_refused(reason)

    def _welcome(self, pipe: Pipe, hello: Hello) -> None:
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
        welcome = Welcome(self._identity, link.arrived, *self._patience, self._lost_grace)
        pipe.put(welcome.encode())
        link.connected(pipe, hello.arrived)
        if new:
            self._on_agent(link)

    def _forget(self, session: str) -> None:
        self._links.pop(session, None)
        self._finish_closing()
