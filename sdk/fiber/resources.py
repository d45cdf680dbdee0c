"""`fiber.meta`: a function's wishes for the host that runs it."""

from __future__ import annotations

import functools
import math
import re
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

__all__ = ["Resources", "largest", "merged", "meta", "resources_of", "wished", "with_resources"]

Pairs = tuple[tuple[str, str], ...]
Counts = tuple[tuple[str, int], ...]
Toleration = tuple[tuple[str, str | int], ...]
"""The fields of a toleration, in the order of their names."""

GPU = "nvidia.com/gpu"
"""The extended resource that ``gpu=`` counts."""

_MIB_PER_UNIT = {"Mi": 1, "Gi": 1024, "Ti": 1024 * 1024}
_NAME = r"[A-Za-z0-9](?:[-A-Za-z0-9_.]{0,61}[A-Za-z0-9])?"
_DOMAIN = r"[a-z0-9](?:[-a-z0-9.]{0,251}[a-z0-9])?"
_KEY = f"(?:{_DOMAIN}/)?{_NAME}"
_TAINT = re.compile(f"({_KEY})(?:=({_NAME})?)?(?::([A-Za-z]+))?")
_EFFECTS = ("NoSchedule", "PreferNoSchedule", "NoExecute")
_FIELDS = {"key", "operator", "value", "effect", "tolerationSeconds"}

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
    extended: Counts = ()
    """Extended resources and how many of each."""
    node_selector: Pairs = ()
    """Labels that the node must have."""
    tolerations: tuple[Toleration, ...] = ()
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
        cpu=read("cpu", cpu, read_cpus, None),
        memory=read("memory", memory, read_mebibytes, None),
        gpu=read("gpu", gpu, read_count, None),
        extended=read("resources", resources, read_extended_resources, ()),
        node_selector=read("node_selector", node_selector, read_node_selector, ()),
        tolerations=read("tolerations", tolerations, read_tolerations, ()),
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


# ---- reading --------------------------------------------------------------------------------
#
# `fiber.meta`, the options of an executor and the configuration share these readers. Each raises
# ValueError for a value that it cannot read.


def read_cpus(value: object) -> float:
    """Read CPUs above 0: 2, 0.5, "500m"."""
    number = value
    if isinstance(value, str) and (match := re.fullmatch(r"(\d+(?:\.\d+)?)(m?)", value)):
        number = float(match[1]) / (1000 if match[2] else 1)
    if isinstance(number, int | float) and not isinstance(number, bool) and 0 < number < math.inf:
        return float(number)
    raise ValueError("expected CPUs above 0, as 2, 0.5 or '500m'")


def read_mebibytes(value: object) -> int:
    """Read memory above 0 in MiB: 512, "512Mi", "2Gi"."""
    number = value
    if isinstance(value, str) and (match := re.fullmatch(r"(\d+(?:\.\d+)?)(Mi|Gi|Ti)", value)):
        number = math.ceil(float(match[1]) * _MIB_PER_UNIT[match[2]])
    if isinstance(number, int) and not isinstance(number, bool) and number > 0:
        return number
    raise ValueError(
        "expected MiB above 0 as a whole number, or a text with unit Mi, Gi or Ti, as '512Mi' or "
        "'2Gi'"
    )


def read_count(value: object) -> int:
    """Read a whole number, 0 or more."""
    if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        return value
    raise ValueError("expected a whole number, 0 or more")


def read_extended_resources(value: object) -> Counts:
    """Read extended resources: {"amd.com/gpu": 1}."""
    if not isinstance(value, Mapping):
        raise ValueError("expected a dict of extended resources, as {'amd.com/gpu': 1}")
    for name in value:
        if name == GPU:
            raise ValueError(f"{name} is counted by gpu=: use gpu= instead")
        if not isinstance(name, str) or not re.fullmatch(f"{_DOMAIN}/{_NAME}", name):
            raise ValueError(
                f"{name!r} is no extended resource, as 'amd.com/gpu' is. CPUs and memory are cpu= "
                "and memory=; a pod template (template=) takes all others"
            )
    return tuple(sorted((name, read_count(amount)) for name, amount in value.items()))


def read_node_selector(value: object) -> Pairs:
    """Read the labels of nodes: {"disk": "ssd"}, or the text "disk=ssd,zone=a"."""
    if isinstance(value, str):
        value = dict(_pair(part) for part in _parts(value))
    if isinstance(value, Mapping) and all(_is_label(*pair) for pair in value.items()):
        return tuple(sorted(value.items()))
    raise ValueError("expected a dict of labels and their values, as {'disk': 'ssd'}")


def read_tolerations(value: object) -> tuple[Toleration, ...]:
    """Read tolerations: texts as kubectl writes taints ("spot", "team=a:NoSchedule"), or dicts."""
    if isinstance(value, str):
        value = _parts(value)
    if isinstance(value, Iterable) and not isinstance(value, Mapping):
        return tuple(dict.fromkeys(_toleration(one) for one in value))
    raise ValueError("expected a list of tolerations, as ['spot=true:NoSchedule']")


def _parts(text: str) -> list[str]:
    return [part.strip() for part in text.split(",") if part.strip()]


def _pair(text: str) -> tuple[str, str]:
    key, separator, value = text.partition("=")
    if not separator:
        raise ValueError("expected labels as 'disk=ssd,zone=a'")
    return key.strip(), value.strip()


def _is_label(key: object, value: object) -> bool:
    if not isinstance(key, str) or not isinstance(value, str):
        return False
    return bool(re.fullmatch(_KEY, key) and re.fullmatch(f"(?:{_NAME})?", value))


def _toleration(value: object) -> Toleration:
    if (
        isinstance(value, Mapping)
        and value.keys() <= _FIELDS
        and all(map(_is_field, value.items()))
    ):
        return tuple(sorted(value.items()))
    taint = _TAINT.fullmatch(value) if isinstance(value, str) else None
    if taint is None or taint[3] not in (None, *_EFFECTS):
        raise ValueError(
            f"{value!r} is no toleration: expected KEY, KEY=VALUE, KEY:EFFECT or KEY=VALUE:EFFECT "
            f"with the effect {', '.join(_EFFECTS)}, or a dict as in a pod's spec"
        )
    key, of_key, effect = taint.groups()
    fields: dict[str, str | int] = {"key": key, "operator": "Exists"}
    if of_key is not None:
        fields |= {"operator": "Equal", "value": of_key}
    if effect is not None:
        fields["effect"] = effect
    return tuple(sorted(fields.items()))


def _is_field(field: tuple[object, object]) -> bool:
    name, value = field
    if name == "tolerationSeconds":
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, str)


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
