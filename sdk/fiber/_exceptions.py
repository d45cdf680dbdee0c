"""Exceptions that are stored and raised later, or that no caller catches."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from types import BuiltinFunctionType, GetSetDescriptorType, MemberDescriptorType
from typing import Any, TypeVar

_E = TypeVar("_E", bound=BaseException)


def fresh(error: _E) -> _E:
    """Return a copy of a stored exception, to be raised in its place.

    Raising an exception adds frames to its traceback, and they stay.  A stored exception that is
    raised at every call would keep the frames of all callers alive, with everything in them.

    The copy has the class, arguments, attributes, notes, cause, context and traceback of ``error``.
    No code of its class runs, so the copy can be made on any thread.
    """
    try:
        return _copy(error)
    except Exception:  # A class from native code that Python cannot copy.
        return error


def _copy(error: _E) -> _E:
    kind = type(error)
    # A group is made with what it holds; other fields can be set later.
    group = (error.message, error.exceptions) if isinstance(error, BaseExceptionGroup) else ()
    copy: _E = _constructor(kind)(kind, *group)
    for field in _fields(kind):
        value = _value(field, error)
        # A native field that was never set reads as None, but setting it to None counts.
        if value is not _value(field, copy):
            with contextlib.suppress(AttributeError):  # read-only
                field.__set__(copy, value)
    attributes = dict(vars(error))
    if isinstance(notes := attributes.get("__notes__"), list):
        attributes["__notes__"] = list(notes)  # Notes that a caller adds are for that caller.
    vars(copy).update(attributes)
    for name in ("args", "__cause__", "__context__", "__suppress_context__", "__traceback__"):
        object.__setattr__(copy, name, getattr(error, name))
    return copy


def _constructor(kind: type[BaseException]) -> Callable[..., Any]:
    """Return the ``__new__`` of the class's native base, which knows its fields."""
    found = (vars(base).get("__new__") for base in kind.__mro__)
    return next(new for new in found if isinstance(new, BuiltinFunctionType))


def _value(field: Any, error: BaseException) -> Any:
    """Return the value of a field, and the field itself where there is none."""
    try:
        return field.__get__(error)
    except AttributeError:
        return field


def _fields(kind: type[BaseException]) -> Iterator[Any]:
    """List the descriptors of what is not in the instance's dictionary."""
    for base in kind.__mro__:
        for name, found in vars(base).items():
            is_field = isinstance(found, MemberDescriptorType | GetSetDescriptorType)
            if is_field and not name.startswith("__"):
                yield found


def report_uncaught() -> None:
    """Pass the exception being handled to ``sys.excepthook``, on a thread that has to go on.

    The hook is the program's.  If it raises, the interpreter's own hook shows both exceptions.  If
    it calls ``sys.exit()``, that has no effect, as on every thread but the main one.
    """
    try:
        sys.excepthook(*sys.exc_info())
    except SystemExit:
        pass
    except BaseException:
        with contextlib.suppress(BaseException):  # stderr may be closed
            sys.__excepthook__(*sys.exc_info())
