"""The master's end of its agents' links."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable

from fiber._transport import handshake, tls
from fiber._transport.acceptor import Acceptor, PendingConnection
from fiber._transport.credentials import Credentials
from fiber._transport.handshake import Hello, Identity, Refusal, Welcome
from fiber._transport.link import DEFAULT_KEEPALIVE, Keepalive, Link, SelectorEventLoop
from fiber._transport.nng import Connection
from fiber._transport.resumable_link import ResumableLink
from fiber._transport.sealing import Secrets
from fiber._wire.messages import ProtocolError
from fiber.errors import FiberError


class MasterListener:
    """The master's end of all its links: one address that agents dial.

    ``address`` is ``host:port``; port 0 takes a free one, and ``address`` then says which.  The
    callbacks run on the loop's thread: ``on_agent`` attaches an observer to the new link, or
    returns why it does not want it; ``on_refused`` hears who was turned away and why;
    ``on_proven`` hears of each connection that proved by certificate that it is the pool's.
    ``lost_grace`` is told to the agents: for so many seconds they wait for another master if this
    one is lost.
    """

    def __init__(
        self,
        loop: SelectorEventLoop,
        address: str,
        credentials: Credentials,
        *,
        on_agent: Callable[[Link], str | None],
        on_refused: Callable[[str], None],
        on_proven: Callable[[], None] = lambda: None,
        keepalive: Keepalive = DEFAULT_KEEPALIVE,
        lost_grace: float | None = None,
    ) -> None:
        self._loop = loop
        self._on_agent = on_agent
        self._on_proven = on_proven
        self._keepalive = keepalive
        self._lost_grace = lost_grace
        self._identity = Identity.of_this_process("the master")
        self._links: dict[str, ResumableLink] = {}
        self._closing: list[Callable[[], None]] | None = None
        self._acceptor = Acceptor(
            address,
            tls.context_of(credentials, listens=True),
            on_hello=lambda pending, words: loop.call_soon(self._greet, pending, words),
            on_refused=lambda reason: loop.call_soon(on_refused, reason),
        )
        self.address = self._acceptor.address

    def take(self, sock: socket.socket, origin: str) -> None:
        """Serve a connection to an agent that came by another way than ``address``."""
        self._acceptor.take(sock, origin)

    def close(
        self,
        reason: str = "",
        *,
        linger: float = 1.0,
        then: Callable[[], None] | None = None,
    ) -> None:
        """Close every link as ``Link.close`` does, then the listening socket, then call ``then``.

        Who comes meanwhile is refused.
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
            self._acceptor.close()
            finished, self._closing = self._closing, []
            for then in finished:
                then()

    def _greet(self, pending: PendingConnection, words: bytes) -> None:
        """Somebody with the right credentials has said its first words."""
        self._on_proven()
        try:
            hello = handshake.decode(words)
        except ProtocolError as error:
            self._refuse(pending, f"someone connected who is no agent of Fiber: {error}")
            return
        if not isinstance(hello, Hello):
            self._refuse(pending, f"{hello.identity.name!r} connected and is no agent")
            return
        reason = self._objection(hello)
        if reason:
            self._refuse(pending, reason)
        else:
            self._welcome(pending, hello)

    def _objection(self, hello: Hello) -> str:
        error = handshake.mismatch(self._identity, hello.identity)
        if error is not None:
            return str(error)
        if self._closing is not None:
            return "this master is ending"
        if hello.welcomed and hello.link not in self._links:
            return (
                f"the link of {hello.identity.name!r} is not known here: this master began "
                "after it, or had given that agent up as lost"
            )
        return ""

    def _refuse(self, pending: PendingConnection, reason: str) -> None:
        pending.turn_away(Refusal(self._identity, reason).encode(), reason)

    def _welcome(self, pending: PendingConnection, hello: Hello) -> None:
        link = self._links.get(hello.link)
        if link is not None:
            # What its last connection might still bring is not to arrive: the agent is told now how
            # much has.
            link.disconnect()
        arrived = link.arrived if link else 0
        welcome = Welcome(self._identity, arrived, *self._keepalive, self._lost_grace)
        pending.welcome(
            welcome.encode(),
            lambda descriptor, secrets: self._loop.call_soon(
                self._connect, pending, hello, arrived, descriptor, secrets
            ),
        )

    def _connect(
        self,
        pending: PendingConnection,
        hello: Hello,
        arrived: int,
        descriptor: int,
        secrets: Secrets,
    ) -> None:
        """Go on without TLS."""
        link = self._links.get(hello.link)
        if self._closing is not None or (link.arrived if link else 0) != arrived:
            os.close(descriptor)  # this master ends, or the agent has come by another connection
            return
        new = link is None
        if link is None:
            link = ResumableLink(
                self._loop, hello.identity, self._keepalive, lambda _: self._forget(hello.link)
            )
        try:
            connection = Connection(
                self._loop,
                descriptor,
                secrets,
                on_datagram=link.datagram,
                on_gone=link.disconnected,
            )
        except FiberError as error:
            pending.report_proven(f"{hello.identity.name!r} cannot be served: {error}")
            return
        self._links[hello.link] = link
        link.connected(connection, hello.arrived)
        if new and (unwanted := self._on_agent(link)):
            link.close(unwanted)
            pending.report_proven(unwanted)

    def _forget(self, link: str) -> None:
        self._links.pop(link, None)
        self._finish_closing()
