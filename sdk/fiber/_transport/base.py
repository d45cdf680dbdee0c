"""The two primitives under every connection, queue, event and semaphore.

Both have two implementations: kernel objects for holders on the host where the object lives
(``unix.py``, ``fiber._hub.local``) and a request to that host's hub for all others
(``fiber._hub.remote``).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import Message


class Channel(Protocol):
    """End of a message pipe.

    Messages arrive whole; holders may share an end without a lock.
    """

    def send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message; BrokenPipeError if the other end has no holder left."""

    def send_unconfirmed(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message without waiting for the answer of another host.

        An error may be raised by the next call.
        """

    def recv(self, *, passing: bool = False) -> Message:
        """Return the next message; ConnectionClosed if the other end has no holder left.

        ``passing``: the caller soon copies or releases the large parts of the message.
        """

    def recv_object(self) -> Any:
        """Return the next message, unpickled."""

    def try_recv(self) -> Message | None:
        """Return the next message if one is there."""

    def poll(self, timeout: float | None) -> bool:
        """Wait until ``recv`` would return or raise at once; None waits for ever.

        Return False after ``timeout`` seconds.
        """

    def fileno(self) -> int:
        """Return a descriptor that is readable whenever ``recv`` would not block."""

    def close(self) -> None:
        """Close this holder's end.  The other end sees EOF after the last holder has closed it."""


class Counter(Protocol):
    """Count that never falls below zero, and that callers can wait for."""

    def add(self, n: int = 1) -> None:
        """Raise the count and wake the waiters."""

    def take(self, timeout: float | None, taken: list[Any] | None = None) -> bool:
        """Lower the count by one once it is above zero; False when ``timeout`` is over.

        ``taken`` gets an entry when the count is lowered: an interrupted caller can give it back.
        """

    def clear(self) -> int:
        """Set the count to zero and return the count before."""

    def value(self) -> int:
        """Return the count."""

    def wait(self, timeout: float | None) -> bool:
        """Wait until the count is above zero, without lowering it."""

    def close(self) -> None:
        """Close this holder's end of the counter."""


class SharedChannel(Channel, Protocol):
    """Channel that a queue can use, because it can send without waiting."""

    @property
    def can_try_send(self) -> bool:
        """True if ``try_send`` can succeed."""

    def post(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message, waiting for room but not until it is read."""

    def try_send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send one message if there is room for it now."""

    def recv_counting(self, counter: Any, *, wait: bool) -> Message | None:
        """Receive a message and raise ``counter``, a ``SharedCounter`` of the same host.

        Both happen or none, also if this process is interrupted or dies.  Return None if there is
        no message.
        """


class Claimant(Protocol):
    """Record of how many places of a counter a process holds."""

    def add(self) -> None:
        """Record one more place."""

    def drop(self) -> None:
        """Record one place less."""


class SharedCounter(Counter, Protocol):
    """Counter of which callers can wait for each change."""

    def claim(self, timeout: float | None, taken: list[Any], claims: Claimant) -> bool:
        """Take one as ``take`` does, and record it in ``claims``.

        A process that dies in between has taken nothing, or has a claim.
        """

    def changed(self, since: int, timeout: float | None) -> bool:
        """Wait until the count is not ``since``; False when ``timeout`` is over."""
