"""What one agent was sent of the blobs that its children need."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable

from fiber._transport.link import EventLoop
from fiber._wire import messages
from fiber._wire.blob import Blob


class BlobSender:
    """Sends each blob once, and has the agent forget it when nobody here has it any more.

    So an agent keeps no more than this program does, and nobody counts: a blob lives as long as a
    pool, a child or the program itself refers to it.  On the loop's thread.
    """

    def __init__(self, loop: EventLoop, send: Callable[[bytes], None]) -> None:
        self._loop = loop
        self._send = send
        self._sent: dict[bytes, weakref.ref[Blob]] = {}

    def send_missing(self, blobs: Iterable[Blob]) -> None:
        """Send those that the agent does not have; what is sent next finds them there."""
        for blob in blobs:
            if blob.digest not in self._sent:
                self._send(blob.frame)
            # The newest of several with the same content counts.
            self._sent[blob.digest] = weakref.ref(blob, self._forgetter(blob.digest))

    def lost(self, digest: bytes) -> None:
        """The agent could not keep it."""
        self._sent.pop(digest, None)

    def _forgetter(self, digest: bytes) -> Callable[[object], None]:
        # A finalizer runs anywhere, and may only put something into the loop's queue.
        return lambda _: self._loop.call_soon(self._forget, digest)

    def _forget(self, digest: bytes) -> None:
        reference = self._sent.get(digest)
        if reference is not None and reference() is None:  # otherwise it was made and sent again
            del self._sent[digest]
            self._send(messages.Forget(digest).encode())
