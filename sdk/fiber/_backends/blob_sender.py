"""Sender of the blobs that the children of one agent need."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable
from functools import partial
from typing import Protocol

from fiber._transport.link import EventLoop
from fiber._wire import messages
from fiber._wire.blob import Blob


class Send(Protocol):
    """Sends a message to the agent; ``on_left`` is called once the last of it is on its way."""

    def __call__(
        self, message: messages.Message, on_left: Callable[[], None] | None = None
    ) -> None: ...


class BlobSender:
    """Sends each blob once, and has the agent forget it when nobody here has it any more.

    So an agent keeps no more than this program does, and nobody counts: a blob lives as long as a
    pool, a child or the program itself refers to it.  On the loop's thread.
    """

    def __init__(self, loop: EventLoop, send: Send) -> None:
        self._loop = loop
        self._send = send
        self._sent: dict[bytes, weakref.ref[Blob]] = {}
        self._leaving: dict[bytes, int] = {}
        """Number of times that each blob was sent and has not left."""
        self._waiting: list[tuple[list[bytes], Callable[[], None]]] = []
        """The blobs that a caller needs, and what follows when they have left."""

    def send_missing(self, blobs: Iterable[Blob], then: Callable[[], None]) -> None:
        """Send the blobs that the agent does not have, and call ``then`` when all have left.

        What is sent next finds them there, though large messages pass one another.
        """
        needed = []
        for blob in blobs:
            digest = blob.digest
            needed.append(digest)
            if digest not in self._sent:
                self._leaving[digest] = self._leaving.get(digest, 0) + 1
                self._send(blob.message, partial(self._left, digest))
            # The newest of several with the same content counts.
            self._sent[digest] = weakref.ref(blob, self._forgetter(digest))
        self._waiting.append((needed, then))
        self._go_on()

    def lost(self, digest: bytes) -> None:
        """The agent could not keep it."""
        self._sent.pop(digest, None)

    def _left(self, digest: bytes) -> None:
        self._leaving[digest] -= 1
        if not self._leaving[digest]:
            del self._leaving[digest]
            self._go_on()

    def _go_on(self) -> None:
        waiting, self._waiting = self._waiting, []
        for needed, then in waiting:
            if self._leaving.keys().isdisjoint(needed):
                then()
            else:
                self._waiting.append((needed, then))

    def _forgetter(self, digest: bytes) -> Callable[[object], None]:
        # A finalizer runs anywhere, and may only put something into the loop's queue.
        return lambda _: self._loop.call_soon(self._forget, digest)

    def _forget(self, digest: bytes) -> None:
        reference = self._sent.get(digest)
        if reference is not None and reference() is None:  # otherwise it was made and sent again
            del self._sent[digest]
            self._send(messages.Forget(digest))
