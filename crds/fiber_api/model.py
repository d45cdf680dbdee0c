"""Common base of the models of the resource: how they read, and rules beyond types.

Reading is strict about types, as the API server is: ``"3"`` is no integer. It accepts unknown
fields, which a newer release may have written, and takes null for absent.
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    GetJsonSchemaHandler,
    PlainSerializer,
    ValidationError,
    WithJsonSchema,
    model_validator,
)
from pydantic.alias_generators import to_camel
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, ErrorDetails, InitErrorDetails, PydanticCustomError

from fiber_api.times import EARLIEST, LATEST, format_time, parse_time

PRESERVE = "x-kubernetes-preserve-unknown-fields"
"""Mark of a schema that keeps unknown fields as they came."""

LIST_AS_MAP = {"x-kubernetes-list-type": "map"}
"""Mark of a schema whose list items are told apart by keys, not by their places."""


@dataclass(frozen=True)
class Rule:
    """Rule that must hold between fields: for the API server in CEL, and here in Python."""

    field: str
    """Path from this model to the field that is to blame."""
    cel: str
    message: str
    """Rule, and what to do. ``kubectl`` shows it after the field's path."""
    holds: Callable[[Any], bool] | None
    """Check in Python; None for a rule about a change, which needs the old object and so the API
    server."""

    def document(self) -> dict[str, str]:
        """Return an item of ``x-kubernetes-validations``."""
        if self.field.startswith("metadata."):
            # Metadata is no part of the schema, and a path cannot lead there.
            return {"rule": self.cel, "message": f"{self.field} {self.message}"}
        return {"rule": self.cel, "message": self.message, "fieldPath": f".{self.field}"}


class Model(BaseModel):
    """Part of the resource. Immutable; fields have the API's names in JSON."""

    model_config = ConfigDict(
        alias_generator=to_camel,
        extra="ignore",
        frozen=True,
        populate_by_name=True,
        strict=True,
        use_attribute_docstrings=True,
    )

    RULES: ClassVar[tuple[Rule, ...]] = ()
    OPAQUE: ClassVar = False
    """True if the API server keeps unknown fields here, instead of dropping them."""

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        schema = handler(core_schema)
        own = handler.resolve_ref_schema(schema)
        if cls.OPAQUE:
            own[PRESERVE] = True
        if cls.RULES:
            own["x-kubernetes-validations"] = [rule.document() for rule in cls.RULES]
        return schema

    @model_validator(mode="before")
    @classmethod
    def _drop_nulls(cls, value: object) -> object:
        if isinstance(value, dict):
            return {key: item for key, item in value.items() if item is not None}
        return value

    @model_validator(mode="after")
    def _check_rules(self) -> Self:
        broken = [rule for rule in self.RULES if rule.holds is not None and not rule.holds(self)]
        if broken:
            raise ValidationError.from_exception_data(
                type(self).__name__, [_error(rule) for rule in broken]
            )
        return self


def _error(rule: Rule) -> InitErrorDetails:
    return InitErrorDetails(
        type=PydanticCustomError("rule", "{text}", {"text": rule.message}),
        loc=tuple(rule.field.split(".")),
        input=None,
    )


def _seconds(value: object) -> float:
    # A float is a time that Python wrote, not one that was read.
    if isinstance(value, float) and EARLIEST <= value <= LATEST:
        return value // 1
    if not isinstance(value, str):
        raise ValueError("must be a time such as 2026-11-21T14:56:13Z")
    return parse_time(value) // 1


Time = Annotated[
    float,
    BeforeValidator(_seconds),
    PlainSerializer(format_time, return_type=str),
    WithJsonSchema({"type": "string", "format": "date-time"}),
]
"""Unix seconds that the API writes as RFC 3339. They are whole, so that reading returns what was
written."""


_WORDS = {
    "missing": "is required",
    "model_type": "must be an object",
    "dict_type": "must be an object",
    "tuple_type": "must be a list",
}


def describe(error: ValidationError, inside: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Return the errors, a line each, which begins with the field: ``spec.master.port …``."""
    return tuple(
        _sentence(_path(inside + detail["loc"]), detail)
        for detail in error.errors(include_url=False, include_context=False)
    )


def _path(location: tuple[int | str, ...]) -> str:
    path = ""
    for part in location:
        path += f"[{part}]" if isinstance(part, int) else f".{part}"
    return path.removeprefix(".") or "the resource"


def _sentence(path: str, detail: ErrorDetails) -> str:
    kind, text = detail["type"], detail["msg"]
    text = _WORDS.get(kind, text.replace("Input should", "must").replace("Value error, ", ""))
    shown = "" if kind in ("missing", "rule", "value_error") else f", not {_short(detail['input'])}"
    return f"{path}: {text}{shown}"


def _short(value: object) -> str:
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return reprlib.repr(value)


def flat_schema(model: type[Model]) -> dict[str, Any]:
    """Return the JSON schema of ``model`` with every definition in its place instead of referred
    to."""
    schema = model.model_json_schema()
    definitions = schema.pop("$defs", {})

    def flat(value: Any) -> Any:
        if isinstance(value, list):
            return [flat(item) for item in value]
        if not isinstance(value, dict):
            return value
        reference = value.get("$ref", "").removeprefix("#/$defs/")
        rest = {key: flat(item) for key, item in value.items() if key != "$ref"}
        # The field's own description goes before that of its type.
        return {**flat(definitions[reference]), **rest} if reference else rest

    result: dict[str, Any] = flat(schema)
    return result
