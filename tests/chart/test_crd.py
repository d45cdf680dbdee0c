"""The resource type: made from the models, upgraded with the release, never removed by it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from chart.helm import Helm, is_hook, kinds, named

GENERATED = Path(__file__).resolve().parents[2] / "crds" / "fiberpools.yaml"


@pytest.fixture
def generated() -> dict[str, Any]:
    document: dict[str, Any] = yaml.safe_load(GENERATED.read_text(encoding="utf-8"))
    return document


def test_the_rendered_resource_type_is_the_generated_one(
    helm: Helm, generated: dict[str, Any]
) -> None:
    rendered = named(helm.render(), "CustomResourceDefinition")
    assert rendered["metadata"]["name"] == generated["metadata"]["name"]
    assert rendered["spec"] == generated["spec"]


def test_an_upgrade_updates_the_crd_and_an_uninstall_keeps_it(helm: Helm) -> None:
    """Helm keeps the objects of a folder crds, and removes others without the policy ``keep``."""
    rendered = named(helm.render(), "CustomResourceDefinition")
    assert rendered["metadata"]["annotations"]["helm.sh/resource-policy"] == "keep"
    assert not is_hook(rendered)


def test_the_chart_can_leave_out_the_resource_type(helm: Helm) -> None:
    assert "CustomResourceDefinition" not in kinds(helm.render({"crds": {"install": False}}))
