"""Other programs: run, waited for, and quoted when they fail."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path


class ClusterError(Exception):
    """The message says what happened, why, and what to do."""


def output(
    *command: str | Path,
    check: bool = True,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    timeout: float | None = None,
) -> str:
    """Return a command's output. Raises ClusterError with all its output if it fails."""
    words = [str(word) for word in command]
    try:
        done = subprocess.run(
            words, text=True, capture_output=True, cwd=cwd, env=env, timeout=timeout
        )
    except FileNotFoundError as error:
        raise ClusterError(
            f"{words[0]} is not installed: install it or put it on the PATH"
        ) from error
    except subprocess.TimeoutExpired as error:
        raise ClusterError(f"{' '.join(words)} took more than {timeout:.0f} s") from error
    if check and done.returncode:
        said = (done.stdout + done.stderr).strip()
        raise ClusterError(f"{' '.join(words)} ended with status {done.returncode}:\n{said}")
    return done.stdout


def answer(*command: str | Path, timeout: float = 30) -> str:
    """Return a command's output, also if it fails or does not exist."""
    try:
        return output(*command, timeout=timeout)
    except ClusterError as error:
        return str(error)


def succeeds(*command: str | Path, timeout: float = 30) -> bool:
    """Return whether a command exists and ends with status 0 in time."""
    try:
        output(*command, timeout=timeout)
    except ClusterError:
        return False
    return True


def wait_for(
    what: str,
    ready: Callable[[], bool],
    *,
    seconds: float = 120,
    complaint: Callable[[], str | None] = lambda: None,
    account: Callable[[], str] = lambda: "",
) -> None:
    """Ask until it is ready.

    Raises ClusterError: early with the complaint where there is one, with the account of how
    things stand where time is up.
    """
    deadline = time.monotonic() + seconds
    while not ready():
        if (wrong := complaint()) is not None:
            raise ClusterError(f"{what}: {wrong}")
        if time.monotonic() > deadline:
            raise ClusterError(f"{what}: not there after {seconds:.0f} s\n{account()}".rstrip())
        time.sleep(0.05)


@contextmanager
def locked(file: Path, meanwhile: str) -> Iterator[None]:
    """Hold a lock against other processes; print the reason if it must wait."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with open(file, "a", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say(f"waiting for another process that {meanwhile} (it holds {file})")
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def say(text: str) -> None:
    """Print progress and advice, apart from the output of a command."""
    print(f"cluster: {text}", file=sys.stderr, flush=True)


def need_root(purpose: str) -> None:
    if os.geteuid():
        raise ClusterError(
            f"only root can {purpose}: run this as root, or name another cluster with KUBECONFIG"
        )
