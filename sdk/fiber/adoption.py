"""`fiber.adopt`: run a library that was written for multiprocessing and that you cannot edit.

A function looks up its globals in the namespace of its module at each call. So it is enough to
rebind the names there, and no other module changes. Default values of the module's functions and
attributes of its classes are rebound, too. Other objects that Python evaluated when the module was
imported, such as base classes, cannot be rebound. They are refused if they belong to the module, or
to one of its classes or functions. Inside of containers and closures they are not found.
"""

from __future__ import annotations

import functools
import importlib
import multiprocessing
import sys
import threading
import weakref
from dataclasses import dataclass, field
from multiprocessing.context import BaseContext, DefaultContext
from multiprocessing.process import BaseProcess
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType, TracebackType
from typing import Any, NamedTuple, Protocol

from fiber.errors import AdoptionError

__all__ = ["Adoption", "adopt"]


def adopt(module: str | ModuleType) -> Adoption:
    """Rebind the names that one module took from multiprocessing to Fiber's equivalents.

    `module` is a module or its name, which is imported if necessary. Names that are bound to
    the multiprocessing package, to one of its submodules, or to its classes, functions and
    contexts are bound to Fiber's. So are default values of its functions and attributes of its
    classes. If one has no equivalent, AdoptionError names it, and the module stays unchanged.
    Adopting a module again has no further effect.

    The effect lasts until the program ends. As a context manager, it lasts until the block ends.
    It holds in this process: a child that imports the module again has the original.
    """
    return Adoption(_resolve(module), importlib.import_module("fiber"))


class Adoption:
    """A module's use of Fiber; as a context manager, it ends with the block."""

    def __init__(self, module: ModuleType, fiber: Any) -> None:
        self.module = module
        self._fiber = fiber
        self._held = False
        self._hold()

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the module that are bound to Fiber's objects now.

        Default values and class attributes have dotted names: `start.context`, `Worker.queue`.
        """
        with _lock:
            state = _adopted.get(self.module)
            return tuple(sorted({place.name for place in state.bindings})) if state else ()

    def __enter__(self) -> ModuleType:
        self._hold()
        return self.module

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._release()

    def __repr__(self) -> str:
        return f"<Adoption of {self.module.__name__!r}: {', '.join(self.names) or 'no names'}>"

    def _hold(self) -> None:
        with _lock:
            if self._held:
                return
            state = _adopted.get(self.module) or _AdoptedModule()
            # Again even if adopted already: a reload of the module undoes it.
            bindings = _plan(self.module, self._fiber, adopted=bool(state.holders))
            _rebind(self.module, bindings)
            state.bindings.update(bindings)
            state.holders += 1
            _adopted[self.module] = state
            self._held = True

    def _release(self) -> None:
        with _lock:
            if not self._held:
                return
            self._held = False
            state = _adopted[self.module]
            state.holders -= 1
            if state.holders:
                return
            del _adopted[self.module]
            for place, binding in state.bindings.items():
                # A name that other code has bound since stays.
                if place.read(self.module) is binding.new:
                    place.write(self.module, binding.old)


class _Reference(Protocol):
    """Name, default value or attribute of a module.  It does not refer to the module itself."""

    @property
    def name(self) -> str:
        """Name under which the module's code uses the object."""

    def read(self, module: ModuleType) -> object:
        """Return the object to which it refers now."""

    def write(self, module: ModuleType, value: object) -> None:
        """Make it refer to ``value``."""


@dataclass(frozen=True)
class _Name:
    """A name in the namespace of the module."""

    name: str

    def read(self, module: ModuleType) -> object:
        return vars(module).get(self.name)

    def write(self, module: ModuleType, value: object) -> None:
        setattr(module, self.name, value)


@dataclass(frozen=True)
class _ClassAttribute:
    name: str
    owner: type
    attribute: str

    def read(self, module: ModuleType) -> object:
        return vars(self.owner).get(self.attribute)

    def write(self, module: ModuleType, value: object) -> None:
        setattr(self.owner, self.attribute, value)


@dataclass(frozen=True)
class _Default:
    """The default value of a parameter."""

    name: str
    function: FunctionType
    index: int

    def read(self, module: ModuleType) -> object:
        return dict(enumerate(self.function.__defaults__ or ())).get(self.index)

    def write(self, module: ModuleType, value: object) -> None:
        defaults = list(self.function.__defaults__ or ())
        defaults[self.index] = value
        self.function.__defaults__ = tuple(defaults)


@dataclass(frozen=True)
class _KeywordDefault:
    """The default value of a keyword-only parameter."""

    name: str
    function: FunctionType
    parameter: str

    def read(self, module: ModuleType) -> object:
        return (self.function.__kwdefaults__ or {}).get(self.parameter)

    def write(self, module: ModuleType, value: object) -> None:
        defaults = self.function.__kwdefaults__ or {}
        self.function.__kwdefaults__ = {**defaults, self.parameter: value}


