"""Short forms of tasks' arguments, for monitors.  No code of the user runs for them."""

from __future__ import annotations

import contextlib
import io
import itertools
import pickle
import reprlib
from collections.abc import Iterator, Sequence
from typing import Any

from fiber._wire import work

_LARGEST = 1 << 12
"""Bytes of the largest pickle that is looked into."""

_MOST = 6
"""Arguments of a call that its short form has."""


def short_form(item: Any) -> str:
    """Return the short form of an item, if its repr runs none of the user's code; else nothing."""
    if work.is_plain([item]):
        with contextlib.suppress(ValueError):  # Python writes no number of thousands of digits
            return reprlib.repr(item)
    return ""


def short_form_of_call(data: bytes, buffers: Sequence[memoryview]) -> str:
    """Return the short form of the arguments of a pickled call, as in ``5, label='a'``.

    An object that is no plain value is shown as ``<its class>``.  The result is empty for a large
    pickle, and for objects that pickle in unusual ways.
    """
    if len(data) > _LARGEST:
        return ""
    # Pickles are programs, and a program of any kind may fail with stand-ins for its objects.
    with contextlib.suppress(Exception):
        _, args, kwargs = _PlainUnpickler(io.BytesIO(data), buffers=buffers).load()
        forms = list(itertools.islice(_forms(args, kwargs), _MOST + 1))
        return ", ".join(forms[:_MOST] + ["..."] * (len(forms) > _MOST))
    return ""


def _forms(args: Any, kwargs: Any) -> Iterator[str]:
    for value in args:
        yield reprlib.repr(value)
    for key, value in kwargs.items():
        yield f"{key}={reprlib.repr(value)}"


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

    def __repr__(cls) -> str:
        return cls.__name__


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
