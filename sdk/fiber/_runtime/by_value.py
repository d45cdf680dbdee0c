"""Functions that travel by value: their pickles, for as long as these stay the same.

A function of a session, a lambda or a nested function travels by value, with the values that it
reads: defaults, closure and globals.  cloudpickle takes much longer for that than a call.  So the
pickle is kept together with those values, and is used again while each of them is the same object.
Only values that cannot change themselves are compared in this way.  A function that reads others,
such as a list, an array or a class of the session, is pickled for each call.
"""

from __future__ import annotations

import itertools
import sys
import types
from collections.abc import Callable, Iterable, Iterator
from operator import is_
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

from fiber import reduction
from fiber._agent.by_value import FUNCTIONS, FunctionByValue
from fiber._wire import work

FUNCTION_SIZE = 1 << 16
"""Bytes of the largest pickle of a function that is kept, here and in a FunctionCache."""

_numbers = itertools.count()
"""Numbers of pickles.  Two functions with equal pickles are two functions in a worker, too."""


class FunctionPickles:
    """Pickles of functions that travel by value.  Runs on any thread."""

    def __init__(self) -> None:
        self._known: dict[FunctionType, _KnownFunction] = {}

    def light(self, function: Callable[..., Any]) -> Any:
        """Return what to pickle in place of ``function``: itself, or its pickle."""
        if type(function) is not FunctionType or not _goes_by_value(function):
            return function
        known = self._known.get(function)
        if known is not None and known.reads.are_same():
            return known.pickled
        return self._learn(function) or function

    def _learn(self, function: FunctionType) -> FunctionByValue | None:
        """Pickle ``function``; None if what it reads can change, or if it does not pickle."""
        self._known.pop(function, None)
        if (reads := _Reads.of(function)) is None:
            return None
        try:
            data = reduction.dumps_by_value(function)
        except Exception:  # pickling the whole call raises it again, and names the culprit
            return None
        if len(data) > FUNCTION_SIZE:
            return None
        if not reads.are_same():  # another thread changed a global meanwhile
            return None
        pickled = FunctionByValue(data, next(_numbers))
        if len(self._known) >= FUNCTIONS:
            self._known.clear()  # in one step, as several threads may call this
        self._known[function] = _KnownFunction(reads, pickled)
        return pickled


def _goes_by_value(function: FunctionType) -> bool:
    # Lambdas and nested functions have <lambda> and <locals> in their names.
    return "<" in function.__qualname__ or (
        function.__module__ == "__main__" and reduction.main_is_out_of_reach()
    )


class _KnownFunction(NamedTuple):
    reads: _Reads
    pickled: FunctionByValue


class _Reads(NamedTuple):
    """Values that functions had when they were pickled."""

    functions: tuple[_Function, ...]
    """The function, and the functions that it reaches and that go by value with it."""
    modules: int
    """Length of ``sys.modules``, if a package is read: its imported modules come along."""

    @classmethod
    def of(cls, function: FunctionType) -> _Reads | None:
        """Return what ``function`` reads; None if a value can change itself."""
        import cloudpickle

        if cloudpickle.list_registry_pickle_by_value():
            return None  # functions of those modules travel by value, too
        found: dict[FunctionType, _Function] = {}
        waiting: list[Any] = [function]
        modules = 0
        while waiting:
            value = waiting.pop()
            if type(value) is FunctionType and not _is_importable(value):
                if value not in found:
                    found[value] = each = _Function.of(value)
                    waiting += each.values
            elif type(value) is ModuleType and _is_imported(value):
                modules = len(sys.modules) if hasattr(value, "__path__") else modules
            elif not _is_constant(value):
                parts = _parts_of(value)
                if parts is None:
                    return None
                waiting += parts
        return cls(tuple(found.values()), modules)

    def are_same(self) -> bool:
        """Return whether all values are the same objects as before."""
        if self.modules and self.modules != len(sys.modules):
            return False
        return all(map(_Function.is_same, self.functions))


class _Function(NamedTuple):
    """A function, and the objects of which it consists or which it reads."""

    function: Any
    names: tuple[str, ...]
    """Names that may be those of globals."""
    values: list[object]

    @classmethod
    def of(cls, function: FunctionType) -> _Function:
        names = tuple(dict.fromkeys(_names_in(function.__code__)))
        return cls(function, names, _values_of(function, names))

    def is_same(self) -> bool:
        now = _values_of(self.function, self.names)
        return len(now) == len(self.values) and all(map(is_, now, self.values))


def _names_in(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if type(constant) is CodeType:
            yield from _names_in(constant)


class _Missing:
    """Value of a name that is no global, and of an empty cell."""


def _values_of(function: FunctionType, names: Iterable[str]) -> list[object]:
    found = function.__globals__
    values: list[object] = [found.get(name, _Missing) for name in names]
    values += (
        function.__code__,
        function.__defaults__,
        function.__module__,
        function.__name__,
        function.__qualname__,
        function.__doc__,
    )
    for fields in (function.__kwdefaults__, function.__annotations__, function.__dict__):
        if fields:
            values += fields
            values += fields.values()
    for cell in function.__closure__ or ():
        try:
            values.append(cell.cell_contents)
        except ValueError:
            values.append(_Missing)
    return values


def _is_constant(value: object) -> bool:
    """Return whether ``value`` never changes, or travels by reference."""
    kind = type(value)
    if kind in _CONSTANT or value is types.NoneType or work.is_plain_value(value):
        return True
    return isinstance(value, type | FunctionType | BuiltinFunctionType) and _is_importable(value)


_CONSTANT = frozenset({CodeType, range, type(...), type(NotImplemented)})


def _parts_of(value: Any) -> Iterable[Any] | None:
    """Return the parts of a value that changes only if they do; None if it may change itself."""
    if isinstance(value, type):  # of the session
        return None
    if type(value) in (tuple, frozenset):
        return tuple(value)
    annotation = isinstance(value, types.GenericAlias | types.UnionType)
    if annotation or type(value).__module__ == "typing":
        return (
            getattr(value, "__origin__", None),
            *getattr(value, "__args__", ()),
            *getattr(value, "__metadata__", ()),  # of Annotated
            getattr(value, "__bound__", None),  # of a TypeVar, as are its constraints
            *getattr(value, "__constraints__", ()),
        )
    return None


def _is_importable(value: Any) -> bool:
    """Return whether ``value`` travels by reference, as what its module calls so."""
    module = value.__module__
    if module == "__main__":
        return False
    found: Any = sys.modules.get(module)
    for part in value.__qualname__.split("."):
        found = getattr(found, part, None)
    return found is value


def _is_imported(module: ModuleType) -> bool:
    return module.__name__ != "__main__" and sys.modules.get(module.__name__) is module
