"""Tasks that misbehave, for the fault tests of pools."""

from __future__ import annotations

import collections
import itertools
import os
import resource
import signal
import sys
import threading
import time
from pathlib import Path
from typing import NoReturn


def die(_number: int = 0) -> NoReturn:
    print("about to die", file=sys.stderr, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def nap(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def note_and_return(folder: str, number: int) -> int:
    """Leave a file for each run of each number."""
    Path(folder, f"{number}-{time.monotonic_ns()}-{os.getpid()}").touch()
    time.sleep(0.005)
    return number


def large(size: int) -> bytes:
    return bytes(size)


def report_pid_and_block(folder: str) -> NoReturn:
    Path(folder, str(os.getpid())).touch()
    while True:
        threading.Event().wait()


def pid(_number: int = 0) -> int:
    return os.getpid()


def wait_beside(begun: threading.Event) -> None:
    begun.set()
    time.sleep(600)


def start_beside() -> None:
    begun = threading.Event()
    threading.Thread(target=wait_beside, args=(begun,)).start()
    begun.wait()


def hang_in_python() -> NoReturn:
    start_beside()
    while True:
        pass


def hang_with(_: object) -> NoReturn:
    hang_in_python()


def hang_in_native_code() -> None:
    """Hold the GIL, so that no thread and no Python signal handler runs."""
    start_beside()
    collections.deque(itertools.repeat(None), maxlen=0)


def crash(signum: int) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.kill(os.getpid(), signum)
