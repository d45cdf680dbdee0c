"""docker or buildah, the base image, and what a build is told of the host's package index."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from cluster import base_image, builders
from cluster.builders import Buildah, Docker, choose, pip_settings, secrets
from cluster.shell import ClusterError


def install(monkeypatch: pytest.MonkeyPatch, folder: Path, name: str, script: str) -> None:
    folder.mkdir(exist_ok=True)
    program = folder / name
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    if str(folder) not in os.environ["PATH"]:
        monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")


def test_docker_builds_where_its_daemon_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    install(monkeypatch, tmp_path / "bin", "docker", "exit 0")
    assert isinstance(choose(), Docker)


def test_buildah_builds_where_only_dockers_command_is_there(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    install(monkeypatch, tmp_path / "bin", "docker", "echo 'no daemon' >&2; exit 1")
    install(monkeypatch, tmp_path / "bin", "buildah", "exit 0")
    assert isinstance(choose(), Buildah)


@pytest.mark.parametrize(
    ("pulls", "expected"),
    [("exit 0", "docker.io/library/python:3.11-slim"), ("exit 1", "made of packages for 3.11")],
    ids=["registry", "no registry"],
)
def test_the_base_is_pulled_or_made(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, pulls: str, expected: str
) -> None:
    script = f'case "$*" in *pull*) {pulls};; esac'
    install(monkeypatch, tmp_path / "bin", "buildah", script)
    monkeypatch.setattr(builders, "base_image", lambda python: f"made of packages for {python}")
    assert Buildah().base("python:3.11-slim") == expected


def test_a_base_that_somebody_chose_is_used_as_it_is() -> None:
    assert Buildah().base("registry.example/our-python:1") == "registry.example/our-python:1"
    assert Docker().base("python:3.13-slim") == "python:3.13-slim"


def test_a_base_that_debian_has_no_python_for_is_refused() -> None:
    with pytest.raises(ClusterError, match=r"Python 3\.12, .* BASE_IMAGE="):
        base_image.base_image("3.12")


def test_docker_is_asked_in_the_context(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    called = tmp_path / "called"
    script = f'echo "$PWD: $*" >> {called}; [ "$1" = build ] || touch "$3"'
    install(monkeypatch, tmp_path / "bin", "docker", script)
    context, archive = tmp_path / "context", tmp_path / "out" / "image.tar"
    context.mkdir()
    Docker().build("image:1", context, "Dockerfile", {"BASE_IMAGE": "base:1"}, archive)
    built, saved = called.read_text().splitlines()
    assert built.startswith(f"{context}: build --quiet --tag image:1 --file Dockerfile")
    assert " --build-arg BASE_IMAGE=base:1 " in built
    assert saved.endswith(" image:1")
    assert archive.exists()


def test_settings_of_pip_that_reach_an_index() -> None:
    listed = [
        "global.index-url='https://index.example/simple'",
        "global.cert='/etc/certificates.crt'",
        "global.disable-pip-version-check='1'",
        "install.trusted-host='index.example'",
        "list.format='columns'",
        ":env:.find-links='/opt/wheels'",
        ":env:.default-timeout='180'",
    ]
    assert pip_settings(listed) == (
        {
            "index-url": "https://index.example/simple",
            "trusted-host": "index.example",
            "timeout": "180",
        },
        "/etc/certificates.crt",
    )


def test_the_environment_wins_over_files() -> None:
    listed = [":env:.index-url='https://one.example'", "global.index-url='https://two.example'"]
    assert pip_settings(listed)[0] == {"index-url": "https://one.example"}


def test_several_indexes_stay_several() -> None:
    settings, _ = pip_settings(
        [r"global.extra-index-url='\nhttps://one.example\nhttps://two.example'"]
    )
    assert settings["extra-index-url"].split() == ["https://one.example", "https://two.example"]


def test_a_build_gets_the_settings_as_secrets(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    certificates = tmp_path / "certificates.crt"
    certificates.write_text("trusted")
    listed = ["global.index-url='https://index.example'", f"global.cert='{certificates}'"]
    monkeypatch.setattr(builders, "pip_config", lambda: listed)
    with secrets() as options:
        assert options[:2] == ["--secret", f"id=certificates,src={certificates}"]
        file = Path(options[3].removeprefix("id=pip,src="))
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        assert file.read_text().splitlines() == [
            "[global]",
            "cert = /run/secrets/certificates",
            "index-url = https://index.example",
        ]
    assert not file.exists()


def test_without_settings_no_variable_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(builders, "pip_config", list)
    monkeypatch.delenv("SSL_CERT_FILE", raising=False)
    with secrets() as options:
        assert len(options) == 2
        assert Path(options[1].removeprefix("id=pip,src=")).read_text() == "[global]\n"
