"""`fiber.meta`: a function's wishes for the host that runs it."""

from __future__ import annotations

import functools
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from fiber import _wishes

__all__ = ["Resources", "largest", "merged", "meta", "resources_of", "wished", "with_resources"]

_ATTRIBUTE = "__fiber_meta__"
_RUN_BY_A_MANAGER = "_run_server"
"""Name of the method of a manager's class that runs in the server's process."""
_F = TypeVar("_F", bound=Callable[..., Any])
_N = TypeVar("_N", int, float)
_V = TypeVar("_V", int, str)


@dataclass(frozen=True, slots=True)
class Resources:
    """Wishes of a function; None stands for no wish."""

    cpu: float | None = None
    """CPUs, fractions allowed."""
    memory: int | None = None
    """Memory in MiB."""
    gpu: int | None = None
    """GPUs."""
    pool: str | None = None
    """Name of the FiberPool whose pods to use; None: a FiberPool that the program makes."""
    extended: _wishes.Counts = ()
    """Extended resources and how many of each."""
    node_selector: _wishes.Pairs = ()
    """Labels that the node must have."""
    tolerations: tuple[_wishes.Toleration, ...] = ()
    """Taints that the node may have."""


def meta(
    *,
    cpu: float | str | None = None,
    memory: int | str | None = None,
    gpu: int | None = None,
    resources: Mapping[str, int] | None = None,
    node_selector: Mapping[str, str] | None = None,
    tolerations: Sequence[str | Mapping[str, Any]] | None = None,
) -> Callable[[_F], _F]:
    """Give a function wishes for resources.  Backends with such resources fulfil them.

    `cpu` counts CPUs (2, 0.5, "500m"), `memory` is in MiB or has a unit (512, "512Mi",
    "2Gi"), `gpu` counts GPUs of NVIDIA. `resources` counts any other extended resource of
    Kubernetes, as `{"amd.com/gpu": 1}`. `node_selector` has the labels of the nodes that may
    run it, as `{"disk": "ssd"}`. `tolerations` has the taints that these nodes may have, as
    kubectl writes them (`["spot", "team=a:NoSchedule"]`) or as dicts of a pod's spec.

    Only the returned function has the wishes. The original function stays unchanged, so
    `small = fiber.meta(cpu=1)(f)` and `large = fiber.meta(cpu=8)(f)` may be used side by
    side. If the function has wishes already, the new ones are added, and win where both have
    a value. The result behaves and pickles like the original.

    A manager's class may have wishes, too: they are for the process of its server.
    """
    placement = {"resources": resources, "node_selector": node_selector, "tolerations": tolerations}
    wishes = wished("fiber.meta", cpu, memory, gpu, **placement)
    if wishes == Resources():
        raise TypeError(
            "fiber.meta() needs at least one of cpu=, memory=, gpu=, resources=, node_selector= "
            "and tolerations="
        )

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
    where: str,
    cpu: float | str | None = None,
    memory: int | str | None = None,
    gpu: int | None = None,
    *,
    resources: object = None,
    node_selector: object = None,
    tolerations: object = None,
) -> Resources:
    """Read wishes as users write them for ``meta``; ``where`` names the call in errors."""

    def read(name: str, value: object, reader: Callable[[object], Any], default: Any) -> Any:
        if value is None:
            return default
        try:
            return reader(value)
        except ValueError as error:
            raise ValueError(f"{where}({name}={value!r}): {error}") from None

    return Resources(
        cpu=read("cpu", cpu, _wishes.cpus, None),
        memory=read("memory", memory, _wishes.mebibytes, None),
        gpu=read("gpu", gpu, _wishes.count, None),
        extended=read("resources", resources, _wishes.extended_resources, ()),
        node_selector=read("node_selector", node_selector, _wishes.node_selector, ()),
        tolerations=read("tolerations", tolerations, _wishes.tolerations, ()),
    )


