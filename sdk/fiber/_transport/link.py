"""Link between the master and an agent.

A link carries frames in both directions, each once and in order, also when its connection breaks
and is replaced.  It ends when one side closes it or is silent for too long, and stays ended.

A ``Link`` has a ``LinkProtocol``, the loop that drives it, and the present connection.  Any thread
may call ``send``, ``close`` and ``attach``; they only leave a note for the loop.  All other methods
run on the loop thread.  ``MasterListener`` and ``AgentDialer`` call ``connected``,
``disconnected``, ``datagram`` and ``refused``.  The link calls ``on_end`` when they must forget it.
"""

from __future__ import annotations

import enum
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, Protocol

from fiber import _logs
from fiber._transport.authentication import Identity
from fiber._transport.link_protocol import (
    HEARTBEAT,
    Datagram,
    Frame,
    Gap,
    Lane,
    LinkProtocol,
    LinkStatistics,
)
from fiber._transport.loop import EventLoop, ScheduledCall
from fiber._wire.memory_files import BytesLike
from fiber._wire.messages import ProtocolError


class Keepalive(NamedTuple):
    """Limits of silence on a link, in seconds."""

    heartbeat: float = HEARTBEAT
    """Seconds without sending after which a side sends a heartbeat."""
    suspect_after: float = 7.0
    """Seconds after which a silent peer is suspect: two heartbeats did not come."""
    lost_after: float = 15.0
    """Seconds after which the link to a silent peer ends.  Later messages are dropped."""


DEFAULT_KEEPALIVE = Keepalive()


class LinkObserver(Protocol):
    """Observer of a link.  Its methods run on the loop thread and must not block."""

    def on_frame(self, frame: Frame) -> None:
        """Take the next frame.  The observer owns a writable frame and may change it."""

    def on_suspect(self) -> None:
        """Note that the peer has been silent for a while.  It may come back."""

    def on_trusted(self) -> None:
        """Note that a suspect peer has sent something again.  No frame was lost."""

    def on_lost(self, reason: str) -> None:
        """Note that the link ended without ``close`` on this side.  Called once, as the last."""


class LinkConnection(Protocol):
    """Connection of a link.  It keeps the order of datagrams until it breaks.

    ``SealedConnection`` implements it over nng.  The simulation of links has another.
    """

    def put(self, datagram: Datagram) -> None:
        """Send a datagram; never blocks and never raises."""

    def break_off(self) -> None:
        """Close the connection as if it had broken, so that the agent dials again."""

    def close(self) -> None:
        """Close the connection."""


_CLOSE, _CLOSE_ACK = b"\x20", b"\x21"

_LAST_WORD = 0.2
"""Seconds for the last datagram to leave before this side closes the connection."""


_GRAIN = 0.001
"""Least seconds of a timer.  Rounding could make a shorter one fire too early for ever."""


class _LinkState(enum.Enum):
    OPEN = enum.auto()
    CLOSING = enum.auto()
    """Closed by this side.  Queued frames still leave."""
    LEAVING = enum.auto()
    """State after this side announced its end: it waits for the answer."""
    ENDED = enum.auto()


