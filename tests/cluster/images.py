"""Fiber's images: built where their inputs changed, and brought to the nodes.

An image's tag is a digest of all that it is made of. So a tag never means two things, nodes that
have it need not load it again, and checkouts that share a cluster do not get in each other's way.
On the nodes, what was brought last bears the version as well, which chart and manifests name.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from cluster import builders, places
from cluster.containerd import Containerd
from cluster.shell import ClusterError, locked, say

FOLDER = places.CHECKOUT / "build" / "images"
VERSION_FILE = "sdk/fiber/__init__.py"
ALWAYS = (".dockerignore", "LICENSE", "README.md", "pyproject.toml")


@dataclass(frozen=True)
class Image:
    """Image of the project: its name and its inputs below the checkout."""

    name: str
    dockerfile: str
    sources: tuple[str, ...]
    arguments: Mapping[str, str] = field(default_factory=dict)
    """Build arguments of the Dockerfile, beside those that every build has."""
    made_from: Image | None = None
    """Image of the project that it is built on, if it is not Python's."""

    @property
    def archive(self) -> Path:
        return FOLDER / f"{self.name}.tar"

    @property
    def record(self) -> Path:
        """Beside the archive: which reference is in it."""
        return FOLDER / f"{self.name}.json"

    def archived(self) -> str | None:
        """Return the reference of the image in the archive; None if the archive is missing or
        incomplete.
        """
        try:
            record = json.loads(self.record.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return str(record["reference"]) if self.archive.exists() else None

    def inputs(self, checkout: Path) -> Iterator[Path]:
        """Every file that the image depends on, in the order of their names."""
        for name in sorted({self.dockerfile, *ALWAYS, *self.sources}):
            path = checkout / name
            found = sorted(path.rglob("*")) if path.is_dir() else [path]
            yield from (file for file in found if file.is_file() and not _is_cache(file))

    def copy_inputs(self, checkout: Path, target: Path) -> None:
        """Copy them to an empty folder, with their modification times, by which builders find
        changes.
        """
        for file in self.inputs(checkout):
            copy = target / file.relative_to(checkout)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(file, copy)

    def reference(self, checkout: Path, base: str) -> str:
        """The name with its tag: a digest of the inputs, the arguments and the base's name."""
        digest = hashlib.sha256(base.encode())
        for argument in sorted(self.arguments.items()):
            digest.update(f"\0{'='.join(argument)}".encode())
        for file in self.inputs(checkout):
            content = file.read_bytes()
            digest.update(f"\0{file.relative_to(checkout)}\0{len(content)}\0".encode())
            digest.update(content)
        return f"{self.name}:{digest.hexdigest()[:12]}"

    def released(self, checkout: Path) -> str:
        """The name with the version as its tag, as chart and manifests have it."""
        return f"{self.name}:{_version(checkout)}"


OPERATOR = Image(
    "fiber-operator",
    "operator/Dockerfile",
    ("crds/fiber_api", "operator/fiber_operator", VERSION_FILE),
)
_WORKER_SOURCES = ("crds/fiber_api", "sdk/fiber")
WORKER = Image("fiber-worker", "sdk/Dockerfile", _WORKER_SOURCES)
WORKER_RL = Image(
    "fiber-worker-rl", "sdk/Dockerfile", _WORKER_SOURCES, {"EXTRAS": "kubernetes,metrics,rl"}
)
"""Image that contains the packages that the examples import."""
IMAGES = (OPERATOR, WORKER, WORKER_RL)
SEARCH = Image("fiber-search", "examples/05-search/Dockerfile", (VERSION_FILE,), made_from=WORKER)
"""Image that a user builds from the worker's: only the tests that need it build it."""
PUBLISHED = Image(
    "fiber-published",
    "tests/published/Dockerfile",
    ("tests/published/requirements.txt", VERSION_FILE),
    made_from=WORKER,
)
"""Image with the packages of the published programs."""


def _is_cache(file: Path) -> bool:
    return file.parent.name == "__pycache__"


def default_base() -> str:
    """The base image that is asked for: BASE_IMAGE, else Python as it runs this.

    A worker and its master need the same minor version, and the tests are the master.
    """
    major, minor = sys.version_info[:2]
    return os.environ.get("BASE_IMAGE") or f"python:{major}.{minor}-slim"


def build_images() -> dict[str, str]:
    """Build what is out of date. Returns the reference that is in each image's archive."""
    with _locked():
        return {image.name: _up_to_date(image) for image in IMAGES}


def bring_images() -> dict[str, str]:
    """Build what is out of date and import it into every node of the project's cluster."""
    with _locked():  # no other process may replace an archive between the two
        references = {image.name: _up_to_date(image) for image in IMAGES}
        for image in IMAGES:
            load(image.archive, references[image.name])
            for index in places.nodes():
                reference = full_name(references[image.name])
                Containerd(index).tag(reference, full_name(image.released(places.CHECKOUT)))
        return references


def bring(image: Image) -> str:
    """Build one where it is out of date and import it into every node; returns its reference."""
    with _locked():
        reference = _up_to_date(image)
        load(image.archive, reference)
        return reference


def build(image: Image) -> str:
    """Build one where it is out of date; returns its reference."""
    with _locked():
        return _up_to_date(image)


def brought(image: Image) -> str | None:
    """Return the reference of the last build, if all nodes of the project's cluster have it."""
    reference = image.archived()
    if reference is None:
        return None
    nodes = [Containerd(index) for index in places.nodes()]
    return reference if nodes and all(node.has(full_name(reference)) for node in nodes) else None


def _locked() -> AbstractContextManager[None]:
    return locked(FOLDER / "lock", "builds the images")


def _up_to_date(image: Image) -> str:
    base = default_base() if image.made_from is None else _up_to_date(image.made_from)
    # Built from a copy: an image holds what its tag says, though files are edited meanwhile.
    with tempfile.TemporaryDirectory(prefix="fiber-build-") as folder:
        context = Path(folder)
        image.copy_inputs(places.CHECKOUT, context)
        reference = image.reference(context, base)
        if image.archived() != reference:
            _build(image, reference, base, context)
    return reference


def _build(image: Image, reference: str, base: str, context: Path) -> None:
    builder, python = builder_and_base()
    if image.made_from is None:
        base = python  # the builder's reference under the name
    say(f"building {reference} on {base}")
    began = time.monotonic()
    previous = image.archived()
    image.record.unlink(missing_ok=True)
    arguments = {"BASE_IMAGE": base, "VERSION": _version(context), **image.arguments}
    builder.build(reference, context, image.dockerfile, arguments, image.archive)
    image.record.write_text(json.dumps({"reference": reference, "base": base}), encoding="utf-8")
    if previous not in (None, reference):
        builder.remove(previous)
    say(f"built {image.archive.relative_to(places.CHECKOUT)} in {time.monotonic() - began:.0f} s")


@cache
def builder_and_base() -> tuple[builders.Builder, str]:
    """Chosen once for all images: to find out that no registry answers takes seconds."""
    builder = builders.choose()
    return builder, builder.base(default_base())


def _version(checkout: Path) -> str:
    text = (checkout / VERSION_FILE).read_text(encoding="utf-8")
    found = re.search(r'^__version__ = "(.+)"', text, re.MULTILINE)
    if found is None:
        raise ClusterError(f"{VERSION_FILE} has no line `__version__ = …`")
    return found[1]


def load(archive: Path, reference: str | None = None) -> None:
    """Import an archive into every node that lacks the reference."""
    nodes = [Containerd(index) for index in places.nodes()]
    wanting = [node for node in nodes if reference is None or not node.has(full_name(reference))]
    with ThreadPoolExecutor() as pool:
        for _ in pool.map(lambda node: node.load(archive), wanting):
            pass


@contextmanager
def saved(reference: str) -> Iterator[Path]:
    """Yield an archive of an image that the builder has."""
    builder, _ = builder_and_base()
    with tempfile.TemporaryDirectory(prefix="fiber-image-", dir="/var/tmp") as folder:
        archive = Path(folder, "image.tar")
        builder.save(reference, archive)
        yield archive


def unload(reference: str) -> None:
    """Remove an image from every node."""
    for index in places.nodes():
        Containerd(index).remove(full_name(reference))


def full_name(reference: str) -> str:
    """Return containerd's name for an image that a pod names without a registry."""
    return f"docker.io/library/{reference}"
