"""Blobs that the master sent to an agent, for the children that the agent starts."""

from __future__ import annotations

from fiber._wire import messages
from fiber._wire.blob import Blob


class BlobLacking(Exception):
    """Error: the agent does not have a blob.  The text says why."""

    def __init__(self, digest: bytes, reason: str) -> None:
        super().__init__(f"what its master sent ahead is not there: {reason}")
        self.digest = digest


class BlobStore:
    """Blobs of one master, in files in ``directory``, until the master sends Forget.

    Frames come in order.  A blob that is sent before a Start is here when the Start comes.  A child
    that was started before a Forget still has the blob open.
    """

    def __init__(self, directory: str | None) -> None:
        self._directory = directory
        self._blobs: dict[bytes, Blob] = {}
        self._refused: dict[bytes, str] = {}
        """Blobs for which the system had no room, and the reasons."""

    def put(self, message: messages.Blob) -> None:
        """Keep a blob.  If the system refuses that, ``get`` raises the reason."""
        try:
            blob = Blob.in_file(message.digest, message.data, self._directory)
        except OSError as error:
            self._refused[message.digest] = str(error)
            return
        self._refused.pop(message.digest, None)
        self._blobs[message.digest] = blob

    def get(self, digest: bytes) -> Blob:
        """Return a blob that was sent; raise BlobLacking if it is not here."""
        blob = self._blobs.get(digest)
        if blob is None:
            raise BlobLacking(digest, self._refused.pop(digest, "it was forgotten"))
        return blob

    def forget(self, digest: bytes) -> None:
        """Delete a blob, which no later Start names."""
        self._blobs.pop(digest, None)
        self._refused.pop(digest, None)