class Link:
    """End of a link.  It uses one connection after the other."""

    def __init__(
        self,
        loop: EventLoop,
        peer: Identity,
        keepalive: Keepalive,
        on_end: Callable[[Link], None],
        *,
        dials: bool = False,
    ) -> None:
        """Make a link without a connection.

        ``dials``: True if this side makes new connections, and so may give one up.
        """
        self.peer = peer
        self._loop = loop
        self._keepalive = keepalive
        self._on_end = on_end
        self._dials = dials
        self._protocol = LinkProtocol(loop.now(), heartbeat=keepalive.heartbeat)
        self._state = _LinkState.OPEN
        self._connection: LinkConnection | None = None
        self._suspect = False
        self._observer: LinkObserver | None = None
        self._inbox: deque[Frame] = deque()
        self._lost: str | None = None
        self._flush_due = False
        self._timer: ScheduledCall | None = None
        self._timer_due = 0.0
        self._close_datagram = b""
        self._then: list[Callable[[], None]] = []

    @property
    def arrived(self) -> int:
        """Number of the peer's datagrams that have arrived, for the greeting."""
        return self._protocol.arrived

    @property
    def is_connected(self) -> bool:
        """True while there is a connection."""
        return self._connection is not None

    @property
    def has_received(self) -> bool:
        """True if the peer has ever sent a datagram."""
        return self._protocol.has_received

    def limit(self, largest: int) -> None:
        """End the link when the peer announces frames that have more bytes at the same time.

        A frame that fits into one datagram may always come.  Runs on the loop thread.
        """
        self._protocol.largest = largest

    def attach(self, observer: LinkObserver) -> None:
        """Set the observer.  Frames that arrived before wait for it."""
        self._observer = observer
        self._loop.call_soon(self._hand_over)

    def send(
        self, *frame: BytesLike, lane: Lane = None, on_left: Callable[[], None] | None = None
    ) -> None:
        """Send a frame as soon as there is room; drop it if the link has ended.

        The frame may be given in pieces.  Large pieces are not copied, and must not change until
        they have arrived.  Large frames of different lanes travel at the same time
        (``link_protocol`` has the order).  ``on_left`` is called on the loop thread when the
        connection has taken the last piece.
        """
        self._loop.call_soon(self._send, frame, lane, on_left)

    def close(
        self,
        reason: str = "",
        *,
        linger: float = 1.0,
        then: Callable[[], None] | None = None,
    ) -> None:
        """End the link.  The peer's observer gets ``on_lost(reason)``; this side's gets no call.

        Frames that were sent still arrive if that takes at most ``linger`` seconds.  ``then`` is
        called on the loop thread when the link has ended.
        """
        self._observer = None
        self._loop.call_soon(self._close, reason, linger, then)

    def statistics(self) -> LinkStatistics:
        """Return what the link holds now, and what it has done so far."""
        return self._protocol.statistics()

    def connected(self, connection: LinkConnection, arrived: int) -> None:
        """Go on over ``connection``.  Its other end has ``arrived`` datagrams of this side."""
        if self._state is _LinkState.ENDED:
            connection.close()
            return
        if self._connection is not None:
            self._unplug().close()
        try:
            self._protocol.connected(arrived)
        except ProtocolError as error:
            # A peer that forgot what it acknowledged is not the peer of this link.
            connection.close()
            self._lose(str(error))
            return
        _logs.debug("link with %s: connected", self.peer.name)
        self._connection = connection
        self._flush()

    def disconnect(self) -> None:
        """Close the connection.  A peer that dials makes a new one when it notices."""
        if self._connection is not None:
            self._unplug().close()

    def disconnected(self, connection: LinkConnection) -> None:
        """Note that ``connection`` broke; ignore a connection that was replaced before."""
        if connection is not self._connection:
            return
        _logs.debug("link with %s: the connection ended", self.peer.name)
        self._unplug()
        if self._state is _LinkState.LEAVING:
            self._end()

    def datagram(self, connection: LinkConnection, datagram: BytesLike) -> None:
        """Take a datagram without keeping it; ignore one from a connection that was replaced."""
        if connection is not self._connection or self._state is _LinkState.ENDED:
            return
        if datagram[:1] == _CLOSE:
            connection.put(_CLOSE_ACK)
            self._lose(
                str(datagram[1:], "utf-8", "replace") or "it closed the link", disconnects=False
            )
        elif datagram == _CLOSE_ACK:
            if self._state is _LinkState.LEAVING:
                self._end()
        else:
            self._take(connection, datagram)

    def refused(self, reason: str) -> None:
        """End the link, as the peer refuses to continue it."""
        self._lose(reason)

    def _take(self, connection: LinkConnection, datagram: BytesLike) -> None:
        now = self._loop.now()
        try:
            frames = self._protocol.received(datagram, now)
        except Gap:
            connection.break_off()
            return
        except ProtocolError as error:
            # From here on its datagrams cannot be relied upon.
            self._lose(f"it broke the protocol: {error}")
            return
        if self._state is _LinkState.OPEN:
            self._inbox += frames
        self._trust_peer()
        self._hand_over()
        if self._state is not _LinkState.OPEN or self._protocol.wants_to_speak(now):
            self._flush_soon()
        elif not self._flush_due:
            self._set_timer(now)

    def _trust_peer(self) -> None:
        if self._suspect:
            self._suspect = False
            if observer := self._observer:
                observer.on_trusted()

    def _hand_over(self) -> None:
        """Give the observer the frames that wait for it.

        If the observer fails on a frame, the link ends: the peer relies on every frame.
        """
        try:
            while self._inbox and (observer := self._observer):
                observer.on_frame(self._inbox.popleft())
        except Exception as error:
            self._inbox.clear()
            self._lose(f"{type(error).__name__} while its message was handled: {error}")
            raise
        if self._lost is not None and (observer := self._observer):
            self._observer = None
            observer.on_lost(self._lost)

    def _send(
        self, frame: Sequence[BytesLike], lane: Lane, on_left: Callable[[], None] | None
    ) -> None:
        if self._state is not _LinkState.ENDED:
            callback = None if on_left is None else partial(self._loop.call_soon, on_left)
            self._protocol.send(*frame, lane=lane, on_left=callback)
            self._flush_soon()

    def _flush_soon(self) -> None:
        """Flush once for all frames that are sent in this turn."""
        if not self._flush_due:
            self._flush_due = True
            self._loop.call_soon(self._flush)

    def _flush(self) -> None:
        self._flush_due = False
        if self._state is not _LinkState.ENDED:
            self._speak()

    def _speak(self) -> None:
        now = self._loop.now()
        if self._connection is not None:
            for datagram in self._protocol.outgoing(now):
                self._connection.put(datagram)
            if self._state is _LinkState.CLOSING and self._protocol.idle:
                self._state = _LinkState.LEAVING
                self._connection.put(self._close_datagram)
        self._set_timer(now)

    def _set_timer(self, now: float) -> None:
        """Set the timer.  A timer that fires too early does no harm."""
        due = self._protocol.next_timer()
        if self._timer is not None:
            if self._timer_due <= due:
                return
            self._timer.cancel()
        self._timer_due = due
        self._timer = self._loop.call_later(max(_GRAIN, due - now), self._tick)

    def _tick(self) -> None:
        self._timer = None
        silent = self._protocol.tick(self._loop.now())
        if silent >= self._keepalive.lost_after:
            broken = "" if self._connection else "the connection broke, and "
            self._lose(f"{broken}the other side was silent for {silent:.0f} s")
            return
        if silent >= self._keepalive.suspect_after and not self._suspect:
            self._suspect = True
            if self._connection is not None and self._dials:
                self._connection.break_off()
            if observer := self._observer:
                observer.on_suspect()
        self._speak()

    def _unplug(self) -> LinkConnection:
        connection, self._connection = self._connection, None
        assert connection is not None
        self._protocol.disconnected()
        return connection

    def _close(self, reason: str, linger: float, then: Callable[[], None] | None) -> None:
        if then is not None:
            self._then.append(then)
        self._inbox.clear()
        if self._state is _LinkState.ENDED:
            self._finished()
        elif self._state is _LinkState.OPEN:
            self._state = _LinkState.CLOSING
            self._close_datagram = _CLOSE + reason.encode("utf-8", "replace")
            self._loop.call_later(linger, self._give_up)
            self._flush()

    def _give_up(self) -> None:
        """End the link after its linger, with or without the peer's answer."""
        if self._state is _LinkState.ENDED:
            return
        if self._state is _LinkState.CLOSING and self._connection is not None:
            self._connection.put(self._close_datagram)
            self._state = _LinkState.LEAVING
            self._loop.call_later(_LAST_WORD, self._give_up)
        else:
            self._end()

    def _lose(self, reason: str, *, disconnects: bool = True) -> None:
        if self._state is _LinkState.ENDED:
            return
        if self._state is _LinkState.OPEN:
            self._lost = reason
        if disconnects:
            self._end()
        else:
            self._stop()
            self._loop.call_later(_LAST_WORD, self._end)
        self._hand_over()

    def _stop(self) -> None:
        self._state = _LinkState.ENDED
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _end(self) -> None:
        self._stop()
        if self._connection is not None:
            self._unplug().close()
        self._protocol.end()
        self._on_end(self)
        self._finished()

    def _finished(self) -> None:
        finished, self._then = self._then, []
        for then in finished:
            then()
