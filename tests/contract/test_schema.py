"""The generated CustomResourceDefinition: its contents and the limits of a structural schema."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from fiber_api import names
from fiber_api.model import Model
from fiber_api.schema import MAX_SIZE, chart_template, definition, main, manifest, schema
from fiber_api.v1alpha1 import (
    FailurePolicy,
    FiberPoolSpec,
    Idle,
    MasterSpec,
    ScaleDown,
    ScaleUp,
    Update,
)

ROOT = Path(__file__).resolve().parents[2]

# Keywords of OpenAPI that a node of a structural schema may have.
ALLOWED = {
    "default",
    "description",
    "enum",
    "format",
    "items",
    "maxItems",
    "maxLength",
    "maximum",
    "minItems",
    "minLength",
    "minimum",
    "pattern",
    "properties",
    "required",
    "type",
    "x-kubernetes-list-map-keys",
    "x-kubernetes-list-type",
    "x-kubernetes-preserve-unknown-fields",
    "x-kubernetes-validations",
}


def nodes(node: dict[str, Any], path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    yield path, node
    if "items" in node:
        yield from nodes(node["items"], f"{path}[]")
    for name, child in node.get("properties", {}).items():
        yield from nodes(child, f"{path}.{name}")


NODES = dict(nodes(schema()))
MODELS: dict[str, type[Model]] = {
    ".spec": FiberPoolSpec,
    ".spec.master": MasterSpec,
    ".spec.idle": Idle,
    ".spec.scaleDown": ScaleDown,
    ".spec.scaleUp": ScaleUp,
    ".spec.failurePolicy": FailurePolicy,
    ".spec.update": Update,
}


def test_the_files_are_generated_from_the_models() -> None:
    assert main(["--check"]) == 0


def test_a_stale_file_is_named(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setattr("fiber_api.schema._HEADER", "# Another.\n")
    assert main(["--check"]) == 1
    assert "crds/fiberpools.yaml does not match the models: run `make crds`" in (
        capsys.readouterr().err
    )


def test_the_resource_type_is_small_enough_for_kubectl_apply() -> None:
    """The docstrings of the models are its descriptions: shorten them if this fails."""
    assert len(manifest().encode()) < MAX_SIZE


def test_the_definition_names_its_group_and_kind() -> None:
    document = yaml.safe_load(manifest())
    assert document == definition()
    spec = document["spec"]
    assert document["metadata"]["name"] == f"{spec['names']['plural']}.{spec['group']}"
    assert spec["scope"] == "Namespaced"
    assert spec["names"]["shortNames"] == ["fp", "fpool"]
    assert spec["names"]["categories"] == ["all", "fiber"]
    (version,) = spec["versions"]
    assert (version["name"], version["served"], version["storage"]) == ("v1alpha1", True, True)


def test_the_chart_has_the_same_and_keeps_it() -> None:
    text = chart_template()
    assert "helm.sh/resource-policy: keep" in text
    plain = "\n".join(line for line in text.splitlines() if "{{" not in line)
    document = yaml.safe_load(plain)
    assert document["spec"] == definition()["spec"]
    assert document["kind"] == definition()["kind"]
    assert document["metadata"]["name"] == names.CRD_NAME


def test_every_node_is_structural() -> None:
    for path, node in NODES.items():
        assert set(node) <= ALLOWED, path
        assert node["type"] in {"object", "array", "string", "integer", "boolean"}, path
        assert set(node.get("required", ())) <= set(node.get("properties", ())), path
        if node["type"] == "array":
            assert node["x-kubernetes-list-type"] in {"atomic", "set", "map"}, path
            keys = node.get("x-kubernetes-list-map-keys", ())
            assert set(keys) <= set(node["items"].get("required", ())), path


def test_every_field_can_be_explained() -> None:
    for path, node in NODES.items():
        if path == ".metadata" or path.endswith("[]"):
            continue  # the API server's own fields, and items, whose type the list gives
        assert node["description"].endswith("."), path
        assert " ".join(node["description"].split()) == node["description"], path


def test_fields_that_rules_read_are_bounded() -> None:
    # The API server estimates the highest cost of a rule, and refuses a schema that might be
    # expensive. It refuses absurd values too.
    for path, node in NODES.items():
        if not path.startswith(".spec"):
            continue
        if node["type"] == "array":
            assert node["maxItems"] <= 500, path
        if node["type"] == "string" and "enum" not in node:
            assert node["maxLength"] <= 253, path
        if node["type"] == "integer":
            assert {"minimum", "maximum"} <= set(node), path


@pytest.mark.parametrize(("path", "model"), MODELS.items(), ids=MODELS)
def test_defaults_are_the_models(path: str, model: type[Model]) -> None:
    properties = NODES[path]["properties"]
    assert set(properties) == {info.alias for info in model.model_fields.values()}
    for info in model.model_fields.values():
        name = str(info.alias)
        given = properties[name].get("default")
        if info.is_required():
            assert name in NODES[path]["required"]
            assert given is None
        elif isinstance(info.default, Model):
            assert given == {}
            assert type(info.default)() == info.default
        else:
            assert given == (info.default or None if info.default == () else info.default)


def test_the_scale_subresource_can_be_read_of_every_pool() -> None:
    # The API server answers 500 where the field that it leads to is absent.
    scale = definition()["spec"]["versions"][0]["subresources"]["scale"]
    assert NODES[scale["specReplicasPath"]]["default"] == 0


def test_a_status_has_no_default() -> None:
    assert [path for path in NODES if path.startswith(".status") and "default" in NODES[path]] == []


def test_columns_lead_somewhere() -> None:
    columns = definition()["spec"]["versions"][0]["additionalPrinterColumns"]
    shown = [column["name"].upper() for column in columns if not column.get("priority")]
    known = ["DESIRED", "READY", "CONNECTED", "PENDING", "PHASE", "REASON", "MASTER", "AGE"]
    assert shown == known
    for column in columns:
        path = re.sub(r"\[[^]]*\]", "[]", column["jsonPath"])
        if path != ".metadata.creationTimestamp":
            assert path in NODES, f"{column['name']}: there is no field {path}"
            assert NODES[path]["type"] == column["type"]


def test_the_scale_subresource_leads_somewhere() -> None:
    scale = definition()["spec"]["versions"][0]["subresources"]["scale"]
    assert NODES[scale["specReplicasPath"]]["format"] == "int32"
    assert NODES[scale["statusReplicasPath"]]["format"] == "int32"
    assert NODES[scale["labelSelectorPath"]]["type"] == "string"


RULES = [
    (path, rule)
    for path, node in NODES.items()
    for rule in node.get("x-kubernetes-validations", ())
]
RULE_IDS = [rule["rule"] for _, rule in RULES]


def test_the_schema_has_at_least_ten_rules() -> None:
    assert len(RULES) >= 10


def test_no_rule_takes_the_optional_of_a_field() -> None:
    # The API server knows no length of ``self.?field``, and refuses the schema as too expensive.
    assert [rule for rule in RULE_IDS if ".?" in rule] == []


@pytest.mark.parametrize(("path", "rule"), RULES, ids=RULE_IDS)
def test_a_rule_names_its_field_and_the_remedy(path: str, rule: dict[str, str]) -> None:
    if "fieldPath" in rule:
        assert f"{path}{rule['fieldPath']}" in NODES
    else:
        assert rule["message"].startswith("metadata.name ")
    assert re.search(r"(must|cannot) ", rule["message"])
    assert rule["message"].endswith(".")
    assert "\n" not in rule["message"]


@pytest.mark.parametrize(("path", "rule"), RULES, ids=RULE_IDS)
def test_a_rule_reads_fields_that_are_there(path: str, rule: dict[str, str]) -> None:
    # A field that may be absent is an error at run time unless the rule asks for it first.
    for found in re.findall(r"\bself((?:\.\w+)+)(?!\w|\()", rule["rule"]):
        if found.startswith(".metadata"):
            continue
        assert f"{path}{found}" in NODES
        parent, _, name = f"{path}{found}".rpartition(".")
        required = name in NODES[parent].get("required", ())
        # When the API server checks a default of the whole object, the defaults of its fields are
        # not there.
        filled_in = "default" in NODES[path + found] and "default" not in NODES[parent]
        assert required or filled_in or f"!has(self{found})" in rule["rule"], found
