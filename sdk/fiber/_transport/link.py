"""What a link between the master and an agent promises, whatever carries it.

A link carries frames both ways, each once and in order, also across a break of the connection under
it.  It ends when one side closes it or when nothing was heard for too long; then it stays ended.
``session_link.SessionLink`` is the one implementation; ``listener``, ``dialer`` and ``memory`` make
them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from fiber._transport.handshake import Identity
from fiber._transport.session import HEARTBEAT, Frame, Statistics


class Patience(NamedTuple):
    """How long silence is borne, in seconds."""

    heartbeat: float = HEARTBEAT
    """Who has nothing to say for so long says that."""
    suspect_after: float = 7.0
    """Two heartbeats did not come."""
    lost_after: float = 15.0
    """The link ends; whatever comes later is dropped."""


DEFAULT_PATIENCE = Patience()


class LinkObserver(Protocol):
    """Hears what happens to a link.  Called on the loop's thread; must not block."""

    def on_frame(self, frame: Frame) -> None:
        """The next frame.  A bytearray is the observer's to keep and to write into."""

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

    def send(self, frame: Frame) -> None:
        """Send a frame as soon as there is room; dropped if the link has ended."""

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
    """What a link puts its datagrams on: one connection, which may lose them or break."""

    def put(self, datagram: bytes) -> None:
        """Send it, or lose it; never blocks for long and never raises."""

    def doubt(self) -> None:
        """Nothing came for a while: replace the connection if that is this side's to do."""

    def close(self) -> None:
        """Let go of the connection."""


class Timer(Protocol):
    """A call that is due."""

    def cancel(self) -> None:
        """Never call it."""


class Scheduler(Protocol):
    """What a link needs of the loop: its clock and its turns."""

    def now(self) -> float:
        """Monotonic seconds."""

    def call_soon(self, callback: Callable[..., None], *args: Any) -> None:
        """Call it on the loop's thread; from any thread."""

    def call_later(self, seconds: float, callback: Callable[..., None], *args: Any) -> Timer:
        """Call it once, later."""


class Poller(Scheduler, Protocol):
    """A loop that also watches descriptors."""

    def register(self, fd: int, callback: Callable[[], None]) -> None:
        """Call back whenever ``fd`` is readable."""

    def unregister(self, fd: int) -> None:
        """Forget it."""
