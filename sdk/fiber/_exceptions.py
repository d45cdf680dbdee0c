"""Copies of stored exceptions, and reports of exceptions that no caller catches."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Callable, Mapping
from types import BuiltinFunctionType, GetSetDescriptorType, MemberDescriptorType
from typing import Any, TypeVar, cast
from weakref import WeakKeyDictionary

_E = TypeVar("_E", bound=BaseException)


def fresh(error: _E) -> _E:
    """Return a copy of a stored exception, to be raised in its place.

    Raising an exception adds frames to its traceback, and they stay.  A stored exception that is
    raised at every call would keep the frames of all callers alive, with everything in them.

    The copy has the class, arguments, attributes, notes, cause, context and traceback of ``error``.
    A group's copy has copies of its exceptions: a caller may raise one of them.  No code of its
    class runs, so the copy can be made on any thread.
    """
    copies: _Copies = {}
    try:
        copy = _make_copy(error, copies)
        for original, its_copy in copies.values():
            _fill(its_copy, original, copies)
    except Exception:  # A class from native code that Python cannot copy.
        return error
    return copy


def add_note(error: BaseException, note: str) -> None:
    """Add a note, also to a frozen dataclass, whose ``add_note`` raises."""
    vars(error)["__notes__"] = [*(getattr(error, "__notes__", None) or ()), note]


_LACKED_BY_MAIN = re.compile(r"\bmodule '__(mp_)?main__'")
"""Text of an unpickler's error about a name that the main module lacks."""


def advice_on_main(error: BaseException) -> str:
    """Return what to do if a worker's main module lacks a name; empty for other errors."""
    if type(error) is not AttributeError or not _LACKED_BY_MAIN.search(str(error)):
        return ""
    return (
        "Worker processes import the main module, and do not run the lines under "
        '`if __name__ == "__main__":`. If the function or class is defined there, move it above '
        "that line."
    )


_Copies = dict[int, tuple[BaseException, BaseException]]
"""Exceptions and their copies, by the identity of the exception."""


def _make_copy(error: _E, copies: _Copies) -> _E:
    """Make the copies of an exception and of those in it, all without their fields."""
    if id(error) not in copies:
        group = group_of(error)
        if group:
            message, members = group
            group = message, [_make_copy(member, copies) for member in members]
        copies[id(error)] = error, make(type(error), group)
    return cast(_E, copies[id(error)][1])


def _fill(copy: BaseException, error: BaseException, copies: _Copies) -> None:
    set_fields(copy, fields_of(error))
    attributes = dict(vars(error))
    if isinstance(notes := attributes.get("__notes__"), list):
        attributes["__notes__"] = list(notes)  # Notes that a caller adds are for that caller.
    vars(copy).update(attributes)
    for name in ("__cause__", "__context__", "__suppress_context__", "__traceback__"):
        object.__setattr__(copy, name, _copied(getattr(error, name), copies))
    args = error.args
    if isinstance(error, BaseExceptionGroup):  # The arguments have its exceptions, too.
        args = tuple(
            type(arg)(_copied(member, copies) for member in arg)
            if type(arg) in (list, tuple)
            else arg
            for arg in args
        )
    object.__setattr__(copy, "args", args)


def _copied(value: Any, copies: _Copies) -> Any:
    """Return the copy of an exception that has one, and anything else itself."""
    return copies[id(value)][1] if id(value) in copies else value


def make(kind: type[_E], group: tuple[Any, ...]) -> _E:
    """Make an exception that has neither arguments nor fields, without running code of its class.

    ``group`` is what ``group_of`` returned.
    """
    made: _E = _constructor(kind)(kind, *group)
    return made


def group_of(error: BaseException) -> tuple[Any, ...]:
    """Return the arguments that make a group: its other fields can be set later."""
    return (error.message, error.exceptions) if isinstance(error, BaseExceptionGroup) else ()


def fields_of(error: BaseException) -> dict[str, Any]:
    """Return the fields outside of the instance's dictionary: slots, and those of native code."""
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


def _fields(kind: type[BaseException]) -> tuple[Any, ...]:
    """Yield the descriptors of the fields outside of the instance's dictionary."""
    fields = _known_fields.get(kind)
    if fields is None:
        _known_fields[kind] = fields = tuple(
            found
            for base in kind.__mro__
            for name, found in vars(base).items()
            if isinstance(found, MemberDescriptorType | GetSetDescriptorType)
            and not name.startswith("__")
        )
    return fields


_known_fields: WeakKeyDictionary[type, tuple[Any, ...]] = WeakKeyDictionary()


def report_uncaught() -> None:
    """Pass the current exception to ``sys.excepthook``, on a thread that must go on.

    The hook is the program's.  If it raises, the interpreter's hook shows both exceptions.  If it
    calls ``sys.exit()``, that has no effect, as on every thread but the main one.
    """
    try:
        sys.excepthook(*sys.exc_info())
    except SystemExit:
        pass
    except BaseException:
        with contextlib.suppress(BaseException):  # stderr may be closed
            sys.__excepthook__(*sys.exc_info())
