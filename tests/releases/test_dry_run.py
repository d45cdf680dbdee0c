"""Dry run of a release, the commit before one, and what is refused."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from release import ROOT, ReleaseError, changelog, images, versions
from release.__main__ import agree, main, prepare, push_image

import fiber
from chart.helm import find_helm
from fiber._backends.kubernetes.published import PYTHONS, chart_version

REGISTRY = "registry.example/fiber"
DIGEST = "sha256:" + "a" * 64


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A copy of the files that have a version, with two news fragments."""
    root = tmp_path / "checkout"
    for name in ("charts", "examples", "pyproject.toml", "sdk/fiber/__init__.py"):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        copy(ROOT / name, root / name)
    (root / "CHANGELOG.md").write_text("# Changelog\n\nWords.\n\n## 0.0.1 (2020-01-01)\n\n* Old.\n")
    (root / "changelog.d").mkdir()
    (root / "changelog.d" / "README.md").write_text("# News fragments\n")
    (root / "changelog.d" / "7.fix-a.md").write_text("A fix, see [x](docs/x.md).\n")
    (root / "changelog.d" / "12.feature.md").write_text("New:\n\nmore of it.\n")
    return root


@pytest.mark.timeout(300, func_only=True)  # installs packages
def test_a_dry_run_makes_and_checks_all_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    helm = find_helm()
    if helm is None:
        assert os.environ.get("CI") != "true"
        pytest.skip("no helm on the PATH, and none was built")
    monkeypatch.setenv("PATH", f"{os.environ['PATH']}:{Path(helm).parent}")
    out = tmp_path / "out"
    assert main(["build", "--out", str(out), "--registry", REGISTRY]) == 0, capsys.readouterr()
    names = {path.name for path in (out / "assets").iterdir()}
    packages = {f"fiberpool-{fiber.__version__}{end}" for end in ("-py3-none-any.whl", ".tar.gz")}
    chart = f"fiber-operator-{chart_version(fiber.__version__)}.tgz"
    assert names == {*packages, chart, "fiberpools.yaml", "SHA256SUMS"}
    assert {path.name for path in (out / "pypi").iterdir()} == packages
    for line in (out / "assets" / "SHA256SUMS").read_text().splitlines():
        digest, _, name = line.partition("  ")
        assert hashlib.sha256((out / "assets" / name).read_bytes()).hexdigest() == digest
    assert f"oci://{REGISTRY}/charts/fiber-operator" in (out / "notes.md").read_text()


def test_the_commit_of_a_release_has_its_version_and_its_news(checkout: Path) -> None:
    prepare("1.2.0", "2021-02-03", checkout)
    assert versions.current(checkout) == "1.2.0"
    assert changelog.section(checkout, "1.2.0") == (
        "### New\n\n* New:\n\n  more of it.\n\n### Fixed\n\n* A fix, see [x](docs/x.md).\n"
    )
    assert changelog.section(checkout, "0.0.1") == "* Old.\n"
    assert "## 1.2.0 (2021-02-03)\n" in (checkout / "CHANGELOG.md").read_text()
    assert [path.name for path in (checkout / "changelog.d").iterdir()] == ["README.md"]
    prepare("1.3.0.dev0", "2021-02-04", checkout)
    assert versions.current(checkout) == "1.3.0.dev0"


def test_the_links_of_notes_lead_to_the_tag(checkout: Path) -> None:
    notes = changelog.absolute_links(checkout, changelog.unreleased(checkout), "v1.2.0")
    assert "/blob/v1.2.0/docs/x.md)" in notes


@pytest.mark.parametrize("version", ["1.2", "v1.2.0", "1.2.0+mine", "1.2.0a1", ""])
def test_a_version_of_another_form_is_refused(checkout: Path, version: str) -> None:
    with pytest.raises(ReleaseError, match="cannot be the version of a release"):
        prepare(version, "2021-02-03", checkout)


def test_files_with_different_versions_are_named(checkout: Path) -> None:
    chart = checkout / "charts" / "fiber-operator" / "Chart.yaml"
    chart.write_text(chart.read_text().replace(f'"{fiber.__version__}"', '"9.9.9"'))
    with pytest.raises(ReleaseError, match=r"Chart.yaml has the version 9\.9\.9 instead of"):
        versions.current(checkout)


