"""Output of `make test` before it begins."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import pytest

from announcement import SUPPORTED, announcement
from cluster import ability, build

ROOT = Path(__file__).resolve().parents[2]
OWN = ".".join(platform.python_version_tuple()[:2])
OTHERS = [version for version in SUPPORTED if version != OWN]


@pytest.fixture(autouse=True)
def able(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that can run our own cluster and has built it."""
    monkeypatch.setattr(ability, "kind_lacks", lambda: "kind is not on the PATH")
    monkeypatch.setattr(ability, "obstacles", list)
    monkeypatch.setattr(build, "missing", lambda _: [])


def test_all_is_run_where_all_can_be() -> None:
    said = announcement(OTHERS, {})
    _, _, left_out = said.partition("left out:")
    assert [line.split(":")[0].strip() for line in left_out.splitlines()[1:-1]] == [
        "scenarios that wait for a minute and more"
    ]
    assert "on a cluster of their own on this machine" in said
    for version in SUPPORTED:
        assert f"on Python {version}" in said


def test_the_sum_is_that_of_the_parts() -> None:
    total, *parts = map(int, re.findall(r"(\d+) min", announcement(OTHERS, {})))
    assert total == sum(parts)


def test_pending_builds_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "missing", lambda _: ["kubelet"])
    assert re.search(rf"{build.minutes()} min  building Kubernetes", announcement([], {}))
    assert "building" not in announcement([], {"KUBECONFIG": "/some/where"})


def test_a_given_cluster_is_named() -> None:
    assert "on the cluster of KUBECONFIG" in announcement([], {"KUBECONFIG": "/some/where"})


def test_skipped_parts_have_reasons(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ability, "obstacles", lambda: ["it takes root"])
    runs, _, left_out = announcement(OTHERS[:1], {}).partition("left out:")
    assert "the operator's scenarios" not in runs
    assert "KUBECONFIG is not set" in left_out
    assert "kind is not on the PATH" in left_out
    assert "it takes root" in left_out
    assert f"Python {OTHERS[-1]}: it was not found" in left_out


# The script that finds them; in these tests the interpreters' folders contain only them.


def python_script(*arguments: str, **environment: str) -> list[str]:
    done = subprocess.run(
        [ROOT / ".ci" / "python", *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return done.stdout.split()


def fake_python(file: Path, version: str, *, whole: bool = True) -> None:
    """Write a program that answers the two questions of .ci/python as this Python does."""
    file.parent.mkdir(parents=True, exist_ok=True)
    answers = f'case "$2" in *version_info*) echo {version};; *) exit {int(not whole)};; esac'
    file.write_text(f"#!/bin/sh\n{answers}\n")
    file.chmod(0o755)


@pytest.fixture
def bare(tmp_path: Path) -> dict[str, str]:
    """An environment without any interpreter."""
    return {"PATH": f"{tmp_path}/bin:/usr/bin:/bin", "PYENV_ROOT": str(tmp_path / "pyenv")}


def test_others_are_found_on_the_path_and_in_pyenv(tmp_path: Path, bare: dict[str, str]) -> None:
    for version in SUPPORTED:  # pyenv's own command for one that is not switched on
        fake_python(tmp_path / "bin" / f"python{version}", "no such command")
    fake_python(tmp_path / "bin" / f"python{OTHERS[0]}", OTHERS[0])
    inside = tmp_path / "pyenv" / "versions" / f"{OTHERS[1]}.7" / "bin" / "python"
    fake_python(inside, OTHERS[1])
    assert python_script("others", sys.executable, **bare) == OTHERS[:2]
    assert python_script("find", OTHERS[1], **bare) == [str(inside)]


def test_a_python_that_cannot_make_an_environment_is_not_chosen(
    tmp_path: Path, bare: dict[str, str]
) -> None:
    for version in SUPPORTED:
        fake_python(tmp_path / "bin" / f"python{version}", version, whole=False)
    assert python_script("others", sys.executable, **bare) == []


def test_every_list_of_supported_versions_is_the_same() -> None:
    script = (ROOT / ".ci" / "python").read_text(encoding="utf-8")
    assert f'SUPPORTED="{" ".join(SUPPORTED)}"' in script
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert re.findall(r"Python :: (3\.\d+)", project) == list(SUPPORTED)


def test_the_essential_tests_are_there() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    listed = re.search(r"^ESSENTIAL_TESTS := ((?:.*\\\n)*.*)$", makefile, re.MULTILINE)
    assert listed is not None
    text = listed[1].replace("\\\n", " ")
    groups = re.findall(r"\$\(patsubst %,(\S+),([^)]*)\)", text)
    paths = [pattern.replace("%", name) for pattern, names in groups for name in names.split()]
    paths += re.sub(r"\$\([^)]*\)", "", text).split()
    assert len(paths) > 10
    assert [path for path in paths if not (ROOT / path).exists()] == []
