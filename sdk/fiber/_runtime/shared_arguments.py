"""Arguments that all workers of a pool are started with, pickled once for all of them."""

from __future__ import annotations

from typing import Any

from fiber import reduction
from fiber._wire.blob import Blob

_WORTHWHILE = 1 << 16
"""Bytes of a pickle below which it is as well sent to each."""


class SharedArguments:
    """``args`` of Processes, to be pickled when the first is started.

    Of several threads that start one first, each may pickle them: the same bytes are the same blob.
    """

    def __init__(self, args: tuple[Any, ...]) -> None:
        self.args = args
        self._blob: Blob | None = None
        self._tried = False

    def blob(self, *, same_host: bool) -> Blob | None:
        """Their pickle; None if each process must be given its own, or might as well."""
        if not self._tried:
            data = reduction.dump_shared(self.args, same_host=same_host)
            if data is not None and len(data) >= _WORTHWHILE:
                self._blob = Blob(data)
            self._tried = True
        return self._blob
