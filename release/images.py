"""Images of a release: the operator's, and one of workers for each version of Python."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from fiber._backends.kubernetes.published import OPERATOR, PYTHONS, WORKER
from release import ReleaseError, output

PLATFORM = "linux/amd64"
"""Platform of all images.  The tests run on no other one."""

_REGISTRY = re.compile(r"[a-z0-9.-]+(:[0-9]+)?(/[a-z0-9]+([._-]+[a-z0-9]+)*)+")


@dataclass(frozen=True)
class ReleaseImage:
    """Image of a release."""

    name: str
    """Name in this project, by which the workflow asks for it."""
    dockerfile: str
    base: str
    repository: str
    tags: tuple[str, ...]
    trial: str
    """Python statement that must succeed in the image, and print the version of its package."""

    @property
    def references(self) -> list[str]:
        return [f"{self.repository}:{tag}" for tag in self.tags]


def checked_registry(registry: str) -> str:
    """Return the registry with its path in lower case, as references need it."""
    registry = registry.lower().rstrip("/")
    if not _REGISTRY.fullmatch(registry):
        raise ReleaseError(
            f"{registry!r} is no place for images: it has no host and path, such as "
            "registry.example/team. Give --registry such a place"
        )
    return registry


def plan(registry: str, version: str) -> list[ReleaseImage]:
    """Return all images.  The first Python's has a tag without the Python, which charts name."""
    operator = ReleaseImage(
        "operator",
        "operator/Dockerfile",
        f"python:{PYTHONS[0]}-slim",
        f"{registry}/{OPERATOR}",
        (version,),
        "import fiber_operator",
    )
    workers = [
        ReleaseImage(
            f"worker-py{python}",
            "sdk/Dockerfile",
            f"python:{python}-slim",
            f"{registry}/{WORKER}",
            (f"{version}-py{python}", *((version,) if python == PYTHONS[0] else ())),
            "import fiber; print(fiber.__version__)",
        )
        for python in PYTHONS
    ]
    return [operator, *workers]


def named(images: list[ReleaseImage], name: str) -> ReleaseImage:
    """Return the image of this name."""
    for image in images:
        if image.name == name:
            return image
    names = ", ".join(image.name for image in images)
    raise ReleaseError(f"there is no image {name!r} in a release. Choose one of {names}")


def push(image: ReleaseImage, version: str, sources: Path) -> str:
    """Build the image from the sources of the release, try it, push it, and return its digest."""
    arguments = {"BASE_IMAGE": image.base, "VERSION": version}
    given = [word for pair in arguments.items() for word in ("--build-arg", "=".join(pair))]
    tags = [word for reference in image.references for word in ("--tag", reference)]
    first = image.references[0]
    options = ("--platform", PLATFORM, "--file", image.dockerfile)
    output("docker", "build", *options, *given, *tags, ".", cwd=sources)
    said = output("docker", "run", "--rm", "--entrypoint", "python", first, "-c", image.trial)
    if said.strip() not in ("", version):
        raise ReleaseError(
            f"the image {first} has version {said.strip()} instead of {version}. Build it from the "
            "sources of this release"
        )
    for reference in image.references:
        output("docker", "push", reference)
    format_ = '{{join .RepoDigests " "}}'
    digests = output("docker", "image", "inspect", "--format", format_, first)
    return _digest(digests, image.repository)


def _digest(lines: str, repository: str) -> str:
    for line in lines.split():
        place, _, digest = line.partition("@")
        if place == repository:
            return digest
    raise ReleaseError(
        f"the image {repository} has no digest after it was pushed: {lines.strip() or 'none'}. "
        "Look for it in the registry, and run this again"
    )
