"""Server-side apply, as far as one field manager that always forces goes."""

from __future__ import annotations

from typing import Any

from fakes.store import Body, Failure, Place, Store, merged

CONTENT_TYPE = "application/apply-patch+yaml"


def apply(store: Store, where: Place, before: Body, body: Body) -> Body:
    """Apply ``body``, remove the fields that only ``before`` has, and return the object."""
    plural, namespace, name = where
    metadata = body.get("metadata") or {}
    try:
        current = store.get(*where)
    except Failure:
        if "uid" in metadata:
            raise Failure(409, "Conflict", f"{name}: uid mismatch: there is no object") from None
        return store.create(plural, namespace, body)
    for field in ("uid", "resourceVersion"):
        if metadata.get(field, current["metadata"][field]) != current["metadata"][field]:
            raise Failure(409, "Conflict", f"{name}: {field} mismatch")
    _check_epoch(current, body)
    spec = merged(_without(current["spec"], before.get("spec") or {}, body["spec"]), body["spec"])
    return store.update(*where, {**current, "spec": spec})


def _without(current: Any, before: Body, now: Body) -> Body:
    """``current`` without the fields that were applied before and are not now."""
    result = dict(current)
    for key, value in before.items():
        if key not in now:
            result.pop(key, None)
            rest = _left(current.get(key), value)
            if rest:
                result[key] = rest
        elif isinstance(value, dict) and key in result:
            result[key] = _without(result[key], value, now[key])
    return result


def _left(current: Any, before: Any) -> Body:
    """Return the fields of others beside the applied ones."""
    if not isinstance(current, dict) or not isinstance(before, dict):
        return {}
    return {key: value for key, value in current.items() if key not in before}


def _check_epoch(current: Body, body: Body) -> None:
    """The rule of the schema that a master runs into."""
    new = (body["spec"].get("master") or {}).get("epoch")
    there = (current["spec"].get("master") or {}).get("epoch", 0)
    seen = (current.get("status") or {}).get("masterEpoch", 0)
    if new is not None and new < max(there, seen):
        raise Failure(422, "Invalid", "spec.master.epoch: must never fall")
