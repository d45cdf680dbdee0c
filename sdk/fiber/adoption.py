"""`fiber.adopt`: run a library that was written for multiprocessing, and cannot be edited.

A function finds its globals in the namespace of its module at each call, so rebinding the
names there is enough, and touches nobody else. What Python evaluated when the module was
imported (base classes, default values, class attributes, objects that were made then) is out
of reach. It is looked for and refused, where it belongs to a class or function of the module
or to the module itself; inside of containers and closures it is not found.
"""

from __future__ import annotations

import functools
import importlib
import multiprocessing
import sys
import threading
import weakref
from collections.abc import Iterator
from dataclasses import dataclass, field
from multiprocessing.context import BaseContext, DefaultContext
from multiprocessing.process import BaseProcess
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType, TracebackType
from typing import Any, NamedTuple

from fiber.errors import AdoptionError

__all__ = ["Adoption", "adopt"]


def adopt(module: str | ModuleType) -> Adoption:
    """Rebind what one module took from multiprocessing to Fiber's equivalents.

    `module` is a module or its name, which is imported if need be. Every name in it that is
    bound to the multiprocessing package, one of its submodules, or a class, function or
    context from there is bound to what Fiber has in its place. All or nothing: if a name has
    no equivalent, AdoptionError says which and the module is left as it was. Adopting a
    module again changes nothing more.

    The effect lasts as long as the program, or, used as a context manager, until the block
    ends. It is this process's: a child that imports the module anew has the original.
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
        """The names in the module that are bound to Fiber's objects now."""
        with _lock:
            state = _states.get(self.module)
            return tuple(sorted(state.bindings)) if state else ()

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
            state = _states.get(self.module) or _State()
            # Again even if adopted already: a reload of the module undoes it.
            bindings = _plan(self.module, self._fiber, adopted=bool(state.holders))
            state.bindings.update(bindings)
            state.holders += 1
            _states[self.module] = state
            self._held = True
            for name, binding in bindings.items():
                setattr(self.module, name, binding.new)

    def _release(self) -> None:
        with _lock:
            if not self._held:
                return
            self._held = False
            state = _states[self.module]
            state.holders -= 1
            if state.holders:
                return
            del _states[self.module]
            for name, binding in state.bindings.items():
                # What somebody else has bound since is theirs.
                if vars(self.module).get(name) is binding.new:
                    setattr(self.module, name, binding.old)


class _Binding(NamedTuple):
    old: object
    new: object


@dataclass
class _State:
    """What is in effect in one module, and how many Adoptions want it to be."""

    bindings: dict[str, _Binding] = field(default_factory=dict)
    holders: int = 0


_lock = threading.RLock()  # importing Fiber's submodules may run code that adopts
_states: weakref.WeakKeyDictionary[ModuleType, _State] = weakref.WeakKeyDictionary()


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


def _plan(module: ModuleType, fiber: Any, *, adopted: bool) -> dict[str, _Binding]:
    """What to rebind in the module, or AdoptionError with everything that is in the way."""
    bindings: dict[str, _Binding] = {}
    problems: list[str] = []
    uses_any = adopted
    for name, value in list(vars(module).items()):
        if taken := _taken(value):
            uses_any = True
            try:
                new = _equivalent(value, taken, fiber)
            except LookupError:
                problems.append(f"{name!r} is {taken}, for which Fiber has no equivalent")
            else:
                if new is not value:
                    bindings[name] = _Binding(value, new)
        else:
            problems += _fixed_at_import(module, name, value, fiber)
    if problems:
        raise AdoptionError(_refusal(module, problems))
    if not uses_any:
        raise AdoptionError(_nothing_taken(module))
    return bindings


def _taken(value: object) -> str | None:
    """The full name of what was taken from multiprocessing; None if the value was not."""
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
    # multiprocessing.dummy is about threads, which need nothing from Fiber.
    is_taken = top == "multiprocessing" and rest.partition(".")[0] != "dummy"
    return origin if is_taken else None


def _context_name(context: BaseContext) -> str | None:
    if not _taken(type(context)):
        return None  # Fiber's, or somebody's own
    method = _start_method(context)
    return f"multiprocessing.get_context({method!r})" if method else "multiprocessing"


def _start_method(context: BaseContext) -> str | None:
    return None if isinstance(context, DefaultContext) else context.get_start_method()


def _equivalent(value: Any, taken: str, fiber: Any) -> object:
    """What Fiber has in the place of the value; LookupError if nothing."""
    try:
        if isinstance(value, BaseContext):
            return fiber.get_context(_start_method(value))
        if isinstance(value, MethodType):
            context: Any = value.__self__
            method = _start_method(context)
            return getattr(fiber.get_context(method) if method else fiber, value.__name__)
        # Process lives in multiprocessing.context, but everybody knows it by this name.
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
    """What stays multiprocessing's where a value cannot be rebound; None if nothing does."""
    if taken := _taken(value):
        return None if _is_shared(value, taken, fiber) else taken
    kind = type(value)
    # Fiber's current_process() and its authkey are multiprocessing's.
    if not (taken := _taken(kind)) or issubclass(kind, BaseProcess | bytes):
        return None
    return None if _is_shared(kind, taken, fiber) else f"an object of {taken}"


def _fixed_at_import(module: ModuleType, name: str, value: object, fiber: Any) -> Iterator[str]:
    """What was decided when the module was imported, inside of a value that was not taken."""
    if isinstance(value, FunctionType):
        if value.__module__ == module.__name__:
            yield from _fixed_in_function(name, value, fiber)
    elif isinstance(value, type):
        if value.__module__ == module.__name__:
            yield from _fixed_in_class(name, value, fiber)
    elif left := _leftover(value, fiber):
        yield f"{name!r} holds {left}, made when the module was imported"


def _fixed_in_class(name: str, cls: type, fiber: Any) -> Iterator[str]:
    for base in cls.__bases__:
        if left := _leftover(base, fiber):
            yield f"class {name!r} has the base {left}"
    for attribute, value in vars(cls).items():
        inner = value.__func__ if isinstance(value, staticmethod | classmethod) else value
        if left := _leftover(inner, fiber):
            yield f"class attribute {name + '.' + attribute!r} is {left}"
        elif isinstance(inner, FunctionType):
            yield from _fixed_in_function(f"{name}.{attribute}", inner, fiber)


def _fixed_in_function(name: str, function: FunctionType, fiber: Any) -> Iterator[str]:
    for default in (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()):
        if left := _leftover(default, fiber):
            yield f"function {name!r} has the default value {left}"


# ---- explaining -----------------------------------------------------------------------------


def _refusal(module: ModuleType, problems: list[str]) -> str:
    lines = "".join(f"\n  - {problem}" for problem in problems)
    return (
        f"cannot adopt {module.__name__!r}, which was left as it is:{lines}\n"
        "fiber.adopt() can only rebind names of the module to what Fiber has. What to do: put "
        "something of your own in these places before it, which will be left alone, or let "
        "the module stay on multiprocessing."
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
        f"Name the very module that imports it.{hint}"
    )
