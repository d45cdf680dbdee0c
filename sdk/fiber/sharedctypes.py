"""``Value``, ``Array`` and their raw forms: ctypes objects in memory that processes share.

The classes are multiprocessing's.  The memory has no name and no file, is freed with its last user,
and is not bounded by the size of ``/dev/shm``.  The objects pickle at any time, and not only while
a process is started: through a queue, as a task's argument, to another host.
"""

from __future__ import annotations

import copyreg
import ctypes
from collections.abc import Sequence
from multiprocessing import sharedctypes as mp_sharedctypes
from multiprocessing.reduction import ForkingPickler
from multiprocessing.sharedctypes import (
    Synchronized,
    SynchronizedArray,
    SynchronizedBase,
    SynchronizedString,
)
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar, overload

from fiber import synchronize
from fiber._hub import shared_blocks
from fiber._hub.shared_blocks import SharedBuffer

if TYPE_CHECKING:
    from _ctypes import _CData
    from ctypes import _SimpleCData, c_char

    from fiber.synchronize import LockLike

    Locked: TypeAlias = Literal[True] | LockLike
    """Values of ``lock=`` for an object with a lock."""
    Size: TypeAlias = int | Sequence[Any]
    """Number of elements of an array, or their values."""

    _CT = TypeVar("_CT", bound=_CData)
_T = TypeVar("_T")

__all__ = [
    "Array",
    "RawArray",
    "RawValue",
    "Synchronized",
    "SynchronizedArray",
    "SynchronizedBase",
    "SynchronizedString",
    "Value",
    "copy",
    "synchronized",
    "typecode_to_type",
]

typecode_to_type: dict[str, type] = mp_sharedctypes.typecode_to_type  # type: ignore[attr-defined]


@overload
def RawValue(typecode_or_type: type[_CT], *args: Any) -> _CT: ...


@overload
def RawValue(typecode_or_type: str, *args: Any) -> Any: ...


def RawValue(typecode_or_type: Any, *args: Any) -> Any:
    """Return a ctypes object in shared memory, made as ``type(*args)``.  It has no lock."""
    value = _new(_type(typecode_or_type))
    value.__init__(*args)
    return value


@overload
def RawArray(typecode_or_type: type[_CT], size_or_initializer: Size) -> ctypes.Array[_CT]: ...


@overload
def RawArray(typecode_or_type: str, size_or_initializer: Size) -> Any: ...


def RawArray(typecode_or_type: Any, size_or_initializer: Size) -> Any:
    """Return a ctypes array in shared memory, of zeros or of given values.  It has no lock."""
    element = _type(typecode_or_type)
    if isinstance(size_or_initializer, int):
        return _new(element * size_or_initializer)
    array = _new(element * len(size_or_initializer))
    array.__init__(*size_or_initializer)
    return array


@overload
def Value(
    typecode_or_type: type[_SimpleCData[_T]], *args: Any, lock: Locked = True, ctx: Any = None
) -> Synchronized[_T]: ...


@overload
def Value(
    typecode_or_type: type[_CT], *args: Any, lock: Literal[False], ctx: Any = None
) -> _CT: ...


@overload
def Value(
    typecode_or_type: type[_CT], *args: Any, lock: Locked = True, ctx: Any = None
) -> SynchronizedBase[_CT]: ...


@overload
def Value(
    typecode_or_type: str, *args: Any, lock: Locked = True, ctx: Any = None
) -> Synchronized[Any]: ...


@overload
def Value(
    typecode_or_type: str | type[_CData], *args: Any, lock: Locked | bool = True, ctx: Any = None
) -> Any: ...


def Value(typecode_or_type: Any, *args: Any, lock: Any = True, ctx: Any = None) -> Any:
    """Return a ctypes object in shared memory, with a lock.

    ``lock``: True for a new ``RLock``, an existing lock, or False for none, as ``RawValue``.
    """
    return _guarded(RawValue(typecode_or_type, *args), lock)


@overload
def Array(
    typecode_or_type: type[_CT],
    size_or_initializer: Size,
    *,
    lock: Literal[False],
    ctx: Any = None,
) -> ctypes.Array[_CT]: ...


@overload
def Array(
    typecode_or_type: type[c_char],
    size_or_initializer: Size,
    *,
    lock: Locked = True,
    ctx: Any = None,
) -> SynchronizedString: ...


