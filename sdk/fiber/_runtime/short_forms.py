"""Short forms of tasks' arguments, for monitors.

They are made on the loop thread, so each takes little time: a form has a few parts of a value, and
no code of the user runs for it.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import pickle
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

_LARGEST_PICKLE = 1 << 12
"""Bytes of the largest pickle that is looked into."""

_PARTS = 30
"""Values in a short form, those inside of others included."""

_ITEMS = 6
"""Items of a list, a call or another container that a short form shows."""

_CHARACTERS = 40
"""Characters of a text that a short form shows."""

_BITS = 256
"""Bits of the largest number that is written out."""

_MORE = "..."

_BRACKETS: dict[type, tuple[str, str]] = {
    list: ("[", "]"),
    tuple: ("(", ")"),
    set: ("{", "}"),
    frozenset: ("{", "}"),
    dict: ("{", "}"),
}

_name_of = type.__dict__["__name__"].__get__
"""Return the name of a class.  A metaclass cannot replace it."""


def short_form(item: Any) -> str:
    """Return the short form of an item; an object that is no plain value is ``<its class>``."""
    return _Writer().form(item)


def short_form_of_call(data: bytes, buffers: Sequence[memoryview]) -> str:
    """Return the short form of the arguments of a pickled call, as in ``5, label='a'``.

    The result is empty for a large pickle, and for objects that pickle in unusual ways.
    """
    if len(data) > _LARGEST_PICKLE:
        return ""
    # A pickle is a program, and may fail with stand-ins for its objects.
    with contextlib.suppress(Exception):
        _, args, kwargs = _PlainUnpickler(io.BytesIO(data), buffers=buffers).load()
        return _Writer().arguments(args, kwargs)
    return ""


class _Writer:
    """Writer of one short form.  Its parts are counted, so that shared lists take no longer."""

    def __init__(self) -> None:
        self._left = _PARTS

    def arguments(self, args: Iterable[Any], kwargs: dict[str, Any]) -> str:
        """Return the form of the arguments of a call."""
        named = (f"{key}={self.form(value)}" for key, value in kwargs.items())
        return self._joined(itertools.chain(map(self.form, args), named))

    def form(self, value: Any) -> str:
        """Return the form of a value."""
        self._left -= 1
        kind = type(value)
        if kind in (bool, float, complex, type(None), range):
            return repr(value)
        if kind is int:
            bits = value.bit_length()
            return repr(value) if bits <= _BITS else f"<int of {bits:,} bits>"
        if kind in (str, bytes):
            short = value[:_CHARACTERS]
            return repr(short) + (_MORE if len(short) < len(value) else "")
        if kind in _BRACKETS:
            return self._container(value, kind)
        if isinstance(value, _StandIn):
            return repr(value)
        return _name_of(value) if isinstance(value, type) else f"<{_name_of(kind)}>"

    def _container(self, value: Any, kind: type) -> str:
        left, right = _BRACKETS[kind]
        forms: Iterator[str] = map(self.form, value)
        if kind is dict:
            forms = (f"{self.form(key)}: {self.form(each)}" for key, each in value.items())
        inside = self._joined(forms)
        comma = "," if kind is tuple and len(value) == 1 else ""
        return f"{left}{inside}{comma}{right}"

    def _joined(self, forms: Iterator[str]) -> str:
        """Return the first forms; another value changed by a thread of the user ends them."""
        shown: list[str] = []
        with contextlib.suppress(RuntimeError):
            while self._left > 0 and (form := next(forms, None)) is not None:
                if len(shown) == _ITEMS:
                    return ", ".join([*shown, _MORE])
                shown.append(form)
        return ", ".join([*shown, _MORE] if self._left <= 0 else shown)


class _PlainUnpickler(pickle.Unpickler):
    """Unpickler that makes plain values alone, and stand-ins for all other objects."""

    def find_class(self, module: str, name: str) -> Any:
        """Return a stand-in for a class or function, without importing it."""
        about = {"package": module.partition(".")[0]}
        return _StandInType(name.rpartition(".")[2], (_StandIn,), about)

    def persistent_load(self, pid: Any) -> Any:
        """Return a stand-in for an object that travels beside the pickle."""
        return _StandIn()


class _StandInType(type):
    """Class or function that was not imported."""


class _StandIn(metaclass=_StandInType):
    """Object in place of one whose class is not known here.  It takes any contents."""

    package = ""

    def __new__(cls, *args: Any, **kwargs: Any) -> _StandIn:
        made = super().__new__(cls)
        if not cls.__name__.startswith("_"):
            made.shown = cls.__name__
        elif args and isinstance(args[0], _StandInType):
            # Private functions rebuild objects, and most get the class first.
            made.shown = args[0].__name__
        else:
            made.shown = f"{cls.package} object".lstrip()
        return made

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.shown: str

    def __setstate__(self, state: Any) -> None: ...

    def __setitem__(self, key: Any, value: Any) -> None: ...

    def append(self, item: Any) -> None:
        """Take an item of a list."""

    def __repr__(self) -> str:
        return f"<{self.shown}>"
