"""Bytes that many children need: they go to each agent once, and to each child as a descriptor."""

from __future__ import annotations

import os

from fiber._wire import messages
from fiber._wire.descriptor import Descriptor, opened, own
from fiber._wire.messages import BytesLike


class Blob:
    """Bytes, named by their content.

    An agent has them for as long as the master has the object (``fiber._backends.remote``).
    """

    __slots__ = ("__weakref__", "_data", "_file", "digest")

    def __init__(self, data: BytesLike) -> None:
        import hashlib  # most programs need none of it, nor what follows

        self.digest = hashlib.sha256(data).digest()
        self._data = data
        self._file: Descriptor | None = None

    @classmethod
    def in_file(cls, digest: bytes, data: BytesLike, directory: str | None) -> Blob:
        """Return a blob that lies on disk, as the memory of an agent's pod is limited; OSError.

        The file has no name, so that none is left when the agent is killed.
        """
        import tempfile

        blob = cls.__new__(cls)
        blob.digest, blob._data = digest, b""
        with tempfile.TemporaryFile(dir=directory) as file:
            blob._file = own(os.dup(file.fileno()))
        _write(blob._file.fileno(), data)
        return blob

    @property
    def message(self) -> messages.Blob:
        """The message that brings it to an agent."""
        return messages.Blob(self.digest, self._data)

    def fileno(self) -> int:
        """The descriptor of a file that holds the bytes; it stays this object's."""
        if self._file is None:
            file = opened(os.memfd_create, "fiber-blob")
            _write(file.fileno(), self._data)
            self._file = file
        return self._file.fileno()


def _write(fd: int, data: BytesLike) -> None:
    view, done = memoryview(data), 0
    while done < len(view):  # one write moves at most 2 GiB
        done += os.write(fd, view[done:])
