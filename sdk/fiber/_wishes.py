"""Readers of wishes for a process: from the form that users write to values that hash.

``fiber.meta``, the options of an executor and the configuration share these readers. Each raises
ValueError for a value that it cannot read.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping

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


def cpus(value: object) -> float:
    """Read CPUs above 0: 2, 0.5, "500m"."""
    number = value
    if isinstance(value, str) and (match := re.fullmatch(r"(\d+(?:\.\d+)?)(m?)", value)):
        number = float(match[1]) / (1000 if match[2] else 1)
    if isinstance(number, int | float) and not isinstance(number, bool) and 0 < number < math.inf:
        return float(number)
    raise ValueError("expected CPUs above 0, as 2, 0.5 or '500m'")


def mebibytes(value: object) -> int:
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


def count(value: object) -> int:
    """Read a whole number, 0 or more."""
    if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        return value
    raise ValueError("expected a whole number, 0 or more")


def extended_resources(value: object) -> Counts:
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
    return tuple(sorted((name, count(amount)) for name, amount in value.items()))


def node_selector(value: object) -> Pairs:
    """Read the labels of nodes: {"disk": "ssd"}, or the text "disk=ssd,zone=a"."""
    if isinstance(value, str):
        value = dict(_pair(part) for part in _parts(value))
    if isinstance(value, Mapping) and all(_is_label(*pair) for pair in value.items()):
        return tuple(sorted(value.items()))
    raise ValueError("expected a dict of labels and their values, as {'disk': 'ssd'}")


def tolerations(value: object) -> tuple[Toleration, ...]:
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
