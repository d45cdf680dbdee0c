"""Master's end of the links to a pool's agents."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable

from fiber._transport import authentication
from fiber._transport.acceptor import MASTER, Acceptor, PendingConnection, ServedPool
from fiber._transport.authentication import (
    AgentHello,
    Identity,
    MasterRefusal,
    MasterWelcome,
    Secrets,
)
from fiber._transport.credentials import MasterCredentials
from fiber._transport.link import DEFAULT_KEEPALIVE, Keepalive, Link
from fiber._transport.loop import Loop
from fiber._transport.nng import SealedConnection
from fiber.errors import FiberError


class MasterListener:
    """Master's end of the links to a pool's agents.

    ``at`` is the acceptor that the agents dial, which other pools may share.  Or it is an address
    for a new acceptor, which is closed with the pool.  An address is ``host:port``.  The
    callbacks run on the loop thread:

    * ``on_agent`` attaches an observer to the new link, or returns why the link is not wanted.
    * ``on_refused`` gets the text to log for a connection that was turned away.
    * ``on_proven`` is called for each connection that proved to be an agent of the pool.
    * ``on_unserved`` gets the name of an agent for which this master lacks memory or descriptors,
      and why.
    * ``objection`` returns why an agent with this name and uid is refused, or "".  None means that
      this is not known yet: the agent then waits some seconds for a call of ``look_again``.

    ``lost_grace`` is sent to the agents: the seconds that they wait for another master if this one
    is lost.
    """

    def __init__(
        self,
        loop: Loop,
        at: Acceptor | str,
        credentials: MasterCredentials,
        *,
        on_agent: Callable[[Link], str | None],
        on_refused: Callable[[str], None],
        on_proven: Callable[[], None] = lambda: None,
        on_unserved: Callable[[str, str], None] = lambda name, reason: None,
        objection: Callable[[Identity], str | None] = lambda identity: "",
        keepalive: Keepalive = DEFAULT_KEEPALIVE,
        lost_grace: float | None = None,
    ) -> None:
        self._loop = loop
        self._on_agent = on_agent
        self._on_proven = on_proven
        self._on_unserved = on_unserved
        self._knows = objection
        self._credentials = credentials
        self._waiting: dict[tuple[str, str], tuple[PendingConnection, AgentHello]] = {}
        self._by_peer: dict[tuple[str, str], Link] = {}
        self._keepalive = keepalive
        self._lost_grace = lost_grace
        self._identity = Identity.of_this_process(MASTER)
        self._links: dict[str, Link] = {}
        self._closing: list[Callable[[], None]] | None = None
        self._shares = isinstance(at, Acceptor)
        self._acceptor = at if isinstance(at, Acceptor) else Acceptor(at, credentials.certificate)
        self.address = self._acceptor.address
        self._served = ServedPool(
            credentials,
            on_agent=lambda pending, hello: loop.call_soon(self._proven, pending, hello),
            on_refused=lambda reason: loop.call_soon(on_refused, reason),
        )
        self._acceptor.add(self._served)

    def be_patient(self, lost_after: float) -> None:
        """Count new agents as lost after so many seconds of silence, at least.  The loop thread."""
        longer = max(lost_after, self._keepalive.lost_after)
        self._keepalive = self._keepalive._replace(lost_after=longer)

    def take(self, sock: socket.socket, origin: str) -> None:
        """Serve a connection to an agent that did not come through ``address``."""
        self._acceptor.take(sock, origin)

    def close(
        self,
        reason: str = "",
        *,
        linger: float = 1.0,
        then: Callable[[], None] | None = None,
    ) -> None:
        """Close every link as ``Link.close`` does, then call ``then``.

        Agents that dial meanwhile, or later at a shared acceptor, are refused.
        """
        self._loop.call_soon(self._close, reason, linger, then)

    def _close(self, reason: str, linger: float, then: Callable[[], None] | None) -> None:
        first = self._closing is None
        self._closing = [*(self._closing or ()), *([then] if then else ())]
        if first:
            for pending, _ in self._waiting.values():
                pending.drop()
            self._waiting.clear()
            for link in list(self._links.values()):
                link.close(reason, linger=linger, then=self._finish_closing)
        self._finish_closing()

    def _finish_closing(self) -> None:
        if not self._links and self._closing is not None:
            self._leave()
            finished, self._closing = self._closing, []
            for then in finished:
                then()

    def _leave(self) -> None:
        self._acceptor.remove(self._served)
        if not self._shares:
            self._acceptor.close()

    def break_connections(self) -> None:
        """Break all connections, so that each agent dials again.  Runs on the loop thread.

        An agent that reaches this master again continues its link, and loses nothing.
        """
        for link in self._links.values():
            link.disconnect()

    def look_again(self) -> None:
        """Decide again about the agents that wait.  Runs on the loop thread."""
        waiting, self._waiting = self._waiting, {}
        for pending, hello in waiting.values():
            if not pending.gone:
                self._greet(pending, hello)

    def _proven(self, pending: PendingConnection, hello: AgentHello) -> None:
        self._on_proven()
        self._greet(pending, hello)

    def _greet(self, pending: PendingConnection, hello: AgentHello) -> None:
        """Answer an agent that has proved its name and uid."""
        if not self._credentials.complete:
            what = "the operator's signature for this program"
            self._let_wait(pending, hello, what)
            return
        reason = self._objection(hello)
        if reason is None:
            self._let_wait(pending, hello, f"the pod {hello.identity.name!r}")
        elif reason:
            self._refuse(pending, reason)
        else:
            self._welcome(pending, hello)

    def _let_wait(self, pending: PendingConnection, hello: AgentHello, why: str) -> None:
        peer = _peer(hello.identity)
        if before := self._waiting.pop(peer, None):
            before[0].drop()  # the same agent has dialled again
        pending.waits_for(why)
        self._waiting[peer] = pending, hello

    def _objection(self, hello: AgentHello) -> str | None:
        error = authentication.version_mismatch(self._identity, hello.identity)
        if error is not None:
            return str(error)
        if self._closing is not None:
            return "this master is ending"
        if hello.welcomed and hello.link not in self._links:
            return (
                f"the link of {hello.identity.name!r} is not known here: this master began "
                "after it, or has given that agent up as lost"
            )
        if (link := self._links.get(hello.link)) is not None:
            if _peer(link.peer) == _peer(hello.identity):
                return ""
            return f"{hello.identity.name!r} wants to go on with the link of {link.peer.name!r}"
        if (link := self._by_peer.get(_peer(hello.identity))) is not None and link.is_connected:
            return (
                f"{hello.identity.name!r} has a link already, and a pod has only one. End the "
                "process that is not its agent"
            )
        return self._knows(hello.identity)

    def _refuse(self, pending: PendingConnection, reason: str) -> None:
        pending.turn_away(MasterRefusal(self._identity, reason).encode(), reason)

    def _welcome(self, pending: PendingConnection, hello: AgentHello) -> None:
        link = self._links.get(hello.link)
        if link is not None:
            # The welcome says how much has arrived, so the old connection must bring no more.
            link.disconnect()
        arrived = link.arrived if link else 0
        welcome = MasterWelcome(self._identity, arrived, *self._keepalive, self._lost_grace)
        pending.welcome(
            welcome.encode(),
            lambda descriptor, secrets: self._loop.call_soon(
                self._connect, pending, hello, arrived, descriptor, secrets
            ),
        )

    def _connect(
        self,
        pending: PendingConnection,
        hello: AgentHello,
        arrived: int,
        descriptor: int,
        secrets: Secrets,
    ) -> None:
        """Give the connection, which has left TLS, to its link."""
        link = self._links.get(hello.link)
        if self._closing is not None or (link.arrived if link else 0) != arrived:
            os.close(descriptor)  # this master ends, or the agent has come by another connection
            return
        before = self._by_peer.get(_peer(hello.identity))
        if link is None and before is not None and before.is_connected:
            os.close(descriptor)  # it has come by another connection, as another link
            return
        new = link is None
        if link is None:
            link = Link(
                self._loop, hello.identity, self._keepalive, lambda _: self._forget(hello.link)
            )
            self._by_peer[_peer(hello.identity)] = link
        try:
            connection = SealedConnection(
                self._loop,
                descriptor,
                secrets,
                on_datagram=link.datagram,
                on_gone=link.disconnected,
            )
        except FiberError as error:
            pending.report_proven(f"{hello.identity.name!r} cannot be served: {error}")
            if new:
                self._on_unserved(hello.identity.name, str(error))
            return
        self._links[hello.link] = link
        link.connected(connection, hello.arrived)
        if new and (unwanted := self._on_agent(link)):
            link.close(unwanted)
            pending.report_proven(unwanted)

    def _forget(self, link: str) -> None:
        ended = self._links.pop(link, None)
        if ended is not None and self._by_peer.get(_peer(ended.peer)) is ended:
            del self._by_peer[_peer(ended.peer)]
        self._finish_closing()


def _peer(identity: Identity) -> tuple[str, str]:
    return identity.name, identity.uid
