"""`fiber.meta`: what a function wishes from the machine that runs it."""

from __future__ import annotations

import functools
import math
import re
import sys
import types
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

__all__ = ["Resources", "largest", "merged", "meta", "resources_of", "wished", "with_resources"]

_ATTRIBUTE = "__fiber_meta__"
_RUN_BY_A_MANAGER = "_run_server"
"""What a manager's class has in multiprocessing: the function that is run in its process."""
_F = TypeVar("_F", bound=Callable[..., Any])


@dataclass(frozen=True, slots=True)
class Resources:
    """Wishes of a function; None is no wish."""

    cpu: float | None = None
    """CPUs, fractions allowed."""
    memory: int | None = None
    """Memory in MiB."""
    gpu: int | None = None
    """GPUs."""
    pool: str | None = None
    """The FiberPool whose pods are meant; None: one of the program's own."""


def meta(
    *,
    cpu: float | str | None = None,
    memory: int | str | None = None,
    gpu: int | None = None,
) -> Callable[[_F], _F]:
    """Give a function wishes for resources, heeded by backends that can grant them.

    `cpu` counts CPUs (2, 0.5, "500m"), `memory` is in MiB or has a unit (512, "512Mi",
    "2Gi"), `gpu` counts GPUs. The wishes are the returned function's alone: the one that was
    passed in stays as it was, so `small = fiber.meta(cpu=1)(f)` and `large =
    fiber.meta(cpu=8)(f)` may be used side by side. Wishes for a function that has some are
    added to them, the outer ones winning. What is returned behaves and pickles like the
    original.

    A manager's class may be given wishes too: they are those of the process that serves it.
    """
    wishes = wished("fiber.meta", cpu, memory, gpu)
    if wishes == Resources():
        raise TypeError("fiber.meta() needs at least one of cpu=, memory= and gpu=")

    def decorate(function: _F) -> _F:
        if isinstance(function, type) and hasattr(function, _RUN_BY_A_MANAGER):
            attributes = {_ATTRIBUTE: merged(resources_of(function), wishes)}
            for name in ("__module__", "__qualname__", "__doc__"):
                attributes[name] = getattr(function, name)
            return type(function)(function.__name__, (function,), attributes)
        if isinstance(function, type) or not callable(function):
            raise TypeError(
                f"fiber.meta() is for functions, not for {function!r}: "
                "decorate the function that is run, of a Process subclass its run() method"
            )
        result: _F = _attach(function, merged(resources_of(function), wishes))
        return result

    return decorate


def wished(
    where: str, cpu: float | str | None, memory: int | str | None, gpu: int | None
) -> Resources:
    """Wishes as a person spells them, see ``meta``; ``where`` is what errors call the place."""
    return Resources(cpu=_cpu(cpu, where), memory=_memory(memory, where), gpu=_gpu(gpu, where))


def resources_of(function: Callable[..., Any]) -> Resources:
    """The wishes of a function, method or functools.partial; all None if it has none."""
    while isinstance(function, functools.partial):
        function = function.func
    wishes = getattr(function, _ATTRIBUTE, None)
    return wishes if isinstance(wishes, Resources) else Resources()


def with_resources(function: _F, wishes: Resources) -> _F:
    """`function` with these wishes, for whoever has them in hand."""
    result: _F = function if wishes == Resources() else _attach(function, wishes)
    return result


def largest(wishes: Iterable[Resources]) -> Resources:
    """Of each the most that any of them wishes; they have no pool."""
    most: dict[str, Any] = {}
    for one in wishes:
        for name in ("cpu", "memory", "gpu"):
            asked = [wish for wish in (most.get(name), getattr(one, name)) if wish is not None]
            most[name] = max(asked, default=None)
    return Resources(**most)


def merged(inner: Resources, outer: Resources) -> Resources:
    """What ``inner`` wishes and ``outer`` adds or wishes otherwise."""
    given = {f.name: getattr(outer, f.name) for f in fields(outer)}
    return replace(inner, **{name: wish for name, wish in given.items() if wish is not None})


