"""Pod template of a pool: opaque, except for the parts that make it the template of a worker.

The pod's own schema is left to the API server, which judges a pod of the template in a dry run. A
copy of that schema would make a megabyte, and be out of date with the next release of Kubernetes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, Field, WithJsonSchema

from fiber_api.model import LIST_AS_MAP, PRESERVE, Model, Rule, flat_schema


class _Container(Model):
    OPAQUE: ClassVar = True

    name: Annotated[str, Field(min_length=1, max_length=63)]
    """Name of the container."""


class _PodSpec(Model):
    """Pod's spec, as in any pod."""

    OPAQUE: ClassVar = True

    RULES: ClassVar = (
        Rule(
            "restartPolicy",
            "!has(self.restartPolicy) || self.restartPolicy == 'Never'",
            "must be Never: the operator replaces workers that "
            "end, the kubelet must not. Leave the field out.",
            lambda spec: spec.restart_policy in (None, "Never"),
        ),
    )

    containers: Annotated[
        tuple[_Container, ...],
        Field(
            strict=False,
            min_length=1,
            max_length=50,
            json_schema_extra={**LIST_AS_MAP, "x-kubernetes-list-map-keys": ["name"]},
        ),
    ]
    """Containers, as in any pod. The one that spec.workerContainer names runs Fiber's agent."""
    restart_policy: Annotated[str | None, Field(max_length=20)] = None
    """Never, or left out."""


class _PodTemplate(Model):
    """Pod template, as in a Deployment: its metadata and its spec."""

    OPAQUE: ClassVar = True

    metadata: Annotated[
        dict[str, Any],
        WithJsonSchema({"type": "object", PRESERVE: True}),
        Field(default_factory=dict),
    ]
    """Labels and annotations of the pods."""
    spec: _PodSpec


def _checked_template(value: object) -> object:
    _PodTemplate.model_validate(value)
    return value


Template = Annotated[
    dict[str, Any],
    BeforeValidator(_checked_template),
    WithJsonSchema(flat_schema(_PodTemplate)),
]
"""Pod template as it came, with all fields that the API server may know and Fiber does not."""


def container_names(template: Mapping[str, Any]) -> list[str]:
    """Return the names of the containers in a ``Template``, in its order."""
    return [container["name"] for container in template["spec"]["containers"]]
