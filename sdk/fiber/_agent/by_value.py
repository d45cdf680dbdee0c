"""Functions that travel by value, pickled once and unpickled once in each worker."""

from __future__ import annotations

import pickle
import zlib
from functools import lru_cache
from typing import Any

FUNCTIONS = 128
"""Number of functions that a worker remembers."""


class FunctionByValue:
    """Pickle of a function by value, to pickle in place of the function.

    Where it is unpickled, the function takes its place.  A worker makes one function for each
    ``number``: a function may keep values that it assigns to its closure or globals.
    """

    __slots__ = ("_data", "_number")

    def __init__(self, data: bytes, number: int) -> None:
        self._number = number
        # It goes with every call.  Without ``__main__`` in it, plain pickle serves for the call.
        self._data = zlib.compress(data, 1)

    def __reduce__(self) -> Any:
        return _unpickle, (self._data, self._number)


@lru_cache(maxsize=FUNCTIONS)
def _unpickle(data: bytes, number: int) -> Any:
    return pickle.loads(zlib.decompress(data))
