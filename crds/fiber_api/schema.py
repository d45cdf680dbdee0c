"""CustomResourceDefinition, generated from the models.

    python -m fiber_api.schema            writes crds/fiberpools.yaml and the chart's template of it
    python -m fiber_api.schema --check    compares, and fails where they differ

A schema in Kubernetes is structural: it has no references and no alternatives, and each part stands
in one place. This module translates pydantic's schema. The rules need Kubernetes 1.31, which can
tell an IP address from a host name.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import yaml

from fiber_api import names
from fiber_api.model import flat_schema
from fiber_api.v1alpha1 import FiberPool

MAX_SIZE = 30_000
"""Largest size in bytes. Clients copy what they apply into an annotation, which has little room."""

_HEADER = "# Generated from crds/fiber_api by `make crds`; edit the models, not this file.\n"

_COLUMNS = (
    ("Desired", "integer", ".status.desiredReplicas", "Workers wanted, after the bounds"),
    ("Ready", "integer", ".status.readyReplicas", "Workers that are ready"),
    ("Connected", "integer", ".status.connectedReplicas", "Workers linked to the master"),
    ("Pending", "integer", ".status.pendingReplicas", "Workers that do not run yet"),
    ("Phase", "string", ".status.phase", "The conditions in one word"),
    ("Reason", "string", ".status.problems[0].reason", "The worst problem"),
    ("Master", "string", ".status.master", "Where the program is that uses the pool"),
    ("Age", "date", ".metadata.creationTimestamp", "Since when the pool is there"),
)

_WIDE_COLUMNS = (("Message", "string", ".status.problems[0].message", "The worst problem"),)
"""Columns that only ``kubectl get -o wide`` shows; their priority is 1."""


def definition() -> dict[str, Any]:
    """Return the CustomResourceDefinition as a document."""
    return {
        "apiVersion": "apiextensions.k8s.io/v1",
        "kind": "CustomResourceDefinition",
        "metadata": {"name": names.CRD_NAME},
        "spec": {
            "group": names.GROUP,
            "names": {
                "kind": names.KIND,
                "listKind": names.LIST_KIND,
                "plural": names.PLURAL,
                "singular": names.SINGULAR,
                "shortNames": list(names.SHORT_NAMES),
                "categories": list(names.CATEGORIES),
            },
            "scope": "Namespaced",
            "versions": [_version()],
        },
    }


def _version() -> dict[str, Any]:
    return {
        "name": names.VERSION,
        "served": True,
        "storage": True,
        "schema": {"openAPIV3Schema": schema()},
        "subresources": {
            "status": {},
            "scale": {
                "specReplicasPath": ".spec.replicas",
                "statusReplicasPath": ".status.replicas",
                "labelSelectorPath": ".status.selector",
            },
        },
        "additionalPrinterColumns": [_column(*column) for column in _COLUMNS]
        + [{**_column(*column), "priority": 1} for column in _WIDE_COLUMNS],
    }


def _column(name: str, kind: str, path: str, description: str) -> dict[str, Any]:
    return {"name": name, "type": kind, "jsonPath": path, "description": description}


def schema() -> dict[str, Any]:
    """Return the structural schema of a FiberPool."""
    document = _structural(flat_schema(FiberPool))
    properties = document["properties"]
    properties["apiVersion"] = {"type": "string", "description": f"{names.API_VERSION}."}
    properties["kind"] = {"type": "string", "description": f"{names.KIND}."}
    # The API server has its own schema of metadata and allows none here.
    properties["metadata"] = {"type": "object"}
    # Only the operator writes a status. Defaults would show values that it did not write.
    properties["status"] = _without_defaults(properties["status"])
    document["required"] = ["spec"]
    return document


def _structural(source: dict[str, Any]) -> dict[str, Any]:
    """Return ``source`` in the API server's dialect of JSON schema."""
    result = _without_null(source)
    result.pop("title", None)
    if "description" in result:
        result["description"] = " ".join(result["description"].split())
    if "default" in result:
        _translate_default(result)
    if result.get("type") == "integer":
        result["format"] = "int32" if result.get("maximum", 2**63) < 2**31 else "int64"
    if "items" in result:
        result["items"] = _structural(result["items"])
    if isinstance(result.get("additionalProperties"), dict):
        result["additionalProperties"] = _structural(result["additionalProperties"])
    if "properties" in result:
        result["properties"] = {
            name: _structural(value) for name, value in result["properties"].items()
        }
    return {key: result[key] for key in sorted(result, key=_rank)}


