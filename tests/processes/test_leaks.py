"""The leak check sees each kind of thing that a test can leave, and forgives none."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

import leaks
from patience import PATIENCE

MARKER = "LEAK_CHECK_TEST=1"
WAIT_FOR_EVER = "import threading; threading.Event().wait()"


@pytest.fixture
def watch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> leaks.Watch:
    monkeypatch.setattr(leaks, "SETTLE", 0.05)
    return leaks.Watch(MARKER, tmp_path)


@pytest.fixture
def daemon() -> Iterator[int]:
    """A process whose parent is gone, as a daemon is."""
    script = (
        "import subprocess, sys\n"
        f"command = [sys.executable, '-c', {WAIT_FOR_EVER!r}]\n"
        "daemon = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)\n"
        "print(daemon.pid, flush=True)\n"
        "daemon.returncode = 0  # so that subprocess does not mind that it still runs\n"
    )
    name, _, value = MARKER.partition("=")
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, name: value},
        stdout=subprocess.PIPE,
        check=True,
        text=True,
        timeout=PATIENCE,
    )
    pid = int(done.stdout)
    yield pid
    os.kill(pid, signal.SIGKILL)


def test_a_clean_state_has_no_leaks(watch: leaks.Watch) -> None:
    before = watch.look()
    subprocess.run([sys.executable, "-c", ""], check=True, timeout=PATIENCE)
    assert watch.left_since(before) == []


def test_a_child_is_found(watch: leaks.Watch) -> None:
    before = watch.look()
    child = subprocess.Popen([sys.executable, "-c", WAIT_FOR_EVER])
    try:
        (line,) = watch.left_since(before)
        assert line.startswith(f"process {child.pid} ")
        assert line.endswith(WAIT_FOR_EVER)
    finally:
        child.kill()
        child.wait()


def test_a_daemon_is_found_by_the_marker(
    watch: leaks.Watch, request: pytest.FixtureRequest
) -> None:
    before = watch.look()
    pid = request.getfixturevalue("daemon")
    (line,) = watch.left_since(before)
    assert line.startswith(f"process {pid} ")


def test_a_thread_is_found(watch: leaks.Watch) -> None:
    before = watch.look()
    stop = threading.Event()
    thread = threading.Thread(target=stop.wait, name="idle", daemon=True)
    thread.start()
    try:
        assert watch.left_since(before) == ["thread idle"]
    finally:
        stop.set()
        thread.join()


def test_an_open_file_is_found(watch: leaks.Watch) -> None:
    before = watch.look()
    with socket.socket() as left:
        (line,) = watch.left_since(before)
        assert line.startswith(f"open file {left.fileno()}: socket:")


def test_a_temporary_file_is_found(watch: leaks.Watch, tmp_path: Path) -> None:
    before = watch.look()
    tempfile.mkdtemp(prefix="fiber-", dir=tmp_path)
    (line,) = watch.left_since(before)
    assert line.startswith("temporary file fiber-")


def test_the_file_with_which_python_tries_a_folder_is_not_a_leak(
    watch: leaks.Watch, tmp_path: Path
) -> None:
    before = watch.look()
    (tmp_path / "6y_b1rzl").write_bytes(b"blat")
    (tmp_path / "7y_b1rzl").write_bytes(b"data")
    assert watch.left_since(before) == ["temporary file 7y_b1rzl"]