@pytest.mark.parametrize(
    ("tag", "version", "words"),
    [("v1.2.1", "1.2.0", "names must agree"), ("v1.2.0.dev0", "1.2.0.dev0", "not released")],
)
def test_a_tag_that_cannot_be_released(tag: str, version: str, words: str) -> None:
    with pytest.raises(ReleaseError, match=words):
        versions.check_tag(tag, version)


def test_news_that_are_not_in_the_changelog_stop_a_release(checkout: Path) -> None:
    with pytest.raises(ReleaseError, match="2 news fragments"):
        changelog.section(checkout, "0.0.1")


def test_parts_with_different_versions_stop_a_release() -> None:
    plan = [reference for image in images.plan(REGISTRY, "1.2.0") for reference in image.references]
    agree("1.2.0", "1.2.0", ("1.2.0", "1.2.0"), set(plan[:2]), plan)
    with pytest.raises(ReleaseError, match="the versions differ"):
        agree("1.2.0", "1.1.0", ("1.2.0", "1.2.0"), set(plan[:2]), plan)
    with pytest.raises(ReleaseError, match="the versions differ"):
        agree("1.2.0", "1.2.0", ("1.2.0", "1.1.0"), set(plan[:2]), plan)
    with pytest.raises(ReleaseError, match="wheel and chart name the images"):
        agree("1.2.0", "1.2.0", ("1.2.0", "1.2.0"), {plan[0], "other:1"}, plan)


def test_there_is_an_image_of_workers_for_each_python() -> None:
    plan = images.plan(REGISTRY, "1.2.0")
    assert [image.name for image in plan] == ["operator", *(f"worker-py{p}" for p in PYTHONS)]
    references = [reference for image in plan for reference in image.references]
    assert len(set(references)) == len(references) == len(PYTHONS) + 2
    with pytest.raises(ReleaseError, match="no image 'wroker'"):
        images.named(plan, "wroker")


@pytest.mark.parametrize("registry", ["", "ghcr.io", "https://ghcr.io/x", "ghcr.io/x y"])
def test_a_registry_that_is_none(registry: str) -> None:
    with pytest.raises(ReleaseError, match="no place for images"):
        images.checked_registry(registry)
    assert images.checked_registry("ghcr.io/Fiber/") == "ghcr.io/fiber"


def fake_docker(folder: Path, answer: str) -> Path:
    """Write a ``docker`` that notes its arguments, and in which ``run`` prints the answer."""
    folder.mkdir()
    program = folder / "docker"
    program.write_text(
        f'#!/bin/sh\necho "$@" >>"{folder}/calls"\ncase "$1" in\n'
        f"run) echo {answer};;\n"
        f"image) echo other/x@sha256:1; echo {REGISTRY}/fiber-worker@{DIGEST};;\nesac\n"
    )
    program.chmod(0o755)
    return folder / "calls"


@pytest.fixture
def sdist(tmp_path: Path) -> Path:
    """A folder with the archive of a version that has nothing in it."""
    folder = tmp_path / "pypi"
    folder.mkdir()
    (tmp_path / "fiberpool-1.2.0").mkdir()
    command: list[str | Path] = ["tar", "czf", folder / "fiberpool-1.2.0.tar.gz", "fiberpool-1.2.0"]
    subprocess.run(command, cwd=tmp_path, check=True)
    return folder


def test_an_image_is_tried_before_it_is_pushed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sdist: Path
) -> None:
    calls = fake_docker(tmp_path / "bin", "1.2.0")
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:{os.environ['PATH']}")
    monkeypatch.setenv("GITHUB_OUTPUT", str(tmp_path / "told"))
    push_image(REGISTRY, f"worker-py{PYTHONS[0]}", sdist)
    lines = calls.read_text().splitlines()
    assert [line.split()[0] for line in lines] == ["build", "run", "push", "push", "image"]
    assert f"BASE_IMAGE=python:{PYTHONS[0]}-slim" in lines[0]
    assert lines[3] == f"push {REGISTRY}/fiber-worker:1.2.0"
    told = f"repository={REGISTRY}/fiber-worker\ndigest={DIGEST}\n"
    assert (tmp_path / "told").read_text() == told


def test_an_image_of_another_version_is_not_pushed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sdist: Path
) -> None:
    calls = fake_docker(tmp_path / "bin", "1.1.0")
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:{os.environ['PATH']}")
    with pytest.raises(ReleaseError, match=r"has version 1\.1\.0 instead of 1\.2\.0"):
        push_image(REGISTRY, f"worker-py{PYTHONS[0]}", sdist)
    assert "push" not in calls.read_text()
