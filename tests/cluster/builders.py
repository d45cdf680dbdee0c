"""Image builders: docker if its daemon runs, else buildah, which needs none."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from cluster import packages
from cluster.base_image import RELEASES, base_image
from cluster.buildah import BUILDAH, buildah
from cluster.shell import output, say, succeeds

_CERTIFICATES = "/run/secrets/certificates"
_PULL_PATIENCE = 90
# What reaches the package index; everything else of the host's settings is the host's business.
_PIP_SETTINGS = ("extra-index-url", "index-url", "proxy", "retries", "timeout", "trusted-host")


class Builder(ABC):
    """Builder that makes an archive from a Dockerfile of the project."""

    def base(self, wanted: str) -> str:
        """The base image to use where this one is wanted."""
        return wanted

    def build(
        self,
        reference: str,
        context: Path,
        dockerfile: str,
        arguments: Mapping[str, str],
        archive: Path,
    ) -> None:
        """Build the image under this reference and write it to the archive."""
        given = [word for pair in arguments.items() for word in ("--build-arg", "=".join(pair))]
        with secrets() as options:
            self._build(reference, context, ["--file", dockerfile, *given, *options, "."])
        archive.parent.mkdir(parents=True, exist_ok=True)
        unfinished = archive.with_suffix(".unfinished")
        unfinished.unlink(missing_ok=True)
        self.save(reference, unfinished)
        unfinished.rename(archive)

    @abstractmethod
    def _build(self, reference: str, context: Path, options: list[str]) -> None: ...

    @abstractmethod
    def save(self, reference: str, archive: Path) -> None:
        """Write an image that this builder has to an archive."""

    @abstractmethod
    def remove(self, reference: str) -> None:
        """Remove an image that is no longer needed, if it exists."""


class Docker(Builder):
    def _build(self, reference: str, context: Path, options: list[str]) -> None:
        environment = {**os.environ, "DOCKER_BUILDKIT": "1"}
        command = ("docker", "build", "--quiet", "--tag", reference, *options)
        output(*command, cwd=context, env=environment)

    def save(self, reference: str, archive: Path) -> None:
        output("docker", "save", "--output", archive, reference)

    def remove(self, reference: str) -> None:
        output("docker", "rmi", reference, check=False)


class Buildah(Builder):
    """Steps run in a chroot, which needs no more than root, and on the host's network."""

    def base(self, wanted: str) -> str:
        """The wanted one where a registry serves it, else one of Debian's packages."""
        python = re.fullmatch(r"python:(\d+\.\d+)-slim", wanted)
        if python is None:
            return wanted
        official = f"docker.io/library/{wanted}"
        known = buildah("images", "--format", "{{.Name}}:{{.Tag}}").split()
        if official in known or self._can_pull(official):
            return official
        version = python[1] if python[1] in RELEASES else next(iter(RELEASES))
        say(f"no registry serves {wanted}: using packages of Debian with Python {version}")
        return base_image(version)

    @staticmethod
    def _can_pull(reference: str) -> bool:
        return succeeds(*BUILDAH, "pull", "--quiet", reference, timeout=_PULL_PATIENCE)

    def _build(self, reference: str, context: Path, options: list[str]) -> None:
        command = ("bud", "--quiet", "--layers", "--isolation", "chroot", "--network", "host")
        # buildah keeps a step's cache here, longer than the caller keeps files.
        environment = {**os.environ, "TMPDIR": "/var/tmp"}
        output(*BUILDAH, *command, "--tag", reference, *options, cwd=context, env=environment)

    def save(self, reference: str, archive: Path) -> None:
        target = f"docker-archive:{archive}:{reference}"
        buildah("push", "--quiet", f"localhost/{reference}", target)

    def remove(self, reference: str) -> None:
        buildah("rmi", f"localhost/{reference}", check=False)


def choose() -> Builder:
    """docker, where `docker info` works, else buildah, installed where it is missing."""
    if shutil.which("docker") and succeeds("docker", "info"):
        return Docker()
    packages.need(packages.TO_BUILD_IMAGES, "build images")
    return Buildah()


@contextmanager
def secrets() -> Iterator[list[str]]:
    """The options that show pip in a build how this host reaches its package index.

    As secrets they are seen by the steps that ask for them, and are in no image and no layer.
    """
    with tempfile.TemporaryDirectory(prefix="fiber-build-") as folder:
        options = []
        settings, certificates = pip_settings(pip_config())
        certificates = certificates or os.environ.get("SSL_CERT_FILE")
        if certificates and Path(certificates).is_file():
            settings["cert"] = _CERTIFICATES
            options += ["--secret", f"id=certificates,src={certificates}"]
        file = Path(folder, "pip.conf")
        lines = [f"{key} = {value}" for key, value in sorted(settings.items())]
        file.write_text("\n".join(["[global]", *lines, ""]), encoding="utf-8")
        file.chmod(0o600)
        yield [*options, "--secret", f"id=pip,src={file}"]


def pip_config() -> list[str]:
    """The lines of `pip config list`; none where there is no pip."""
    command = (sys.executable, "-m", "pip", "config", "list")
    return subprocess.run(command, capture_output=True, text=True).stdout.splitlines()


def pip_settings(listed: Iterable[str]) -> tuple[dict[str, str], str | None]:
    """Read `pip config list`: settings that matter to a build, and the host's certificates.

    Of two places that say the same thing the environment wins, as in pip.
    """
    found = {}
    for line in sorted(listed, key=lambda line: line.startswith(":env:")):
        name, _, value = line.partition("=")
        section, _, key = name.partition(".")
        if section in ("global", "install", "download", ":env:"):
            found[key.removeprefix("default-")] = value.strip().strip("'\"")
    wanted = {key: found[key].replace("\\n", "\n    ") for key in _PIP_SETTINGS if key in found}
    return wanted, found.get("cert")
