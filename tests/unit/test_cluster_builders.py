"""Smoke tests of the builders of images: docker or buildah, the base and the settings of pip."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from cluster import builders
from cluster.builders import Buildah, Builder, Docker


def install(monkeypatch: pytest.MonkeyPatch, folder: Path, name: str, script: str) -> None:
    program = folder / name
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")


@pytest.mark.parametrize(
    ("docker", "chosen"),
    [("exit 0", Docker), ("echo 'no daemon' >&2; exit 1", Buildah)],
    ids=["daemon", "command-alone"],
)
def test_buildah_builds_where_the_daemon_of_docker_does_not_run(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, docker: str, chosen: type[Builder]
) -> None:
    install(monkeypatch, tmp_path, "docker", docker)
    install(monkeypatch, tmp_path, "buildah", "exit 0")
    assert isinstance(builders.choose(), chosen)


@pytest.mark.parametrize(
    ("pulls", "wanted", "base"),
    [
        ("exit 0", "python:3.11-slim", "docker.io/library/python:3.11-slim"),
        ("exit 1", "python:3.11-slim", "made of packages for 3.11"),
        ("exit 1", "registry.example/our-python:1", "registry.example/our-python:1"),
    ],
    ids=["registry", "no-registry", "chosen"],
)
def test_a_base_is_pulled_or_made_of_packages(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, pulls: str, wanted: str, base: str
) -> None:
    install(monkeypatch, tmp_path, "buildah", f'case "$*" in *pull*) {pulls};; esac')
    monkeypatch.setattr(builders, "base_image", lambda python: f"made of packages for {python}")
    assert Buildah().base(wanted) == base


def test_docker_builds_in_the_context_and_saves_the_archive(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    called, archive = tmp_path / "called", tmp_path / "out" / "image.tar"
    script = f'echo "$PWD: $*" >> {called}; [ "$1" = build ] || touch "$3"'
    install(monkeypatch, tmp_path, "docker", script)
    Docker().build("image:1", tmp_path, "Dockerfile", {"BASE_IMAGE": "base:1"}, archive)
    built, saved = called.read_text().splitlines()
    assert built.startswith(f"{tmp_path}: build --quiet --tag image:1 --file Dockerfile")
    assert " --build-arg BASE_IMAGE=base:1 " in built
    assert saved.endswith(" image:1")
    assert archive.exists()


def test_a_build_gets_the_settings_of_pip_as_a_secret_that_is_removed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    certificates = tmp_path / "certificates.crt"
    certificates.write_text("trusted")
    listed = [
        ":env:.index-url='https://one.example'",
        "global.index-url='https://two.example'",
        r"global.extra-index-url='\nhttps://three.example\nhttps://four.example'",
        f"global.cert='{certificates}'",
        "global.disable-pip-version-check='1'",
        ":env:.default-timeout='180'",
    ]
    monkeypatch.setattr(builders, "pip_config", lambda: listed)
    with builders.secrets() as options:
        assert options[:2] == ["--secret", f"id=certificates,src={certificates}"]
        file = Path(options[3].removeprefix("id=pip,src="))
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        said = file.read_text().split()
    assert not file.exists()
    assert said[:4] == ["[global]", "cert", "=", "/run/secrets/certificates"]
    for words in (
        ["index-url", "=", "https://one.example"],
        ["https://three.example", "https://four.example"],
        ["timeout", "=", "180"],
    ):
        assert " ".join(words) in " ".join(said)
    assert "two.example" not in " ".join(said)