class _Binding(NamedTuple):
    old: object
    new: object


@dataclass
class _AdoptedModule:
    """Bindings in effect in one module, and the number of Adoptions that hold them."""

    bindings: dict[_Reference, _Binding] = field(default_factory=dict)
    holders: int = 0


_lock = threading.RLock()  # importing Fiber's submodules may run code that adopts
_adopted: weakref.WeakKeyDictionary[ModuleType, _AdoptedModule] = weakref.WeakKeyDictionary()


def _resolve(module: str | ModuleType) -> ModuleType:
    if isinstance(module, str):
        name = module
        try:
            module = importlib.import_module(name)
        except Exception as error:
            raise AdoptionError(
                f"cannot adopt {name!r}, its import fails: {type(error).__name__}: {error}. "
                "Check the name, and that the package is installed."
            ) from error
    if not isinstance(module, ModuleType):
        raise TypeError(f"fiber.adopt() takes a module or its name, not {module!r}")
    if module.__name__.partition(".")[0] in ("multiprocessing", "fiber"):
        raise AdoptionError(
            f"cannot adopt {module.__name__!r}: adopt the module that uses multiprocessing"
        )
    return module


# ---- deciding -------------------------------------------------------------------------------


def _plan(module: ModuleType, fiber: Any, *, adopted: bool) -> dict[_Reference, _Binding]:
    """Return the names to rebind in the module; AdoptionError with all problems."""
    survey = _Survey(module, fiber)
    if survey.problems:
        raise AdoptionError(_refusal(module, survey.problems))
    if not (survey.uses_any or adopted):
        raise AdoptionError(_nothing_taken(module))
    return survey.bindings


class _Survey:
    """Uses of multiprocessing in one module: places to rebind, and problems that prevent it."""

    def __init__(self, module: ModuleType, fiber: Any) -> None:
        self.bindings: dict[_Reference, _Binding] = {}
        self.problems: list[str] = []
        self.uses_any = False
        self._fiber = fiber
        self._module = module
        for name, value in list(vars(module).items()):
            if not self._take(_Name(name), value, repr(name)):
                self._look_into(name, value)

    def _take(
        self, place: _Reference, value: object, what: str, around: type[Any] | None = None
    ) -> bool:
        """Plan to rebind a name whose ``value``, inside of ``around``, is multiprocessing's.

        Return False if the value is not from multiprocessing.
        """
        if not (taken := _taken(value)):
            return False
        self.uses_any = True
        try:
            new = _equivalent(value, taken, self._fiber)
        except LookupError:
            self.problems.append(f"{what} is {taken}, for which Fiber has no equivalent")
        else:
            if new is not value:
                wrapped = new if around is None else around(new)
                self.bindings[place] = _Binding(place.read(self._module), wrapped)
        return True

    def _look_into(self, name: str, value: object) -> None:
        """Look for multiprocessing's objects that were evaluated at the import."""
        if isinstance(value, FunctionType):
            if value.__module__ == self._module.__name__:
                self._look_into_function(name, value)
        elif isinstance(value, type):
            if value.__module__ == self._module.__name__:
                self._look_into_class(name, value)
        elif left := _leftover(value, self._fiber):
            self.problems.append(f"{name!r} holds {left}, made when the module was imported")

    def _look_into_class(self, name: str, cls: type) -> None:
        for base in cls.__bases__:
            if left := _leftover(base, self._fiber):
                self.problems.append(f"class {name!r} has the base {left}")
        for attribute, value in list(vars(cls).items()):
            around = type(value) if isinstance(value, staticmethod | classmethod) else None
            inner = value if around is None else value.__func__
            full = f"{name}.{attribute}"
            what = f"class attribute {full!r}"
            if self._take(_ClassAttribute(full, cls, attribute), inner, what, around):
                continue
            if left := _leftover(inner, self._fiber):
                self.problems.append(f"{what} is {left}")
            elif isinstance(inner, FunctionType):
                self._look_into_function(full, inner)

    def _look_into_function(self, name: str, function: FunctionType) -> None:
        names = function.__code__.co_varnames[: function.__code__.co_argcount]
        defaults = function.__defaults__ or ()
        for index, (parameter, value) in enumerate(
            zip(names[-len(defaults) :], defaults, strict=False)
        ):
            self._take_default(name, _Default(f"{name}.{parameter}", function, index), value)
        for parameter, value in (function.__kwdefaults__ or {}).items():
            place = _KeywordDefault(f"{name}.{parameter}", function, parameter)
            self._take_default(name, place, value)
        wrapped = getattr(function, "__wrapped__", None)  # of a decorator, as singledispatch
        if isinstance(wrapped, FunctionType) and wrapped.__module__ == self._module.__name__:
            self._look_into_function(name, wrapped)

    def _take_default(self, name: str, place: _Reference, value: object) -> None:
        what = f"the default value of {place.name!r}"
        if not self._take(place, value, what) and (left := _leftover(value, self._fiber)):
            self.problems.append(f"function {name!r} has the default value {left}")