@overload
def Array(
    typecode_or_type: type[_SimpleCData[_T]],
    size_or_initializer: Size,
    *,
    lock: Locked = True,
    ctx: Any = None,
) -> SynchronizedArray[_T]: ...


@overload
def Array(
    typecode_or_type: str,
    size_or_initializer: Size,
    *,
    lock: Locked = True,
    ctx: Any = None,
) -> SynchronizedArray[Any]: ...


@overload
def Array(
    typecode_or_type: str | type[_CData],
    size_or_initializer: Size,
    *,
    lock: Locked | bool = True,
    ctx: Any = None,
) -> Any: ...


def Array(
    typecode_or_type: Any,
    size_or_initializer: Size,
    *,
    lock: Any = True,
    ctx: Any = None,
) -> Any:
    """Return a ctypes array in shared memory, with a lock.

    ``lock``: True for a new ``RLock``, an existing lock, or False for none, as ``RawArray``.
    """
    return _guarded(RawArray(typecode_or_type, size_or_initializer), lock)


def copy(obj: _CT) -> _CT:
    """Return a copy of a ctypes object, in shared memory."""
    new: _CT = _new(type(obj))
    ctypes.pointer(new)[0] = obj
    return new


@overload
def synchronized(
    obj: _SimpleCData[_T], lock: LockLike | None = None, ctx: Any = None
) -> Synchronized[_T]: ...


@overload
def synchronized(
    obj: ctypes.Array[c_char], lock: LockLike | None = None, ctx: Any = None
) -> SynchronizedString: ...


@overload
def synchronized(
    obj: ctypes.Array[_SimpleCData[_T]], lock: LockLike | None = None, ctx: Any = None
) -> SynchronizedArray[_T]: ...


@overload
def synchronized(
    obj: _CT, lock: LockLike | None = None, ctx: Any = None
) -> SynchronizedBase[_CT]: ...


def synchronized(obj: Any, lock: Any = None, ctx: Any = None) -> Any:
    """Return a ctypes object with a lock: ``lock``, or a new ``RLock``."""
    guard: Any = synchronize.RLock() if lock is None else lock
    wrapper = mp_sharedctypes.synchronized(obj, guard, ctx=synchronize)
    copyreg.pickle(type(wrapper), _reduce_synchronized)
    return wrapper


def _guarded(obj: Any, lock: Any) -> Any:
    if lock is False:
        return obj
    if lock is True:
        lock = None
    if lock is not None and not hasattr(lock, "acquire"):
        raise AttributeError(f"{lock!r} has no method 'acquire'")
    return synchronized(obj, lock)


def _type(typecode_or_type: Any) -> Any:
    return typecode_to_type.get(typecode_or_type, typecode_or_type)


def _new(type_: Any) -> Any:
    return _placed(type_, shared_blocks.create_buffer(ctypes.sizeof(type_)))


def _placed(type_: Any, buffer: SharedBuffer) -> Any:
    # multiprocessing registers the types of its objects here, perhaps the same type.
    ForkingPickler.register(type_, _reduce_ctype)
    copyreg.pickle(type_, _reduce_ctype)
    obj = type_.from_buffer(buffer.view)
    obj._wrapper = buffer
    return obj


# Pickling


def _reduce_ctype(obj: Any) -> tuple[Any, ...]:
    buffer = getattr(obj, "_wrapper", None)
    if not isinstance(buffer, SharedBuffer):  # multiprocessing's, of the same type
        reduced: tuple[Any, ...] = (
            obj.__reduce__() if buffer is None else mp_sharedctypes.reduce_ctype(obj)  # type: ignore[attr-defined]
        )
        return reduced
    if isinstance(obj, ctypes.Array):
        return _rebuild, (obj._type_, obj._length_, buffer)
    return _rebuild, (type(obj), None, buffer)


def _rebuild(type_: Any, length: int | None, buffer: SharedBuffer) -> Any:
    return _placed(type_ if length is None else type_ * length, buffer)


def _reduce_synchronized(wrapper: Any) -> tuple[Any, ...]:
    if isinstance(getattr(wrapper._obj, "_wrapper", None), SharedBuffer):
        return synchronized, (wrapper._obj, wrapper._lock)
    reduced: tuple[Any, ...] = wrapper.__reduce__()
    return reduced
