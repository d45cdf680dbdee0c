"""The blobs that an agent was sent, for the children that it starts."""

from __future__ import annotations

from fiber._wire import messages
from fiber._wire.blob import Blob


class BlobLacking(Exception):
    """A blob is not here; says why."""

    def __init__(self, digest: bytes, reason: str) -> None:
        super().__init__(f"what its master sent ahead is not there: {reason}")
        self.digest = digest


class BlobStore:
    """What a master sent and has not told to forget, in files in ``directory``.

    Frames come in order: what is sent before a Start is here when the Start comes, and what is
    forgotten after it is still open to the child that it started.
    """

    def __init__(self, directory: str | None) -> None:
        self._directory = directory
        self._blobs: dict[bytes, Blob] = {}
        self._refused: dict[bytes, str] = {}
        """What the system had no room for, and why."""

    def put(self, message: messages.Blob) -> None:
        """Keep one, if the system lets us; otherwise ``get`` says why not."""
        try:
            blob = Blob.in_file(message.digest, message.data, self._directory)
        except OSError as error:
            self._refused[message.digest] = str(error)
            return
        self._refused.pop(message.digest, None)
        self._blobs[message.digest] = blob

    def get(self, digest: bytes) -> Blob:
        """One that was sent; BlobLacking if it is not here."""
        blob = self._blobs.get(digest)
        if blob is None:
            raise BlobLacking(digest, self._refused.pop(digest, "it was forgotten"))
        return blob

    def forget(self, digest: bytes) -> None:
        """Nobody will ask for it."""
        self._blobs.pop(digest, None)
        self._refused.pop(digest, None)
