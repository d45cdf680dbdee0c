"""Requests that a hub answers later."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from fiber._hub.protocol import HALF_FULL, ONE, Status
from fiber._hub.streams import Stream


class Requester(Protocol):
    """Handler of the stream that a request came by.

    ``ClientHandler`` implements it.  This module stands below ``client_handler``.
    """

    stream: Stream
    waiting: PendingRequest | None

    def message_taken(self, queued: QueuedMessage) -> None:
        """Note that the channel has taken a message, or that no process can read it."""

    def refuse(self, error: Exception) -> None:
        """End the stream, whose request failed."""


class PendingRequest:
    """Request that waits for its reply, which is sent once."""

    __slots__ = ("_handler", "_number", "_on_ok", "on_withdrawal", "then")

    def __init__(
        self, handler: Requester, number: int, on_ok: Callable[[], None] | None = None
    ) -> None:
        self._handler = handler
        self._number = number
        self._on_ok = on_ok
        self.on_withdrawal: Callable[[], None] | None = None
        """Function to call if the request ends without a reply."""
        self.then: Callable[[], None] | None = None
        """Second part of the request, which follows a first part that ends with OK."""

    def answer(self, status: Status, value: int = 0, buffers: Sequence[memoryview] = ()) -> None:
        """Send the reply, or go on with the second part."""
        then, self.then = self.then, None
        if then is not None and status is Status.OK:
            then()
            return
        if self._handler.waiting is self:
            self._handler.waiting = None
        if self._on_ok is not None and status is Status.OK:
            self._on_ok()
        self._handler.stream.send(ONE.pack(status, self._number, value), buffers)

    def refuse(self, error: Exception) -> None:
        """End the stream, as the request failed."""
        self._handler.refuse(error)

    def acknowledge(self) -> None:
        """Send a reply before the last one: the request was understood."""
        self._handler.stream.send(ONE.pack(Status.OK, self._number, 0))

    @property
    def number(self) -> int:
        """Number of the request on its stream."""
        return self._number


class QueuedMessage:
    """Message that its sender does not wait for.  It stays when the sender ends."""

    __slots__ = ("_handler", "number", "was_taken")

    def __init__(self, handler: Requester, number: int) -> None:
        self._handler = handler
        self.number = number
        self.was_taken = False

    def answer(self, status: Status, value: int = 0, buffers: Sequence[memoryview] = ()) -> None:
        """Reply that the channel has taken the message, or that nobody can read it."""
        self.was_taken = True
        self._reply(status, value)
        self._handler.message_taken(self)

    def refuse(self, error: Exception) -> None:
        """End the stream, as the channel cannot take the message."""
        self.was_taken = True
        self._handler.message_taken(self)
        self._handler.refuse(error)

    def acknowledge(self) -> None:
        """Reply that the message is queued behind the earlier ones."""
        self._reply(Status.OK, HALF_FULL)

    def _reply(self, status: Status, flags: int) -> None:
        self._handler.stream.send(ONE.pack(status, self.number, flags))
