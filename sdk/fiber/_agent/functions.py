"""Functions that a pool worker applies to the items of its batches.

multiprocessing unpickles the function for each chunk.  So what a task changes in the object of a
bound method, or in an argument of a partial, is gone when its chunk ends.  A worker does the same
with such functions.  It unpickles others once: plain functions, classes, and partials of them
whose arguments cannot change.

Queues, locks, proxies and the like stand for something that all processes share.  A copy of them
would be the same, and a worker takes long to attach to one.  So all copies have the same ones.
"""

from __future__ import annotations

import contextlib
import io
import pickle
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable
from functools import cache, partial
from types import (
    BuiltinFunctionType,
    FunctionType,
    MethodDescriptorType,
    MethodType,
    ModuleType,
    WrapperDescriptorType,
)
from typing import Any, cast

from fiber._agent.by_value import FUNCTIONS
from fiber._wire import work
from fiber._wire.memory_files import BytesLike

Function = Callable[..., Any]

LARGE = 1 << 14
"""Bytes of a pickled function above which the tasks that travel together share one copy."""

_DEFINITIONS = (FunctionType, MethodDescriptorType, WrapperDescriptorType, type)

_SHARING = ("fiber", "multiprocessing.managers")
"""Modules, or packages, of the classes whose objects stand for something shared."""

_CONSTANTS = work.PLAIN | {range, type(...)}


class KnownFunctions:
    """Functions that a worker remembers, by number."""

    def __init__(self) -> None:
        self._known: OrderedDict[int, Function | _Copies] = OrderedDict()

    def __contains__(self, number: int) -> bool:
        return number in self._known

    def learn(self, number: int, data: BytesLike, buffers: list[memoryview]) -> None:
        """Remember a pickled function.  Unpickling may raise any error.

        The function may be any object.  If it cannot be called, the first task fails.
        """
        copies = _Copies(bytes(data), buffers)
        function = copies.unpickle()
        self._known[number] = function if _is_constant(function) else copies.with_spare(function)
        if len(self._known) > FUNCTIONS:
            self._known.popitem(last=False)

    def get(self, number: int, chunk: int, *, eager: bool) -> Function:
        """Return the function for the next batch, whose chunks have ``chunk`` tasks each.

        ``eager``: the chunks have one task each because the user asked for that.
        """
        known = self._known[number]
        if not isinstance(known, _Copies):
            return known
        if chunk == 1 and not eager and known.size > LARGE:
            return known.take()
        return _FreshForEachChunk(known, chunk)


class _Copies:
    """Pickled function that can be unpickled again and again."""

    def __init__(self, data: bytes, buffers: list[memoryview]) -> None:
        self._data = data
        self._buffers = buffers
        self._shared: list[Any] = []
        """Objects that all copies have in common."""
        self._spare: list[Function] = []
        """Copy that no task has had yet; empty if there is none."""
        self.size = len(data) + sum(buffer.nbytes for buffer in buffers)

    def with_spare(self, function: Function) -> _Copies:
        """Keep a copy for the first task, and what later ones have in common with it."""
        if any(name.encode() in self._data for name in _SHARING):
            # An object that pickles only in the program has its own queues and locks in each copy.
            with contextlib.suppress(Exception):
                self._data, self._shared = _pickled_beside_shared(function)
                self._buffers = []
        self._spare.append(function)
        return self

    def take(self) -> Function:
        """Return a copy that no task has had."""
        return self._spare.pop() if self._spare else self.unpickle()

    def unpickle(self) -> Function:
        """Return a new copy.  It shares no memory that a task can change with another one."""
        buffers = map(_own, self._buffers)
        function: Function = _Unpickler(self._data, buffers, self._shared).load()
        return function


class _Pickler(pickle.Pickler):
    """Pickler that leaves shared objects and definitions out, and keeps them in a list."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, protocol=5)
        self.shared: list[Any] = []

    def persistent_id(self, obj: Any) -> int | None:
        """Return the number of an object to leave out; None for another one."""
        if not isinstance(obj, _DEFINITIONS) and not _is_shared(obj):
            return None
        self.shared.append(obj)
        return len(self.shared) - 1


class _Unpickler(pickle.Unpickler):
    """Unpickler of what ``_Pickler`` has written, or another pickler."""

    def __init__(self, data: bytes, buffers: Iterable[Any], shared: list[Any]) -> None:
        super().__init__(io.BytesIO(data), buffers=buffers)
        self._shared = shared

    def persistent_load(self, pid: Any) -> Any:
        """Return the object that the pickler left out."""
        return self._shared[pid]


def _pickled_beside_shared(function: Function) -> tuple[bytes, list[Any]]:
    file = io.BytesIO()
    pickler = _Pickler(file)
    pickler.dump(function)
    return file.getvalue(), pickler.shared


class _FreshForEachChunk:
    """Function that is unpickled anew for each chunk of a batch."""

    def __init__(self, copies: _Copies, chunk: int) -> None:
        self._copies = copies
        self._chunk = chunk
        self._left = 0

    def __call__(self, *args: Any) -> Any:
        if not self._left:
            self._function = self._copies.take()
            self._left = self._chunk
        self._left -= 1
        return self._function(*args)


def _own(buffer: memoryview) -> memoryview | bytearray:
    return buffer if buffer.readonly else bytearray(buffer)


def _is_constant(value: Any) -> bool:
    """Return whether nothing in ``value`` can be changed, except what its module holds."""
    kind = type(value)
    if kind in _CONSTANTS or isinstance(value, _DEFINITIONS) or _is_shared(value):
        return True
    if kind is BuiltinFunctionType or kind is MethodType:
        return value.__self__ is None or isinstance(value.__self__, type | ModuleType)
    if kind is partial:
        return not vars(value) and _are_constant(
            (value.func, *value.args, *value.keywords.values())
        )
    return kind is tuple and _are_constant(value)


def _are_constant(values: Iterable[Any]) -> bool:
    return all(map(_is_constant, values))


def _is_shared(value: Any) -> bool:
    """Return whether ``value`` stands for something that all processes share."""
    if hasattr(type(value), "_b_base_"):  # an object of ctypes, perhaps in shared memory
        return hasattr(value, "_wrapper")
    return _stands_for_shared(cast("Hashable", type(value)))  # mypy doubts it


@cache
def _stands_for_shared(kind: Any) -> bool:
    modules = {base.__module__ for base in kind.__mro__}
    return any(
        module == name or module.startswith(f"{name}.") for module in modules for name in _SHARING
    )
