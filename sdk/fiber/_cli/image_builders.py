"""Builders of images: docker, podman or buildah."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import click

from fiber._cli.failures import CommandError
from fiber._cli.image_context import MARK, PYTHON

_NOT_FOUND = re.compile(r"No matching distribution found for ([^\s;]+)")
_NOT_BUILT = re.compile(
    r"(?:Failed building wheel for|Could not build wheels for|Failed to build) '?([-\w.]+)"
)
_NO_INDEX = re.compile(
    r"Failed to establish a new connection|Temporary failure in name resolution"
    r"|CERTIFICATE_VERIFY_FAILED|Connection(?: was)? (?:refused|timed out|broken)"
)
_NO_BASE = re.compile(
    r"pull access denied|manifest unknown|initializing source docker|failed to resolve source"
    r"|short-name|error pulling image"
)
_NO_LOGIN = re.compile(r"unauthori[sz]ed|denied|authentication required", re.IGNORECASE)


class Builder(NamedTuple):
    """Program that builds images."""

    name: str

    def build(self, context: Path, tag: str, options: Sequence[str]) -> None:
        """Build the image of a context."""
        verb = "bud" if self.name == "buildah" else "build"
        layers = () if self.name == "docker" else ("--layers",)
        command = [self.name, verb, *layers, "--tag", tag, *options, str(context)]
        status, said = _followed(command)
        if status:
            raise failure(self.name, tag, said)

    def push(self, tag: str) -> None:
        """Push the image to its registry."""
        status, said = _followed([self.name, "push", tag])
        if status:
            login = f"`{self.name} login {registry_of(tag)}`"
            refused = _NO_LOGIN.search(said)
            raise CommandError(
                f"cannot push {tag}",
                _last(said),
                f"log in with an account that may push: {login}"
                if refused
                else f"check the name and the network, then `{self.name} push {tag}`",
            )


def choose() -> Builder:
    """Return docker if its daemon answers, else podman or buildah."""
    if shutil.which("docker") and _succeeds("docker", "info"):
        return Builder("docker")
    for name in ("podman", "buildah"):
        if shutil.which(name):
            return Builder(name)
    raise CommandError(
        "cannot build an image",
        "docker does not answer, and podman and buildah are not installed"
        if shutil.which("docker")
        else "docker, podman and buildah are not installed",
        "install one of them, for example `apt install podman`, or write the context with "
        "--file-only and build it elsewhere",
    )


def registry_of(tag: str) -> str:
    """Return the registry in the name of an image."""
    first, slash, _ = tag.partition("/")
    is_host = slash and ("." in first or ":" in first or first == "localhost")
    return first if is_host else "docker.io"


def failure(builder: str, tag: str, said: str) -> CommandError:
    """Return the error for a build that failed with this output."""
    for what, why, remedy in _diagnoses(said):
        return CommandError(f"cannot build {tag}: {what}", why, remedy)
    return CommandError(
        f"cannot build {tag}", f"{builder}: {_last(said)}", "see the output above this message"
    )


def _diagnoses(said: str) -> Iterator[tuple[str, str, str]]:
    """Yield what went wrong, why, and what to do, the likeliest first."""
    yield from _refusals_of_the_base(said)
    if silent := _NO_INDEX.search(said):
        yield (
            "no package index answers",
            f"pip says: {silent[0]}",
            "check the network of the build; pip's settings of this machine hold there, too "
            "(`pip config list`): index-url, proxy, cert",
        )
    if found := _list_of(_NOT_FOUND, said):
        bare = [re.split("[=<>!~@]", name)[0] for name in found]
        yield (
            f"no index has {', '.join(found)}",
            "pip found it neither on pypi.org nor on the indexes of its configuration, for this "
            "Python and platform",
            "name its index (`pip config set global.extra-index-url URL`), or leave out what tasks "
            f"do not import: {_without(bare)}",
        )
    if found := _list_of(_NOT_BUILT, said):
        yield (
            f"{', '.join(found)} cannot be compiled in it",
            "its index has no wheel for this Python and platform, and the base image may lack a "
            "compiler",
            f"use a base that has one, such as --base python:{PYTHON}, or {_without(found)}",
        )


def _refusals_of_the_base(said: str) -> Iterator[tuple[str, str, str]]:
    for line in said.splitlines():
        _, mark, why = line.partition(f"{MARK} ")
        if mark and "sys.exit" not in line:
            yield "wrong Python", why.strip(), f"name a base with Python {PYTHON}: --base IMAGE"
    if _NO_BASE.search(said):
        yield (
            "the base image cannot be had",
            _last(said),
            f"name one that this machine has or can pull, with Python {PYTHON}: --base IMAGE",
        )


def _list_of(pattern: re.Pattern[str], said: str) -> list[str]:
    return list(dict.fromkeys(pattern.findall(said)))


def _without(names: Sequence[str]) -> str:
    return " ".join(f"--without {name}" for name in names)


def _last(said: str) -> str:
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    errors = [line for line in lines if re.match(r"(?i)error|.* error:", line)]
    return (errors or lines or ["it said nothing"])[-1]


def _followed(command: Sequence[str]) -> tuple[int, str]:
    """Run a command and show its output while it runs; return its status and output."""
    environment = {**os.environ, "DOCKER_BUILDKIT": "1"}
    lines = []
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            lines.append(line)
            click.echo(line, err=True, nl=False)
    return process.returncode, "".join(lines)


def _succeeds(*command: str) -> bool:
    try:
        return subprocess.run(command, check=False, capture_output=True, timeout=30).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False