def _rank(key: str) -> tuple[int, str]:
    first = ("description", "type", "format", "default", "enum", "required", "properties", "items")
    return (first.index(key) if key in first else len(first), key)


def _without_defaults(source: dict[str, Any]) -> dict[str, Any]:
    result = {key: value for key, value in source.items() if key != "default"}
    if "items" in result:
        result["items"] = _without_defaults(result["items"])
    if "properties" in result:
        result["properties"] = {
            name: _without_defaults(value) for name, value in result["properties"].items()
        }
    return result


def _without_null(source: dict[str, Any]) -> dict[str, Any]:
    """An optional field is one that may be left out, not one that may be null."""
    kinds = [kind for kind in source.get("anyOf", ()) if kind != {"type": "null"}]
    rest = {key: value for key, value in source.items() if key != "anyOf"}
    return {**kinds[0], **rest} if kinds else rest


def _translate_default(result: dict[str, Any]) -> None:
    if result["default"] is None or result["default"] == []:
        del result["default"]
    elif isinstance(result["default"], dict):
        # Each field of it has its own default; together they are the models' defaults.
        result["default"] = {}


def manifest() -> str:
    """Return the text for ``kubectl apply -f``."""
    return _HEADER + _yaml(definition())


def chart_template() -> str:
    """Return the template for Helm, which never upgrades the files in a chart's ``crds`` folder.

    Helm leaves the resource type, and with it all pools, when the release is uninstalled.
    """
    document = definition()
    body = _yaml({"spec": document["spec"]})
    if "{{" in body:
        raise ValueError("the schema holds '{{', which Helm would take for its own: reword it")
    return (
        "{{- if .Values.crds.install }}\n"
        f"{_HEADER}"
        f"apiVersion: {document['apiVersion']}\n"
        f"kind: {document['kind']}\n"
        "metadata:\n"
        f"  name: {names.CRD_NAME}\n"
        "  annotations:\n"
        "    helm.sh/resource-policy: keep\n"
        "  labels:\n"
        '    {{- include "fiber-operator.labels" (list . "" dict) | nindent 4 }}\n'
        f"{body}"
        "{{- end }}\n"
    )


def _yaml(document: dict[str, Any]) -> str:
    return yaml.safe_dump(document, sort_keys=False, width=96)


_FILES = {
    "crds/fiberpools.yaml": manifest,
    "charts/fiber-operator/templates/crd.yaml": chart_template,
}
"""Generated files, by path from the root of the repository."""


def _stale(root: Path) -> list[str]:
    """Return the generated files that are absent or out of date."""
    return [
        name
        for name, text in _FILES.items()
        if not (root / name).is_file() or (root / name).read_text() != text()
    ]


def main(argv: list[str] | None = None) -> int:
    """Write or compare the generated files; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m fiber_api.schema", description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; fail if stale")
    options = parser.parse_args(argv)
    root = Path(__file__).resolve().parents[2]
    if not (root / "pyproject.toml").is_file():
        parser.error(f"{root} is no checkout of the repository: the files are kept there alone")
    stale = _stale(root)
    if options.check:
        for name in stale:
            print(f"{name} does not match the models: run `make crds`", file=sys.stderr)
        return 1 if stale else 0
    for name in stale:
        (root / name).write_text(_FILES[name]())
        print(f"wrote {name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
