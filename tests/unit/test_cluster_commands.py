"""The commands of the test cluster: what they print, and that the README knows them."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from cluster import commands, faults, images, lifecycle, network, places
from cluster.daemons import Daemon
from cluster.lifecycle import Found
from patience import PATIENCE

TESTS = Path(__file__).resolve().parents[1]


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    given = commands.parser().parse_args(words)
    given.run(given)
    return capsys.readouterr().out


def test_the_readme_has_every_command() -> None:
    helped = commands.parser().format_help().partition("COMMAND\n")[2]
    names = re.findall(r"^    ([a-z-]+)", helped.partition("\n\n")[0], re.MULTILINE)
    readme = (TESTS / "cluster" / "README.md").read_text(encoding="utf-8")
    first_column = "".join(re.findall(r"^\| (`[^|]+) \|", readme, re.MULTILINE))
    assert names
    assert sorted(names) == sorted(re.findall(r"`([a-z-]+)`", first_column))


@pytest.fixture
def shell_lines(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the exported lines if no image was brought."""
    monkeypatch.setattr(lifecycle, "up", lambda _: None)
    monkeypatch.setattr(images, "brought", lambda _: None)
    return [f"export KUBECONFIG={places.KUBECONFIG}", f"export PATH={places.programs()}:$PATH"]


def test_up_prints_lines_for_a_shell(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, shell_lines: list[str]
) -> None:
    asked: list[object] = []
    monkeypatch.setattr(lifecycle, "up", asked.append)
    assert printed(capsys, "up", "--nodes", "3").splitlines() == shell_lines
    assert asked == [3]


def test_up_with_images_exports_the_one_for_the_examples(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, shell_lines: list[str]
) -> None:
    references = {image.name: f"{image.name}:1" for image in images.IMAGES}
    monkeypatch.setattr(images, "bring_images", lambda: references)
    given = commands.parser().parse_args(["up", "--images"])
    given.run(given)
    said = capsys.readouterr()
    assert said.out.splitlines() == [*shell_lines, "export FIBER_IMAGE=fiber-worker-rl:1"]
    assert all(reference in said.err for reference in references.values())


@pytest.mark.parametrize("command", ["up", "env"])
def test_the_images_of_the_nodes_are_exported(
    command: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    shell_lines: list[str],
) -> None:
    assert printed(capsys, command).splitlines() == shell_lines
    monkeypatch.setattr(images, "brought", lambda image: f"{image.name}:1")
    assert printed(capsys, command).splitlines() == [
        *shell_lines,
        "export FIBER_IMAGE=fiber-worker-rl:1",
    ]


def test_status_names_the_parts_that_do_not_run(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(places, "STATE", tmp_path)
    monkeypatch.setattr(places, "SOCKETS", tmp_path / "sockets")
    monkeypatch.setattr(network, "is_plugged_in", lambda _: False)
    assert printed(capsys, "status") == "no cluster is up\n"
    Found("/home/me/fiber", "/cache/kubernetes-1.34.4", 1).write()
    places.socket(1).parent.mkdir(parents=True)
    (tmp_path / "daemons").mkdir()
    for name in ("apiserver", "etcd"):
        (tmp_path / "daemons" / f"{name}.json").write_text("[]")
    monkeypatch.setattr(Daemon, "runs", lambda daemon: daemon.name == "etcd")
    out = printed(capsys, "status")
    assert "kubernetes-1.34.4, 1 nodes, from /home/me/fiber" in out
    assert "node-1 is cut off" in out
    assert "apiserver: does not run" in out
    assert "etcd: runs" in out


@pytest.mark.parametrize("command", ["cut", "restore", "stop", "start"])
def test_faults_are_commands(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []
    monkeypatch.setattr(faults, command, asked.append)
    printed(capsys, command, "node-1")
    assert asked == ["node-1"]


def test_an_error_is_a_sentence_and_not_a_traceback(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "cluster", "cut", "node-99"],
        cwd=TESTS,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("cluster: there is no node node-99; there are: ")
    assert "Traceback" not in done.stderr
