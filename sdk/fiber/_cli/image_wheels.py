"""Wheels of packages that no index has, made on this machine."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import click

from fiber._cli.failures import CommandError
from fiber._cli.image_packages import FIBER, Package, canonical

_USER = re.compile(r"//[^/@\s]+@")
"""User and password in a URL, which no message shows."""

_FOR_LINUX = ("any", "linux", "manylinux", "musllinux")


def make_wheels(packages: Sequence[Package], folder: Path) -> None:
    """Make a wheel of each package in ``folder``; name all that cannot be made in one error."""
    folder.mkdir(parents=True, exist_ok=True)
    problems = {}
    for package in packages:
        click.echo(f"making a wheel of {package.name}", err=True)
        if problem := package.problem or _make(package, folder):
            problems[package.name] = problem
    if problems:
        raise _cannot(problems)


def _cannot(problems: dict[str, str]) -> CommandError:
    why = "; ".join(f"{name}: {problem}" for name, problem in problems.items())
    others = [f"--without {name}" for name in problems if canonical(name) != FIBER]
    remedy = "install from an index or an existing folder"
    return CommandError(
        f"cannot put {', '.join(problems)} into the image",
        why,
        f"{remedy}, or leave out what tasks do not import: {' '.join(others)}"
        if others
        else remedy,
    )


def _make(package: Package, folder: Path) -> str:
    """Make the wheel; return why it cannot be made, or nothing."""
    source = Path(package.made_of)
    if source.suffix == ".whl" and source.is_file():
        shutil.copy(source, folder)
        return _judged([folder / source.name])
    before = set(folder.iterdir())
    done = _run(package, folder)
    made = sorted(set(folder.iterdir()) - before)
    if done.returncode or not made:
        return _last_words(done.stdout + done.stderr)
    return _judged(made)


def _run(package: Package, folder: Path) -> subprocess.CompletedProcess[str]:
    # A file, because the arguments of a process are visible to all: the URL may have a password.
    path = Path(package.made_of)
    line = path.resolve().as_uri() if path.exists() else package.made_of
    with tempfile.NamedTemporaryFile("w", suffix=".txt", encoding="utf-8") as file:
        file.write(f"{line}\n")
        file.flush()
        command = _tool(package, folder, file.name)
        return subprocess.run(command, check=False, capture_output=True, text=True)


def _tool(package: Package, folder: Path, file: str) -> list[str]:
    if importlib.util.find_spec("pip"):
        words = ["wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), "-r", file]
        return [sys.executable, "-m", "pip", "--disable-pip-version-check", *words]
    if shutil.which("uv") and Path(package.made_of).exists():
        return ["uv", "build", "--quiet", "--wheel", "--out-dir", str(folder), package.made_of]
    raise CommandError(
        f"cannot make a wheel of {package.name}",
        "this environment has no pip",
        f"install it: `{sys.executable} -m ensurepip`, or `uv pip install pip`",
    )


def _judged(made: Sequence[Path]) -> str:
    """Return why a wheel does not fit into an image of Linux, or nothing."""
    for wheel in made:
        tag = wheel.stem.rpartition("-")[2]
        if not tag.startswith(_FOR_LINUX):
            return f"its wheel is for {tag}, and the image is for Linux"
    return ""


def _last_words(text: str) -> str:
    """Return the last error in the output of pip."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if line.lower().startswith("error")]
    said = (errors or lines or ["pip made no wheel"])[-1]
    return _USER.sub("//", said.removeprefix("ERROR: "))
