"""Installed packages and builders of images, made up for a test."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fiber._cli import image_pip

BACKEND = """\
import zipfile

def build_wheel(folder, settings=None, metadata=None):
    name = "mine-1.0-py3-none-any.whl"
    with zipfile.ZipFile(f"{folder}/{name}", "w") as wheel:
        info = "mine-1.0.dist-info"
        wheel.writestr(f"{info}/METADATA", "Metadata-Version: 2.1\\nName: mine\\nVersion: 1.0\\n")
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\\nTag: py3-none-any\\n")
        wheel.writestr(f"{info}/RECORD", "")
    return name
"""
"""Backend that builds a wheel with the standard library alone, so that pip downloads nothing."""

BUILDER = """\
#!/bin/sh
echo "$(basename $0) $*" >> {log}
for word; do last=$word; done
case "$1" in
    build|bud)
        rm -rf {seen}; cp -r "$last" {seen}
        for word; do
            case $word in id=pip,src=*) cp "${{word#id=pip,src=}}" {seen}/pip.conf;; esac
        done
        ;;
esac
{then}
"""
"""Builder that logs its arguments, and keeps a copy of the context and of the secret."""


class Environment:
    """Folder with the metadata of installed packages; the only one that a test sees."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()

    def install(
        self, name: str, version: str = "1.0", origin: Any = None, installer: str = "pip"
    ) -> None:
        info = self.folder / f"{name}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        (info / "INSTALLER").write_text(f"{installer}\n")
        if origin is not None:
            (info / "direct_url.json").write_text(json.dumps(origin))

    def distributions(self, **context: Any) -> Iterator[importlib.metadata.Distribution]:
        return iter(importlib.metadata.MetadataPathFinder.find_distributions(self._context()))

    def _context(self) -> importlib.metadata.DistributionFinder.Context:
        return importlib.metadata.DistributionFinder.Context(path=[str(self.folder)])


def environment(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Environment:
    """Return an environment that has Fiber, from an index, and no settings of pip."""
    made = Environment(folder / "site")
    made.install("fiberpool", "0.1")
    monkeypatch.setattr(importlib.metadata, "distributions", made.distributions)
    monkeypatch.setattr(image_pip, "_listed", list)
    for name in ("SSL_CERT_FILE", "UV_DEFAULT_INDEX", "UV_INDEX_URL", "UV_EXTRA_INDEX_URL"):
        monkeypatch.delenv(name, raising=False)
    return made


def project(folder: Path) -> Path:
    """Make a project whose wheel needs no download, and return its folder."""
    folder.mkdir(parents=True)
    (folder / "backend.py").write_text(BACKEND)
    (folder / "pyproject.toml").write_text(
        '[project]\nname = "mine"\nversion = "1.0"\n[build-system]\nrequires = []\n'
        'build-backend = "backend"\nbackend-path = ["."]\n'
    )
    return folder


class Builders:
    """Programs of this test on the PATH, which has no other builder."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._programs = folder / "bin"
        self._programs.mkdir()
        self.log = folder / "log"
        self.seen = folder / "seen"
        system = folder / "system"
        system.mkdir()
        for name in ("basename", "cp", "rm"):
            (system / name).symlink_to(f"/bin/{name}")
        monkeypatch.setenv("PATH", f"{self._programs}:{system}")

    def add(self, name: str, then: str = "exit 0") -> None:
        program = self._programs / name
        program.write_text(BUILDER.format(log=self.log, seen=self.seen, then=then))
        program.chmod(0o755)

    def calls(self) -> list[str]:
        return self.log.read_text().splitlines() if self.log.exists() else []
