"""Check of pods as with ``fieldValidation=Strict``: fields unknown to Kubernetes."""

from __future__ import annotations

import typing
from collections.abc import Iterator
from typing import Any

from kubernetes.aio.client.models.v1_job import V1Job
from kubernetes.aio.client.models.v1_pod import V1Pod
from pydantic import BaseModel

from fakes.store import Body, Failure

_MODELS = {"pods": ("Pod", V1Pod), "jobs": ("Job", V1Job)}


def check(body: Body, plural: str = "pods") -> None:
    """Raise the API server's error for an unknown field."""
    if plural not in _MODELS:
        return
    kind, model = _MODELS[plural]
    unknown = ", ".join(f'unknown field "{path}"' for path in unknown_fields(body, model))
    if unknown:
        message = f'{kind} in version "v1" cannot be handled as a {kind}: strict decoding error: '
        raise Failure(400, "BadRequest", message + unknown)


def unknown_fields(value: Any, kind: Any = V1Pod, path: str = "") -> Iterator[str]:
    """The paths of fields that the client's model of a pod has not, ``kind`` being the place's."""
    model, item = _within(kind)
    if isinstance(value, list):
        for number, element in enumerate(value):
            yield from unknown_fields(element, item, f"{path}[{number}]")
    elif isinstance(value, dict) and model is not None:
        # A field whose name is a word of Python's has a prefix.
        fields = {
            alias: model.model_fields.get(name) or model.model_fields[f"var{name}"]
            for name, alias in model.attribute_map.items()
        }
        for key, element in value.items():
            below = f"{path}.{key}".lstrip(".")
            if key in fields:
                yield from unknown_fields(element, fields[key].annotation, below)
            else:
                yield below


def _within(kind: Any) -> tuple[Any, Any]:
    """Return the model that an annotation names, if any, and the model of a list's items, if any.

    A dictionary is neither: its keys are anybody's.
    """
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return kind, None
    inner = [part for part in typing.get_args(kind) if part is not type(None)]
    if typing.get_origin(kind) is list:
        return None, inner[0]
    if typing.get_origin(kind) is typing.Union and len(inner) == 1:
        return _within(inner[0])
    return None, None
