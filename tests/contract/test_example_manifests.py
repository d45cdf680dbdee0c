"""The manifests under examples/ agree with the contract."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

import fiber
from fiber_api import names
from fiber_api.model import PRESERVE
from fiber_api.schema import schema
from fiber_api.v1alpha1 import FiberPool

ROOT = Path(__file__).resolve().parents[2]
JOB = ROOT / "examples/01-pi/job.yaml"
MANIFESTS = sorted((ROOT / "examples/manifests").glob("*.yaml"))


def documents(path: Path) -> list[Any]:
    return list(yaml.safe_load_all(path.read_text()))


def unknown(document: Any, node: dict[str, Any], path: str) -> list[str]:
    """The fields of ``document`` that the API server would drop without a word."""
    if isinstance(document, list):
        return [found for item in document for found in unknown(item, node["items"], path)]
    if not isinstance(document, dict):
        return []
    properties = node.get("properties", {})
    own = [] if node.get(PRESERVE) else [f"{path}.{key}" for key in document.keys() - properties]
    inner = [
        found
        for key in document.keys() & properties
        for found in unknown(document[key], properties[key], f"{path}.{key}")
    ]
    return own + inner


def test_the_example_manifests_are_complete() -> None:
    assert [path.stem for path in MANIFESTS] == ["autoscaled", "gpu", "minimal", "warm"]


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.stem)
def test_a_manifest_is_a_pool_called_like_its_file(path: Path) -> None:
    (document,) = documents(path)
    pool = FiberPool.read(document)
    assert pool.metadata.name == path.stem
    assert unknown(document["spec"], schema()["properties"]["spec"], "spec") == []
    # A manifest that is applied again and again contains no field that the program owns.
    assert not {"replicas", "master"} & set(document["spec"])


@pytest.mark.parametrize("path", [*MANIFESTS, JOB], ids=lambda path: path.stem)
def test_the_workers_image_is_the_projects_or_yours(path: Path) -> None:
    image_of_this_release = f"fiber-worker:{fiber.__version__}"
    for image in re.findall(r"^ *image: (\S+)$", path.read_text(), re.MULTILINE):
        assert image == image_of_this_release or image.startswith("registry.example.com/")


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.stem)
def test_labels_that_are_selected_by_are_the_operators(path: Path) -> None:
    (document,) = documents(path)
    spec = document["spec"]["template"]["spec"]
    for constraint in spec.get("topologySpreadConstraints", ()):
        labels = constraint["labelSelector"]["matchLabels"]
        assert labels == {names.LABEL_POOL: document["metadata"]["name"]}


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.stem)
def test_comments_name_fields_that_exist(path: Path) -> None:
    fields = {**schema()["properties"]}
    for found in re.findall(r"\b(?:spec|status)(?:\.[a-zA-Z]+)+", path.read_text()):
        node: dict[str, Any] = {"properties": fields}
        for name in found.split("."):
            assert name in node["properties"], found
            node = node["properties"][name]
