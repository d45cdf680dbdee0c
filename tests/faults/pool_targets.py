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

from fiber._agent import last_words


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


def run_another_program() -> NoReturn:
    os.execvp("sleep", ["sleep", "600"])


def close_all_and_open(path: str) -> NoReturn:
    """Close all descriptors, and open one file again and again, so that it has their numbers."""
    os.closerange(3, 256)
    for _ in range(3, 256):
        os.open(path, os.O_WRONLY | os.O_CREAT)
    Path(path + ".ready").touch()
    while True:
        time.sleep(600)


def run_threads_while_shown(times: int) -> int:
    """Get SHOW some times while other threads run, and end these."""
    end = threading.Event()
    others = [threading.Thread(target=recurse_until, args=(end,)) for _ in range(2)]
    for thread in others:
        thread.start()
    shower = threading.Thread(target=show_stacks, args=(times,))
    shower.start()
    shower.join()
    end.set()
    for thread in others:
        thread.join()
    return times


def recurse_until(end: threading.Event) -> None:
    def down(depth: int) -> int:
        return down(depth - 1) if depth else 0

    while not end.is_set():
        down(800)


def show_stacks(times: int) -> None:
    for _ in range(times):
        os.kill(os.getpid(), last_words.SHOW)
        time.sleep(0)


def hang_with(_: object) -> NoReturn:
    hang_in_python()


def hang_in_native_code() -> None:
    """Hold the GIL, so that no thread and no Python signal handler runs."""
    start_beside()
    collections.deque(itertools.repeat(None), maxlen=0)


def crash(signum: int) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.kill(os.getpid(), signum)


kept: list[bytes] = []


def keep_memory(size: int) -> None:
    kept.append(b"x" * size)


def divide(dividend: float, divisor: float) -> float:
    return dividend / divisor
