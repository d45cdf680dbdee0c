"""Images and chart of a release, and of a development build, which has none."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

import fiber
from announcement import SUPPORTED
from cluster import images
from fiber._backends.kubernetes import published
from fiber._backends.kubernetes.published import (
    chart_version,
    install_command,
    reason_for_no_image,
    worker_image,
)

ROOT = Path(__file__).resolve().parents[2]
CHART = ROOT / "charts" / published.OPERATOR


@pytest.fixture
def release(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(published, "REGISTRY", "registry.example/fiber")


def test_a_checkout_is_a_development_build() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("the sources of a release have a registry")
    assert published.REGISTRY == ""
    assert worker_image() is None
    assert "development build" in reason_for_no_image()
    assert "--set image.repository=" in install_command()


@pytest.mark.usefixtures("release")
def test_a_release_has_an_image_for_each_python() -> None:
    image = f"registry.example/fiber/fiber-worker:{fiber.__version__}-py3.12"
    assert worker_image("3.12") == image
    assert all(map(worker_image, SUPPORTED))
    assert worker_image() is not None


@pytest.mark.usefixtures("release")
def test_a_python_without_an_image_is_named() -> None:
    assert worker_image("3.99") is None
    assert reason_for_no_image("3.99") == (
        f"this is Python 3.99, and images are published for {', '.join(SUPPORTED)}"
    )


@pytest.mark.usefixtures("release")
def test_a_release_is_installed_from_its_registry() -> None:
    version = chart_version(fiber.__version__)
    chart = f"oci://registry.example/fiber/charts/fiber-operator --version {version}"
    assert chart in install_command()


@pytest.mark.parametrize(
    ("version", "chart"),
    [("1.2.0", "1.2.0"), ("1.2.0rc1", "1.2.0-rc1"), ("1.2.0.dev0", "1.2.0-dev0")],
)
def test_the_chart_has_the_version_in_the_form_of_semver(version: str, chart: str) -> None:
    assert chart_version(version) == chart


def test_every_list_of_published_things_is_the_same() -> None:
    assert published.PYTHONS == SUPPORTED
    assert images.WORKER.name == published.WORKER
    assert images.OPERATOR.name == published.OPERATOR
    chart = yaml.safe_load((CHART / "Chart.yaml").read_text(encoding="utf-8"))
    assert chart["name"] == published.OPERATOR
    assert chart["appVersion"] == fiber.__version__
    assert chart["version"] == chart_version(fiber.__version__)
