"""Smoke tests: the test cluster's programs and packages are built and installed once."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from cluster import ability, build, images, packages, places, preparation
from cluster.shell import ClusterError

# A go that builds one program as an empty file, and counts its calls.
GO = """#!/bin/sh
echo "$*" >> "$CALLS"
while [ "$1" != -o ]; do shift; done
touch "$2kubernetes"
"""


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def install_go(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, script: str) -> Path:
    """Put this go first on the PATH; return the file with its calls."""
    go, calls = tmp_path / "bin" / "go", tmp_path / "calls"
    go.parent.mkdir()
    go.write_text(script)
    go.chmod(0o755)
    calls.touch()
    monkeypatch.setenv("PATH", f"{go.parent}:{os.environ['PATH']}")
    monkeypatch.setenv("CALLS", str(calls))
    return calls


def test_kubernetes_is_built_once_under_the_names_of_its_programs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = install_go(monkeypatch, tmp_path, GO)
    for _ in range(2):
        build.build(["kubernetes"])
    assert len(calls.read_text().splitlines()) == 1
    assert build.missing("kubernetes") == []
    main = (places.HERE / "kubernetes" / "main.go").read_text(encoding="utf-8")
    for name in places.SOURCES["kubernetes"].programs:
        assert (places.programs() / name).resolve() == places.programs() / "kubernetes"
        assert f'"{name}"' in main
    said = capsys.readouterr().err
    for part in (f"about {build.minutes()} minutes", "KUBECONFIG", "kind", "make test-fast"):
        assert part in said


def test_a_failed_build_leaves_no_program(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    install_go(monkeypatch, tmp_path, f"{GO}\necho 'no space left' >&2\nexit 1\n")
    with pytest.raises(ClusterError, match="no space left"):
        build.build(["kubernetes"])
    assert build.missing("kubernetes")


def test_a_missing_go_is_an_error_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda *_, **__: None)
    with pytest.raises(ClusterError, match=r"install Go .* or name a cluster .* with KUBECONFIG"):
        build.build(["helm"])


@pytest.fixture
def apt_get(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Act as root, with an apt-get that makes an empty program of the last package."""
    folder = tmp_path / "apt"
    folder.mkdir()
    script = folder / "apt-get"
    script.write_text(
        '#!/bin/sh\n[ "$1" = install ] || exit 0\nfor name in "$@"; do :; done\n'
        f'touch "{folder}/$name"; chmod +x "{folder}/$name"\n'
    )
    script.chmod(0o755)
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(places, "PACKAGES_LOCK", tmp_path / "lock")
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    return folder


def test_root_gets_missing_packages_installed(apt_get: Path) -> None:
    packages.need({"sh": "dash", "wings": "wings"}, "fly")
    assert [path.name for path in apt_get.iterdir() if path.name != "apt-get"] == ["wings"]
    with pytest.raises(ClusterError, match="installed feathers, but"):
        packages.need({"plume": "feathers"}, "fly")


def test_a_user_gets_the_command_that_installs_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(ClusterError, match=r"to fly, .* sudo apt-get install some-wings"):
        packages.need({"no-such-program": "some-wings"}, "fly")


WHOLE = ["helm", "packages", "kubernetes", "helm", "pause", "images"]


@pytest.mark.parametrize(
    ("kubeconfig", "obstacles", "network", "steps"),
    [
        ("", [], True, WHOLE),
        ("/somewhere", [], True, ["helm"]),
        ("", ["it takes root"], True, ["helm"]),
        ("", [], False, ["helm"]),
    ],
    ids=["own-cluster", "given-cluster", "no-root", "no-network"],
)
def test_preparation_runs_the_possible_steps_and_never_fails(
    monkeypatch: pytest.MonkeyPatch,
    kubeconfig: str,
    obstacles: list[str],
    network: bool,
    steps: list[str],
) -> None:
    done: list[str] = []

    def need(*_: object) -> None:
        if not network:
            raise ClusterError("no network")
        done.append("packages")

    monkeypatch.setenv("KUBECONFIG", kubeconfig)
    monkeypatch.setattr("shutil.which", lambda *_, **__: None)
    monkeypatch.setattr(ability, "obstacles", lambda: obstacles)
    monkeypatch.setattr(build, "build", done.extend)
    monkeypatch.setattr(packages, "need", need)
    monkeypatch.setattr(preparation, "pause_archive", lambda: done.append("pause"))
    monkeypatch.setattr(images, "build_images", lambda: done.append("images"))
    preparation.prepare()
    assert done == steps
