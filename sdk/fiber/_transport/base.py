"""The two primitives under every connection, queue, event and semaphore.

Both have two implementations: kernel objects for holders on the host where the object lives
(``unix.py``, ``fiber._hub.local``) and a request to that host's hub for all others
(``fiber._hub.remote``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from fiber._wire.packet import BytesLike, Message


class Channel(Protocol):
    """One end of a message pipe.

    Messages arrive whole; holders may share an end without a lock.
    """

    def send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message; BrokenPipeError when nobody can ever read it."""

    def send_unconfirmed(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """The same without waiting for another host's answer: an error may come with the next."""

    def recv(self, *, passing: bool = False) -> Message:
        """The next message; ConnectionClosed when nobody can ever send one.

        ``passing``: what is large in it is soon copied or let go of.
        """

    def recv_object(self) -> Any:
        """The same, unpickled."""

    def try_recv(self) -> Message | None:
        """The next message if one is there."""

    def poll(self, timeout: float | None) -> bool:
        """Whether ``recv`` would return or raise at once; None waits for ever."""

    def fileno(self) -> int:
        """A descriptor that is readable whenever ``recv`` would not block."""

    def close(self) -> None:
        """Let go of this end; the other end sees EOF when its last holder has."""


class Counter(Protocol):
    """A count of things that never falls below zero, to be waited for."""

    def add(self, n: int = 1) -> None:
        """Raise the count and wake who waits."""

    def take(self, timeout: float | None, taken: list[Any] | None = None) -> bool:
        """Lower the count by one once it is above zero; False when ``timeout`` is over.

        ``taken`` gets an entry when it is: whoever is interrupted sees there what to give back.
        """

    def clear(self) -> int:
        """Set the count to zero and say what it was."""

    def value(self) -> int:
        """The count now."""

    def wait(self, timeout: float | None) -> bool:
        """Wait until the count is above zero, without lowering it."""

    def close(self) -> None:
        """Let go of it."""


class SharedChannel(Channel, Protocol):
    """A channel that a queue can use: it never has to wait."""

    @property
    def can_try_send(self) -> bool:
        """Whether ``try_send`` is worth a try."""

    def post(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message, waiting for room but not until it is read."""

    def try_send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send one message if there is room for it now."""

    def recv_counting(self, counter: Any, *, wait: bool) -> Message | None:
        """Receive a message and raise a ``SharedCounter`` of the same host; None if there is none.

        Neither an interrupt nor the death of this process comes in between.
        """


class Claimant(Protocol):
    """Notes how many places of a counter a process has."""

    def add(self) -> None:
        """Note one more."""

    def drop(self) -> None:
        """Note one less."""


class SharedCounter(Counter, Protocol):
    """A counter whose every change can be waited for."""

    def claim(self, timeout: float | None, taken: list[Any], claims: Claimant) -> bool:
        """As ``take``, and note it in ``claims``.

        A process that dies meanwhile has taken nothing, or has a claim.
        """

    def changed(self, since: int, timeout: float | None) -> bool:
        """Wait until the count is not ``since``; False when ``timeout`` is over."""
