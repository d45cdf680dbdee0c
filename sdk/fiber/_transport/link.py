"""Interface of a link between the master and an agent.

A link carries frames both ways, each once and in order, also when the connection under it breaks
and is replaced.  It ends when one side closes it, or after too long a silence, and stays ended.
``resumable_link.ResumableLink`` is the one implementation; ``listener``, ``dialer`` and ``memory``
make them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from fiber._transport.handshake import Identity
from fiber._transport.stream import HEARTBEAT, Datagram, Frame, Statistics
from fiber._transport.turns import Lane
from fiber._wire.messages import BytesLike


class Keepalive(NamedTuple):
    """Limits of silence on a link, in seconds."""

    heartbeat: float = HEARTBEAT
    """A side that has sent nothing for so long sends a heartbeat."""
    suspect_after: float = 7.0
    """The peer is suspect: two heartbeats did not come."""
    lost_after: float = 15.0
    """The link ends.  Messages that come later are dropped."""


DEFAULT_KEEPALIVE = Keepalive()


class LinkObserver(Protocol):
    """Observer of a link.  Its methods run on the loop's thread and must not block."""

    def on_frame(self, frame: Frame) -> None:
        """Take the next frame.  The observer owns a writable frame and may change it."""

    def on_suspect(self) -> None:
        """Note that the peer has been silent for a while.  It may come back."""

    def on_trusted(self) -> None:
        """Note that a suspect peer is heard again, and nothing was lost."""

    def on_lost(self, reason: str) -> None:
        """Note that the link ended, and not by ``close`` on this side.  Called once, and last."""


class Link(Protocol):
    """End of a link.  Any thread may call its methods, and none blocks."""

    peer: Identity

    def attach(self, observer: LinkObserver) -> None:
        """Set the observer.  Frames that arrived before wait for it."""

    def send(
        self, *frame: BytesLike, lane: Lane = None, on_left: Callable[[], None] | None = None
    ) -> None:
        """Send a frame as soon as there is room; dropped if the link has ended.

        The frame may be given in pieces.  Large pieces are not copied, and must not change until
        they have arrived.  Large frames of different lanes travel at the same time (``turns.py``
        has the order).  ``on_left`` is called on the loop's thread when the connection has taken
        the last piece.
        """

    def close(
        self,
        reason: str = "",
        *,
        linger: float = 1.0,
        then: Callable[[], None] | None = None,
    ) -> None:
        """End the link.  The peer's observer gets ``on_lost(reason)``; this side's gets nothing.

        Frames that were sent still arrive if that takes at most ``linger`` seconds.  ``then`` is
        called on the loop's thread when the link has ended.
        """

    def statistics(self) -> Statistics:
        """Return what the link holds now, and what it has done so far."""


class Wire(Protocol):
    """Connection under a link.  It keeps the order of datagrams until it breaks."""

    def put(self, datagram: Datagram) -> None:
        """Send a datagram; never blocks and never raises."""

    def break_off(self) -> None:
        """End the connection as if it had broken, so that the agent dials again."""

    def close(self) -> None:
        """Close the connection."""


class Timer(Protocol):
    """Call that the loop makes later."""

    def cancel(self) -> None:
        """Cancel the call."""


class EventLoop(Protocol):
    """Part of the loop that a link needs: its clock and its turns."""

    def now(self) -> float:
        """Return the time in seconds of a monotonic clock."""

    def call_soon(self, callback: Callable[..., None], *args: Any) -> None:
        """Call ``callback`` on the loop's thread.  Any thread."""

    def call_later(self, seconds: float, callback: Callable[..., None], *args: Any) -> Timer:
        """Call ``callback`` once, after ``seconds``."""


class SelectorEventLoop(EventLoop, Protocol):
    """Loop that also watches descriptors."""

    def register(self, fd: int, callback: Callable[[], None]) -> None:
        """Call back whenever ``fd`` is readable."""

    def unregister(self, fd: int) -> None:
        """Stop watching ``fd``."""