# ---- attaching ------------------------------------------------------------------------------
#
# Setting an attribute on the function would leak the wishes to everybody who uses it under
# its old name. What to return instead depends on how the function can be pickled:
#
# * Decorator syntax: its name is not bound yet and will be bound to the result. A copy of the
#   function is a function like any other then, found by pickle under that name.
# * Everything else (bound already, or no Python function at all): pickle would find the
#   original under the name, and can be told nothing about function objects. So the result is
#   an object, which pickles as "the original, with these wishes".


def _attach(function: Callable[..., Any], wishes: Resources) -> Any:
    if isinstance(function, types.FunctionType) and not _is_bound_to_its_name(function):
        twin = _copy(function)
        setattr(twin, _ATTRIBUTE, wishes)
        return twin
    return _FunctionWithWishes(function, wishes)


def _is_bound_to_its_name(function: Any) -> bool:
    found: Any = sys.modules.get(function.__module__)
    for part in function.__qualname__.split("."):
        found = getattr(found, part, None)
    return found is function


def _copy(function: types.FunctionType) -> types.FunctionType:
    twin = types.FunctionType(
        function.__code__,
        function.__globals__,
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )
    twin.__kwdefaults__ = function.__kwdefaults__
    for attribute in functools.WRAPPER_ASSIGNMENTS:
        if hasattr(function, attribute):
            setattr(twin, attribute, getattr(function, attribute))
    twin.__dict__.update(function.__dict__)
    return twin


class _FunctionWithWishes:
    """A callable that is another one with wishes of its own."""

    def __init__(self, function: Callable[..., Any], wishes: Resources) -> None:
        functools.update_wrapper(self, function)
        self._function = function
        setattr(self, _ATTRIBUTE, wishes)

    def __call__(self, /, *args: Any, **kwargs: Any) -> Any:
        return self._function(*args, **kwargs)

    def __get__(self, instance: object, owner: type | None = None) -> Any:
        # As a class attribute, a method exactly where the original would be one.
        if instance is None or not hasattr(self._function, "__get__"):
            return self
        return types.MethodType(self, instance)

    def __repr__(self) -> str:
        return f"<{self._function!r} with {resources_of(self)}>"

    def __reduce__(self) -> Any:
        # After `f = fiber.meta(cpu=1)(f)` the original has no name left, and this has it.
        # __main__ is another module in other processes: there, by value.
        name: str | None = getattr(self, "__qualname__", None)
        if name and self.__module__ != "__main__" and _is_bound_to_its_name(self):
            return name
        return _FunctionWithWishes, (self._function, resources_of(self))


# ---- reading --------------------------------------------------------------------------------


def _cpu(value: float | str | None, where: str) -> float | None:
    if value is None:
        return None
    number: object = value
    if isinstance(value, str) and (match := re.fullmatch(r"(\d+(?:\.\d+)?)(m?)", value)):
        number = float(match[1]) / (1000 if match[2] else 1)
    if isinstance(number, int | float) and not isinstance(number, bool) and 0 < number < math.inf:
        return float(number)
    raise ValueError(f"{where}(cpu={value!r}): expected CPUs above 0, as 2, 0.5 or '500m'")


_MIB_PER_UNIT = {"Mi": 1, "Gi": 1024, "Ti": 1024 * 1024}


def _memory(value: int | str | None, where: str) -> int | None:
    if value is None:
        return None
    number: object = value
    if isinstance(value, str) and (match := re.fullmatch(r"(\d+(?:\.\d+)?)(Mi|Gi|Ti)", value)):
        number = math.ceil(float(match[1]) * _MIB_PER_UNIT[match[2]])
    if isinstance(number, int) and not isinstance(number, bool) and number > 0:
        return number
    raise ValueError(
        f"{where}(memory={value!r}): expected MiB above 0 as a whole number, "
        "or a text with unit Mi, Gi or Ti, as '512Mi' or '2Gi'"
    )


def _gpu(value: int | None, where: str) -> int | None:
    if value is None:
        return None
    number: object = value
    if isinstance(number, int) and not isinstance(number, bool) and number >= 0:
        return number
    raise ValueError(f"{where}(gpu={value!r}): expected a whole number, 0 or more")
