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
from typing import Any, NoReturn


class Unpicklable(Exception):
    """Exception that cannot be unpickled."""

    def __setstate__(self, state: Any) -> None:
        raise TypeError("this does not unpickle")


def fail(number: int) -> NoReturn:
    raise LookupError(f"task {number} failed on purpose")


def fail_if_odd(number: int) -> int:
    if number % 2:
        fail(number)
    return number


def raise_unpicklable(_number: int) -> NoReturn:
    error = Unpicklable("cannot travel")
    error.add_note("it has a state")
    raise error


def return_lock(_number: int) -> Any:
    return threading.Lock()


def die(_number: int = 0) -> NoReturn:
    print("about to die", file=sys.stderr, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def die_if(number: int, unlucky: int) -> int:
    if number == unlucky:
        die()
    return number


def die_once(folder: str, number: int) -> int:
    """Die at the first try of each number."""
    mark = Path(folder, f"tried-{number}")
    if not mark.exists():
        mark.touch()
        die()
    return number


def leave(how: str) -> None:
    if how == "os._exit":
        os._exit(3)
    sys.exit(4)


def nap(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def note_and_return(folder: str, number: int) -> int:
    """Leave a file for each run of each number."""
    Path(folder, f"{number}-{time.monotonic_ns()}-{os.getpid()}").touch()
    time.sleep(0.005)
    return number


def note_and_nap(folder: str, number: int) -> int:
    """Work as ``note_and_return``, but long enough to be killed in the middle."""
    Path(folder, f"{number}-{time.monotonic_ns()}-{os.getpid()}").touch()
    time.sleep(0.05)
    return number


def large(size: int) -> bytes:
    return bytes(size)


def report_pid_and_block(folder: str) -> NoReturn:
    Path(folder, str(os.getpid())).touch()
    while True:
        threading.Event().wait()


def spin_until_killed(folder: str) -> NoReturn:
    Path(folder, str(os.getpid())).touch()
    while True:
        pass


def fail_to_initialize() -> NoReturn:
    raise LookupError("the data set is not there")


def pid(_number: int = 0) -> int:
    return os.getpid()


def count_calls(folder: str, number: int, until: int) -> int:
    """Raise ConnectionError until called ``until`` times for this number."""
    calls = len(list(Path(folder).glob(f"call-{number}-*")))
    Path(folder, f"call-{number}-{calls}").touch()
    if calls + 1 < until:
        raise ConnectionError(f"call {calls + 1}")
    return calls + 1


def nested(depth: int) -> int:
    import fiber

    if not depth:
        return 0
    with fiber.Pool(1) as pool:
        deeper: int = pool.apply(nested, (depth - 1,))
    return 1 + deeper


def wait_for_company(folder: str, number: int, size: int) -> int:
    """Return this worker's pid once ``size`` workers are in such a task, or after a while."""
    Path(folder, f"{os.getpid()}-{number}").touch()
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline:
        if len({path.name.split("-")[0] for path in Path(folder).iterdir()}) >= size:
            break
        time.sleep(0.005)
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


def hang_in_native_code() -> None:
    """Hold the GIL, so that no thread and no Python signal handler runs."""
    start_beside()
    collections.deque(itertools.repeat(None), maxlen=0)


def crash(signum: int) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.kill(os.getpid(), signum)
