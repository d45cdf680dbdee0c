"""Versions, programs and packages of the test cluster: known, built once, asked for plainly."""

from __future__ import annotations

import os
import stat
import threading
from pathlib import Path

import pytest

from cluster import build, packages, places
from cluster.shell import ClusterError, locked

# A go that builds the programs that the module names as empty files, and counts its calls.
GO = """#!/bin/sh
echo "$*" >> "$CALLS"
while [ "$1" != -o ]; do shift; done
touch "$2helm"
"""


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def go_calls(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    return install_go(monkeypatch, tmp_path, GO)


def install_go(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, script: str) -> Path:
    go, calls = tmp_path / "bin" / "go", tmp_path / "calls"
    go.parent.mkdir()
    go.write_text(script)
    go.chmod(0o755)
    calls.touch()
    monkeypatch.setenv("PATH", f"{go.parent}:{os.environ['PATH']}")
    monkeypatch.setenv("CALLS", str(calls))
    return calls


@pytest.mark.parametrize("folder", places.SOURCES)
def test_versions_come_from_the_modules(folder: str) -> None:
    assert all(part.isdigit() for part in places.version(folder).split("."))
    assert f"{folder}-{places.version(folder)}" in places.cache().name


def test_programs_are_built_once(go_calls: Path) -> None:
    build.build(["helm"])
    build.build(["helm"])
    assert len(go_calls.read_text().splitlines()) == 1
    assert build.missing("helm") == []
    assert build.missing("kwok") == ["kwok"]


def test_two_simultaneous_builds_build_once(go_calls: Path) -> None:
    threads = [threading.Thread(target=build.build, args=(["helm"],)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(go_calls.read_text().splitlines()) == 1


def test_a_failed_build_leaves_no_file_that_looks_built(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    install_go(monkeypatch, tmp_path, f"{GO}\necho 'no space left' >&2\nexit 1\n")
    with pytest.raises(ClusterError, match="no space left"):
        build.build(["helm"])
    assert build.missing("helm") == ["helm"]


def test_a_missing_go_is_an_error_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda *_, **__: None)
    with pytest.raises(ClusterError, match=r"install Go .* or name a cluster .* with KUBECONFIG"):
        build.build(["helm"])


def test_missing_packages_are_named_once() -> None:
    wanted: dict[str | Path, str] = {
        "no-such-program": "first",
        "another-one": "first",
        "sh": "second",
    }
    assert packages.missing(wanted) == ["first"]


def test_complete_packages_cause_no_installation() -> None:
    packages.need({"sh": "dash", Path("/bin/sh"): "dash"}, "test")


def test_a_user_who_cannot_install_gets_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(ClusterError, match=r"to fly, .* sudo apt-get install some-wings"):
        packages.need({"no-such-program": "some-wings"}, "fly")


@pytest.fixture
def apt_get(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Act as root, with an apt-get that makes an empty program of each package it installs."""
    folder = tmp_path / "apt"
    folder.mkdir()
    script = folder / "apt-get"
    script.write_text(
        '#!/bin/sh\n[ "$1" = install ] || exit 0\nfor name in "$@"; do :; done\n'
        f'touch "{folder}/$name"; chmod +x "{folder}/$name"\n'
    )
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(places, "PACKAGES_LOCK", tmp_path / "lock")
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    return folder


def test_root_gets_them_installed(apt_get: Path) -> None:
    packages.need({"wings-of-wax": "wings-of-wax"}, "fly")
    assert (apt_get / "wings-of-wax").exists()


@pytest.mark.usefixtures("apt_get")
def test_a_package_that_does_not_help_is_named() -> None:
    with pytest.raises(ClusterError, match="installed feathers, but"):
        packages.need({"wings": "feathers"}, "fly")


def test_a_lock_is_waited_for(tmp_path: Path) -> None:
    order = []
    inside, waiting = threading.Event(), threading.Event()

    def second() -> None:
        inside.wait()
        waiting.set()
        with locked(tmp_path / "lock", "works"):
            order.append("second")

    thread = threading.Thread(target=second)
    thread.start()
    with locked(tmp_path / "lock", "works"):
        inside.set()
        waiting.wait()
        order.append("first")
    thread.join()
    assert order == ["first", "second"]


def test_the_wait_for_kubernetes_is_announced_with_its_length(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    install_go(monkeypatch, tmp_path, GO.replace("helm", "kubernetes"))
    build.build(["kubernetes"])
    said = capsys.readouterr().err
    assert "for a real cluster on this machine" in said
    assert f"about {build.minutes()} minutes" in said
    for way_out in ("KUBECONFIG", "kind", "make test-fast"):
        assert way_out in said


def test_one_program_bears_the_names_of_all(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    install_go(monkeypatch, tmp_path, GO.replace("helm", "kubernetes"))
    build.build(["kubernetes"])
    assert build.missing("kubernetes") == []
    for name in places.SOURCES["kubernetes"].programs:
        assert (places.programs() / name).resolve() == places.programs() / "kubernetes"


def test_the_program_knows_the_names_that_it_is_given() -> None:
    main = (places.HERE / "kubernetes" / "main.go").read_text(encoding="utf-8")
    for name in places.SOURCES["kubernetes"].programs:
        assert f'"{name}"' in main
