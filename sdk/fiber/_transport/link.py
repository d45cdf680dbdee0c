"""What a link between the master and an agent promises, whatever carries it.

A link carries frames both ways, each once and in order, also across a break of the connection under
it.  It ends when one side closes it or when nothing was heard for too long; then it stays ended.
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
    """How long silence is borne, in seconds."""

    heartbeat: float = HEARTBEAT
    """Who has nothing to say for so long says that."""
    suspect_after: float = 7.0
    """Two heartbeats did not come."""
    lost_after: float = 15.0
    """The link ends; whatever comes later is dropped."""


DEFAULT_KEEPALIVE = Keepalive()


class LinkObserver(Protocol):
    """Hears what happens to a link.  Called on the loop's thread; must not block."""

    def on_frame(self, frame: Frame) -> None:
        """The next frame.  One that can be written to is the observer's to keep and to write to."""

    def on_suspect(self) -> None:
        """The peer has not been heard for a while; it may come back."""

    def on_trusted(self) -> None:
        """The peer that was suspect is heard again, and nothing was lost."""

    def on_lost(self, reason: str) -> None:
        """The link ended, and not by our ``close``.  Exactly once, and last."""


class Link(Protocol):
    """One end of a link.  Any thread; nothing blocks."""

    peer: Identity

    def attach(self, observer: LinkObserver) -> None:
        """Whom to tell.  What arrives before waits for it."""

    def send(
        self, *frame: BytesLike, lane: Lane = None, on_left: Callable[[], None] | None = None
    ) -> None:
        """Send a frame as soon as there is room; dropped if the link has ended.

        It may come in pieces.  Large ones are not copied, and must not change until they arrived.
        Large frames of different lanes travel at the same time (``turns.py`` says in which order).
        ``on_left`` is called on the loop's thread when the last of it was given to the connection.
        """

    def close(
        self,
        reason: str = "",
        *,
        linger: float = 1.0,
        then: Callable[[], None] | None = None,
    ) -> None:
        """End the link: the observer hears nothing more, the peer's hears ``on_lost(reason)``.

        What was sent still arrives if that takes no longer than ``linger`` seconds.  ``then`` is
        called on the loop's thread when it is over.
        """

    def statistics(self) -> Statistics:
        """What it holds now and has done so far."""


class Wire(Protocol):
    """What a link puts its datagrams on: a connection, which keeps their order until it breaks."""

    def put(self, datagram: Datagram) -> None:
        """Send it; never blocks and never raises."""

    def break_off(self) -> None:
        """End the connection, as if it had broken: whoever dials dials again."""

    def close(self) -> None:
        """Let go of the connection."""


class Timer(Protocol):
    """A call that is due."""

    def cancel(self) -> None:
        """Never call it."""


class EventLoop(Protocol):
    """What a link needs of the loop: its clock and its turns."""

    def now(self) -> float:
        """Monotonic seconds."""

    def call_soon(self, callback: Callable[..., None], *args: Any) -> None:
        """Call it on the loop's thread; from any thread."""

    def call_later(self, seconds: float, callback: Callable[..., None], *args: Any) -> Timer:
        """Call it once, later."""


class SelectorEventLoop(EventLoop, Protocol):
    """A loop that also watches descriptors."""

    def register(self, fd: int, callback: Callable[[], None]) -> None:
        """Call back whenever ``fd`` is readable."""

    def unregister(self, fd: int) -> None:
        """Forget it."""
