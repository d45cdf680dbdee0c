"""Large arrays among the arguments of joblib's loops: their workers map them, as loky's do.

An array that is sent once is pickled, which takes less than to share it.  One that is sent again,
the data set of a grid search, say, is copied to shared memory once, and each worker of this host
maps that.  A worker of another host gets a copy with each task.
"""

from __future__ import annotations

import copy
import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np
from joblib._memmapping_reducer import _get_backing_memmap, _reduce_memmap_backed
from joblib.parallel import BatchedCalls

from fiber._hub import shared_buffer
from fiber._hub.shared_buffer import SharedBuffer

_SHARED_ARRAYS = 64
"""At a time: each has a descriptor."""


class MemmappedArguments:
    """The large arguments of the batches of one loop, or of loops over each other's results.

    ``options`` are ``joblib.Parallel``'s ``max_nbytes`` and ``mmap_mode``.  An array is large with
    more than ``max_nbytes`` bytes; tasks see it as ``mmap_mode`` says: "r" is read-only.  Arrays
    within an argument, a list or a table, are not looked for.
    """

    def __init__(self, options: Mapping[str, Any], *, same_host: bool) -> None:
        self._max_nbytes: int | None = options.get("max_nbytes")
        self._mode: str | None = options.get("mmap_mode")
        self._same_host = same_host
        self._sent: dict[int, weakref.ref[Any]] = {}
        self._shared: dict[int, SharedBuffer] = {}

    def of(self, batch: Any) -> Any:
        """The batch, to be pickled at once and sent."""
        if not isinstance(batch, BatchedCalls):
            return batch
        sent = copy.copy(batch)
        sent.items = [
            (func, tuple(map(self._one, args)), {key: self._one(kwargs[key]) for key in kwargs})
            for func, args, kwargs in batch.items
        ]
        return sent

    def close(self) -> None:
        """Forget what was shared; who maps it still has it."""
        self._sent.clear()
        self._shared.clear()

    def _one(self, value: Any) -> Any:
        if type(value) not in (np.ndarray, np.memmap) or value.dtype.hasobject:
            return value
        mapped = _get_backing_memmap(value) if self._same_host else None
        if isinstance(mapped, np.memmap):  # and not memory without a name
            return _Reduced(*_reduce_memmap_backed(value, mapped))
        if self._max_nbytes is None or self._mode is None or value.nbytes <= self._max_nbytes:
            return value
        buffer = self._buffer(value) if self._same_host else None
        if buffer is None:
            return _Reduced(_read_only, (value,)) if self._mode == "r" else value
        order = "F" if value.flags.fnc else "C"
        return _Reduced(_array, (buffer, value.dtype, value.shape, order, self._mode))

    def _buffer(self, array: Any) -> SharedBuffer | None:
        """The memory that has a copy of it; None if it is to be pickled."""
        number = id(array)
        again = number in self._sent
        if number in self._shared:
            return self._shared[number]
        if not again:
            self._sent[number] = weakref.ref(array, lambda _: self._forget(number))
        if not (again or self._mode in ("r+", "w+")) or len(self._shared) >= _SHARED_ARRAYS:
            return None
        buffer = shared_buffer.allocate(array.nbytes)
        order = "F" if array.flags.fnc else "C"
        _array(buffer, array.dtype, array.shape, order, "w+")[...] = array
        return self._shared.setdefault(number, buffer)

    def _forget(self, number: int) -> None:
        self._sent.pop(number, None)
        self._shared.pop(number, None)


class _Reduced:
    """Stand-in that unpickles to the object that its arguments describe."""

    def __init__(self, *reduction: Any) -> None:
        self._reduction = reduction

    def __reduce__(self) -> tuple[Any, ...]:
        return self._reduction


def _array(buffer: SharedBuffer, dtype: Any, shape: tuple[int, ...], order: Any, mode: str) -> Any:
    array = np.ndarray(shape, dtype, buffer.view, order=order)
    if mode == "c":  # each task may write to a copy of its own
        return array.copy(order)
    return _read_only(array) if mode == "r" else array


def _read_only(array: Any) -> Any:
    array.flags.writeable = False
    return array
