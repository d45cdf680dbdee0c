"""Exceptions that are stored and raised later, or that no caller catches."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping
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


def add_note(error: BaseException, note: str) -> None:
    """Add a note, also to a frozen dataclass, whose ``add_note`` raises."""
    vars(error)["__notes__"] = [*(getattr(error, "__notes__", None) or ()), note]


def _copy(error: _E) -> _E:
    copy = make(type(error), group_of(error))
    set_fields(copy, fields_of(error))
    attributes = dict(vars(error))
    if isinstance(notes := attributes.get("__notes__"), list):
        attributes["__notes__"] = list(notes)  # Notes that a caller adds are for that caller.
    vars(copy).update(attributes)
    for name in ("args", "__cause__", "__context__", "__suppress_context__", "__traceback__"):
        object.__setattr__(copy, name, getattr(error, name))
    return copy


def make(kind: type[_E], group: tuple[Any, ...]) -> _E:
    """Make an exception that has neither arguments nor fields, without running code of its class.

    ``group`` is what ``group_of`` returned.
    """
    made: _E = _constructor(kind)(kind, *group)
    return made


def group_of(error: BaseException) -> tuple[Any, ...]:
    """Return what a group is made with: other fields can be set later."""
    return (error.message, error.exceptions) if isinstance(error, BaseExceptionGroup) else ()


def fields_of(error: BaseException) -> dict[str, Any]:
    """Return what is not in the instance's dictionary: slots, and what native code keeps."""
    found: dict[str, Any] = {}
    for field in _fields(type(error)):
        value = _value(field, error)
        if value is not field:
            found.setdefault(field.__name__, value)
    return found


def set_fields(error: BaseException, values: Mapping[str, Any]) -> None:
    """Give an exception that was just made its fields."""
    for field in _fields(type(error)):
        # A native field that was never set reads as None, but setting it to None counts.
        if field.__name__ in values and values[field.__name__] is not _value(field, error):
            with contextlib.suppress(AttributeError):  # read-only
                field.__set__(error, values[field.__name__])


def _constructor(kind: type[BaseException]) -> Callable[..., Any]:
    """Return the ``__new__`` of the class's native base, which knows its fields."""
    base: Any = kind
    # Of several bases ``__base__`` is the one whose fields the instance has.
    while not isinstance(new := vars(base).get("__new__"), BuiltinFunctionType):
        base = base.__base__
    return new


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