def resources_of(function: Callable[..., Any]) -> Resources:
    """Return the wishes of a function, method or functools.partial."""
    while isinstance(function, functools.partial):
        function = function.func
    wishes = getattr(function, _ATTRIBUTE, None)
    return wishes if isinstance(wishes, Resources) else Resources()


def with_resources(function: _F, wishes: Resources) -> _F:
    """Return `function` with these wishes; unchanged if there are none."""
    result: _F = function if wishes == Resources() else _attach(function, wishes)
    return result


def largest(wishes: Iterable[Resources]) -> Resources:
    """Return the largest wish for each resource, and node labels that satisfy all wishes.

    The result has no pool. ValueError if two wish different values of one node label.
    """
    total = Resources()
    for one in wishes:
        labels = dict(total.node_selector)
        for key, value in one.node_selector:
            if labels.setdefault(key, value) != value:
                raise ValueError(
                    f"one worker cannot be on a node with {key}={labels[key]} and with "
                    f"{key}={value}, which its parts wish. Give them the same node_selector"
                )
        both = dict(total.extended)
        total = replace(
            merged(total, one),
            cpu=_most(total.cpu, one.cpu),
            memory=_most(total.memory, one.memory),
            gpu=_most(total.gpu, one.gpu),
            extended=_merged(both.items(), ((k, max(n, both.get(k, 0))) for k, n in one.extended)),
            pool=None,
        )
    return total


def merged(inner: Resources, outer: Resources) -> Resources:
    """Return the wishes of ``inner``, with those of ``outer`` added or in their place."""
    return Resources(
        cpu=inner.cpu if outer.cpu is None else outer.cpu,
        memory=inner.memory if outer.memory is None else outer.memory,
        gpu=inner.gpu if outer.gpu is None else outer.gpu,
        pool=inner.pool if outer.pool is None else outer.pool,
        extended=_merged(inner.extended, outer.extended),
        node_selector=_merged(inner.node_selector, outer.node_selector),
        tolerations=tuple(dict.fromkeys(inner.tolerations + outer.tolerations)),
    )


def _most(one: _N | None, other: _N | None) -> _N | None:
    return max((wish for wish in (one, other) if wish is not None), default=None)


def _merged(
    inner: Iterable[tuple[str, _V]], outer: Iterable[tuple[str, _V]]
) -> tuple[tuple[str, _V], ...]:
    return tuple(sorted({**dict(inner), **dict(outer)}.items()))


# ---- attaching ------------------------------------------------------------------------------
#
# An attribute of the function would give the wishes to all users of the original name. The
# result depends on how the function can be pickled:
#
# * Decorator syntax: the name is not bound yet, and will be bound to the result. So the result
#   is a copy of the function, which pickle finds under that name.
# * All other cases (a bound name, or no Python function): pickle would find the original under
#   the name. So the result is an object that pickles as "the original, with these wishes".


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
    """Callable that calls another one, and has wishes."""

    def __init__(self, function: Callable[..., Any], wishes: Resources) -> None:
        functools.update_wrapper(self, function)
        self._function = function
        setattr(self, _ATTRIBUTE, wishes)

    def __call__(self, /, *args: Any, **kwargs: Any) -> Any:
        return self._function(*args, **kwargs)

    def __get__(self, instance: object, owner: type | None = None) -> Any:
        # As a class attribute it is a method if the original would be one.
        if instance is None or not hasattr(self._function, "__get__"):
            return self
        return types.MethodType(self, instance)

    def __repr__(self) -> str:
        return f"<{self._function!r} with {resources_of(self)}>"

    def __reduce__(self) -> Any:
        # After `f = fiber.meta(cpu=1)(f)` this object has the name of the original.
        # In other processes __main__ is another module, so such functions go by value.
        name: str | None = getattr(self, "__qualname__", None)
        if name and self.__module__ != "__main__" and _is_bound_to_its_name(self):
            return name
        return _FunctionWithWishes, (self._function, resources_of(self))
