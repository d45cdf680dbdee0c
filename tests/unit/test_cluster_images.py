"""Fiber's images: a tag stands for contents, and an image is built when these have changed."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from cluster import builders, images, places
from cluster.builders import Builder
from cluster.images import IMAGES, OPERATOR, SEARCH, WORKER, Image
from cluster.shell import ClusterError

BASE = "python:3.11-slim"
SDK_MODULE = "sdk/fiber/pool.py"
OPERATOR_MODULE = "operator/fiber_operator/pods.py"
SHARED_MODULE = "crds/fiber_api/names.py"


@pytest.fixture(autouse=True)
def checkout(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A small tree with all that an image is made of."""
    root = tmp_path / "checkout"
    dockerfiles = [image.dockerfile for image in (*IMAGES, SEARCH)]
    for name in (*images.ALWAYS, *dockerfiles, SDK_MODULE, OPERATOR_MODULE, SHARED_MODULE):
        write(root / name, f"of {name}")
    write(root / images.VERSION_FILE, '__version__ = "1.2.3"\n')
    monkeypatch.setattr(places, "CHECKOUT", root)
    monkeypatch.setattr(images, "FOLDER", root / "build/images")
    monkeypatch.delenv("BASE_IMAGE", raising=False)
    return root


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


class Notebook(Builder):
    """A builder that writes down what it was asked for, and what it could see."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.seen: set[str] = set()
        self.options: list[str] = []
        self.fails = False
        self.removed: list[str] = []

    def base(self, wanted: str) -> str:
        return f"base-of-{wanted}"

    def _build(self, reference: str, context: Path, options: list[str]) -> None:
        if self.fails:
            raise ClusterError("the builder is unwell")
        self.asked.append(reference)
        self.options = options
        files = (path for path in context.rglob("*") if path.is_file())
        self.seen = {str(path.relative_to(context)) for path in files}

    def save(self, reference: str, archive: Path) -> None:
        archive.write_text(reference)

    def remove(self, reference: str) -> None:
        self.removed.append(reference)


@pytest.fixture
def builder(monkeypatch: pytest.MonkeyPatch) -> Notebook:
    notebook = Notebook()
    monkeypatch.setattr(builders, "choose", lambda: notebook)
    monkeypatch.setattr(builders, "pip_config", list)
    images.builder_and_base.cache_clear()
    return notebook


@pytest.mark.parametrize("image", IMAGES, ids=lambda image: image.name)
def test_a_tag_stands_for_contents(image: Image, checkout: Path) -> None:
    before = image.reference(checkout, BASE)
    os.utime(checkout / SHARED_MODULE, (0, 0))
    write(checkout / "crds/fiber_api/__pycache__/names.pyc", "compiled")
    write(checkout / "docs/index.md", "not in any image")
    write(checkout / (SDK_MODULE if image is OPERATOR else OPERATOR_MODULE), "the other side's")
    assert image.reference(checkout, BASE) == before
    assert image.reference(checkout, "python:3.13-slim") != before
    write(checkout / SHARED_MODULE, "something else")
    assert image.reference(checkout, BASE) != before


def test_a_tag_identifies_the_files(checkout: Path) -> None:
    write(checkout / "sdk/fiber/a.py", "xy")
    write(checkout / "sdk/fiber/b.py", "")
    before = WORKER.reference(checkout, BASE)
    write(checkout / "sdk/fiber/a.py", "x")
    write(checkout / "sdk/fiber/b.py", "y")
    assert WORKER.reference(checkout, BASE) != before


def test_changed_images_and_missing_archives_alone_are_built(
    builder: Notebook, checkout: Path
) -> None:
    first = images.build_images()
    assert builder.asked == list(first.values())
    assert list(first) == ["fiber-operator", "fiber-worker", "fiber-worker-rl"]
    tags = {name: reference.partition(":")[2] for name, reference in first.items()}
    assert tags["fiber-worker"] != tags["fiber-worker-rl"]
    for image in IMAGES:
        assert image.archive.read_text() == image.archived() == first[image.name]
    assert images.build_images() == first
    write(checkout / OPERATOR_MODULE, "something else")
    second = images.build_images()
    assert builder.asked[3:] == [second["fiber-operator"]]
    assert builder.removed == [first["fiber-operator"]]
    assert second["fiber-worker"] == first["fiber-worker"]
    WORKER.archive.unlink()
    assert images.build_images() == second
    assert builder.asked[4:] == [second["fiber-worker"]]


def test_a_build_that_fails_is_done_again(builder: Notebook, checkout: Path) -> None:
    images.build_images()
    write(checkout / SDK_MODULE, "something else")
    builder.fails = True
    with pytest.raises(ClusterError, match="unwell"):
        images.build_images()
    assert WORKER.archived() is None
    builder.fails = False
    references = images.build_images()
    assert builder.asked[3:] == [references["fiber-worker"], references["fiber-worker-rl"]]


def test_an_image_is_built_again_when_its_base_image_changes(
    builder: Notebook, checkout: Path
) -> None:
    first = images.build(SEARCH)
    worker = WORKER.archived()
    assert worker is not None
    assert builder.asked == [worker, first]
    assert f"BASE_IMAGE={worker}" in builder.options
    assert images.build(SEARCH) == first
    write(checkout / SDK_MODULE, "something else")
    second = images.build(SEARCH)
    assert second != first
    assert builder.asked[2:] == [WORKER.archived(), second]
    assert builder.removed == [worker, first]


def test_a_build_sees_the_inputs_the_base_and_the_version_alone(
    builder: Notebook, checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BASE_IMAGE", "python:3.13-slim")
    write(checkout / "secret.txt", "not for the image")
    images.build_images()  # the last image is the worker's with the packages of the examples
    sources = {"sdk/Dockerfile", SHARED_MODULE, SDK_MODULE, images.VERSION_FILE}
    assert builder.seen == {*images.ALWAYS, *sources}
    for option in (
        "BASE_IMAGE=base-of-python:3.13-slim",
        "VERSION=1.2.3",
        "EXTRAS=kubernetes,metrics,rl",
    ):
        assert option in builder.options


class FakeNode:
    """A containerd that takes the reference that a Notebook wrote into the archive."""

    def __init__(self) -> None:
        self.there: set[str] = set()
        self.loaded: list[Path] = []
        self.names: dict[str, str] = {}

    def has(self, reference: str) -> bool:
        return reference in self.there

    def load(self, archive: Path) -> None:
        self.loaded.append(archive)
        self.there.add(images.full_name(archive.read_text()))

    def tag(self, reference: str, other: str) -> None:
        assert reference in self.there
        self.names[other] = reference


def test_nodes_get_the_images_that_they_lack_under_the_version(
    builder: Notebook, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes = {index: FakeNode() for index in (1, 2)}
    monkeypatch.setattr(places, "nodes", lambda: list(nodes))
    monkeypatch.setattr(images, "Containerd", lambda index: nodes[index])
    assert images.brought(WORKER) is None
    references = images.bring_images()
    worker = references["fiber-worker"]
    assert images.brought(WORKER) == worker
    nodes[2].there.remove(images.full_name(worker))
    assert images.brought(WORKER) is None
    images.bring_images()
    assert images.bring(SEARCH) == SEARCH.archived()
    for node in nodes.values():
        assert node.names == {
            f"docker.io/library/{name}:1.2.3": images.full_name(reference)
            for name, reference in references.items()
        }
    archives = [image.archive for image in IMAGES]
    assert nodes[1].loaded == [*archives, SEARCH.archive]
    assert nodes[2].loaded == [*archives, WORKER.archive, SEARCH.archive]


# The files of the repository itself.

ROOT = Path(__file__).resolve().parents[2]


def copied(dockerfile: str) -> list[str]:
    """Return the files that a Dockerfile takes from its context."""
    lines = (ROOT / dockerfile).read_text(encoding="utf-8").splitlines()
    words = [line.split() for line in lines if line.startswith("COPY ") and "--from" not in line]
    return [source for line in words for source in line[1:-1]]


def covers(path: str, other: str) -> bool:
    """Return whether one path is the other or above it."""
    return Path(other).is_relative_to(path)


@pytest.mark.parametrize("image", IMAGES, ids=lambda image: image.name)
def test_copied_files_are_inputs(image: Image) -> None:
    inputs = (*image.sources, *images.ALWAYS)
    for source in copied(image.dockerfile):
        assert any(covers(source, name) or covers(name, source) for name in inputs), source


@pytest.mark.parametrize("image", IMAGES, ids=lambda image: image.name)
def test_dockerignore_includes_the_inputs_of_each_image(image: Image) -> None:
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    passed = [line.removeprefix("!") for line in lines if line.startswith("!")]
    for name in (*image.sources, *images.ALWAYS[1:]):
        assert any(covers(line, name) for line in passed), name


@pytest.mark.parametrize("image", IMAGES, ids=lambda image: image.name)
def test_dockerfiles_keep_to_the_rules(image: Image) -> None:
    """A base that can be chosen, no floating tag, an ordinary user by number."""
    text = (ROOT / image.dockerfile).read_text(encoding="utf-8")
    assert text.count(f"ARG BASE_IMAGE={BASE}\n") == 1
    assert set(re.findall(r"^FROM (\S+)", text, re.MULTILINE)) == {"${BASE_IMAGE}"}
    assert "latest" not in text
    assert re.findall(r"^USER (.+)$", text, re.MULTILINE)[-1] == "65532:65532"
