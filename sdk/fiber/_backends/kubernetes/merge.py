"""The strategic merge of pod templates, by kubectl's rules where they make sense for one.

Lists of named things are merged by those names; of containers the fields are merged in turn, while
a volume, a variable or a mount is replaced by its namesake, since half of one and half of another
are neither.  Other lists are replaced.  None takes a field away, ``$patch: delete`` a named thing.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

_KEYS = {
    "containers": "name",
    "env": "name",
    "hostAliases": "ip",
    "imagePullSecrets": "name",
    "initContainers": "name",
    "volumeDevices": "devicePath",
    "volumeMounts": "mountPath",
    "volumes": "name",
}
_MERGED = frozenset({"containers", "initContainers"})


def merge_template(template: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``template`` with what ``over`` says in place of what it says; neither is changed."""
    merged = copy.deepcopy(dict(template))
    for key, value in over.items():
        if value is None:
            merged.pop(key, None)
        else:
            merged[key] = _merge(key, merged.get(key), value)
    return merged


def _merge(key: str, ours: Any, theirs: Any) -> Any:
    if isinstance(theirs, Mapping):
        return merge_template(ours if isinstance(ours, Mapping) else {}, theirs)
    named_by = _KEYS.get(key)
    if named_by and isinstance(theirs, list) and all(_has(item, named_by) for item in theirs):
        return _merge_named(ours or [], theirs, named_by, in_turn=key in _MERGED)
    # Also what makes no sense: the API server's complaint is better than one of ours.
    return copy.deepcopy(theirs)


def _has(item: object, key: str) -> bool:
    return isinstance(item, Mapping) and isinstance(item.get(key), str)


def _merge_named(ours: list[Any], theirs: list[Any], key: str, *, in_turn: bool) -> list[Any]:
    merged = {item[key]: item for item in ours}
    for item in theirs:
        name = item[key]
        if item.get("$patch") == "delete":
            merged.pop(name, None)
        else:
            merged[name] = merge_template(merged.get(name, {}) if in_turn else {}, item)
    return list(merged.values())