def _rebind(module: ModuleType, bindings: dict[_Reference, _Binding]) -> None:
    """Rebind all names or, if one cannot be written to, none."""
    done: list[_Reference] = []
    try:
        for place, binding in bindings.items():
            place.write(module, binding.new)
            done.append(place)
    except Exception as error:  # of a metaclass
        for before in done:
            before.write(module, bindings[before].old)
        problem = f"{place.name!r} cannot be rebound: {type(error).__name__}: {error}"
        raise AdoptionError(_refusal(module, [problem])) from error


def _taken(value: object) -> str | None:
    """Return the full name of a value of multiprocessing's; None for other values."""
    match value:
        case ModuleType():
            origin = value.__name__
        case BaseContext():
            return _context_name(value)
        case MethodType(__self__=BaseContext() as context):
            prefix = _context_name(context)
            return prefix and f"{prefix}.{value.__name__}"
        case type() | FunctionType() | BuiltinFunctionType():
            origin = f"{value.__module__}.{value.__qualname__}"
        case _:
            return None
    top, _, rest = origin.partition(".")
    # multiprocessing.dummy is about threads, which work without Fiber.
    is_taken = top == "multiprocessing" and rest.partition(".")[0] != "dummy"
    return origin if is_taken else None


def _context_name(context: BaseContext) -> str | None:
    if not _taken(type(context)):
        return None  # Fiber's, or the user's
    method = _start_method(context)
    return f"multiprocessing.get_context({method!r})" if method else "multiprocessing"


def _start_method(context: BaseContext) -> str | None:
    return None if isinstance(context, DefaultContext) else context.get_start_method()


def _equivalent(value: Any, taken: str, fiber: Any) -> object:
    """Return Fiber's equivalent of the value; LookupError if there is none."""
    try:
        if isinstance(value, BaseContext):
            return fiber.get_context(_start_method(value))
        if isinstance(value, MethodType):
            context: Any = value.__self__
            method = _start_method(context)
            return getattr(fiber.get_context(method) if method else fiber, value.__name__)
        # Process is defined in multiprocessing.context, but its usual name is this one.
        if not isinstance(value, ModuleType):
            name = value.__name__
            if getattr(multiprocessing, name, None) is value:
                return getattr(fiber, name)
        return functools.reduce(getattr, taken.split(".")[1:], fiber)
    except (AttributeError, ImportError, ValueError) as error:
        # ValueError: get_context() without this start method.
        raise LookupError(taken) from error


def _is_shared(value: object, taken: str, fiber: Any) -> bool:
    try:
        return _equivalent(value, taken, fiber) is value
    except LookupError:
        return False


def _leftover(value: object, fiber: Any) -> str | None:
    """Return the name of an object that would stay multiprocessing's; None for other objects."""
    if taken := _taken(value):
        return None if _is_shared(value, taken, fiber) else taken
    kind = type(value)
    # Fiber's current_process() and its authkey are multiprocessing's.
    if not (taken := _taken(kind)) or issubclass(kind, BaseProcess | bytes):
        return None
    return None if _is_shared(kind, taken, fiber) else f"an object of {taken}"


# ---- explaining -----------------------------------------------------------------------------


def _refusal(module: ModuleType, problems: list[str]) -> str:
    lines = "".join(f"\n  - {problem}" for problem in problems)
    return (
        f"cannot adopt {module.__name__!r}, which was left as it is:{lines}\n"
        "fiber.adopt() can only rebind names, default values and class attributes to Fiber's "
        "equivalents. Replace these objects by your own before you call it, or let the module "
        "stay on multiprocessing."
    )


def _nothing_taken(module: ModuleType) -> str:
    modules: list[tuple[str, object]] = list(sys.modules.items())  # None is a possible value
    inside = sorted(
        name
        for name, other in modules
        if name.startswith(f"{module.__name__}.")
        and isinstance(other, ModuleType)
        and any(map(_taken, list(vars(other).values())))
    )
    hint = f" These modules inside of it do: {', '.join(inside)}." if inside else ""
    return (
        f"cannot adopt {module.__name__!r}: none of its names comes from multiprocessing. "
        f"Name the module that imports it.{hint}"
    )
