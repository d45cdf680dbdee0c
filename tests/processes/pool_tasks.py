"""Functions that the workers of the pool's tests run, and objects that they send."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

from fiber import util
from patience import PATIENCE


def identity(value: Any) -> Any:
    return value


def square(x: int) -> int:
    return x * x


def add(x: int, y: int = 0) -> int:
    return x + y


def pid(_: object = None) -> int:
    return os.getpid()


def raise_value_error(value: object) -> NoReturn:
    raise ValueError(value)


def raise_if_odd(x: int) -> int:
    if x % 2:
        raise ValueError(x)
    return x


def stop_iteration(x: int) -> int:
    if x == 3:
        raise StopIteration
    return x


def sleep(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def nap_and_return(x: int) -> int:
    time.sleep(0.0005)
    return x


def gather(iterator: Iterator[Any]) -> list[Any]:
    """Return all results, with errors in their places."""
    found: list[Any] = []
    while True:
        try:
            found.append(next(iterator))
        except StopIteration:
            return found
        except (Exception, SystemExit) as error:
            found.append(error)


# Meeting points between a task and its test: files, which any process sees


def wait_for(path: Path) -> str:
    """Until somebody makes the file."""
    deadline = time.monotonic() + PATIENCE
    while not path.exists():
        if time.monotonic() > deadline:
            raise TimeoutError(f"{path} did not appear")
        time.sleep(0.001)
    return path.name


def announce(path: Path) -> None:
    path.with_suffix(f".{os.getpid()}").touch()


def announced(path: Path) -> list[int]:
    return [int(other.suffix[1:]) for other in path.parent.glob(path.name + ".*")]


def wait_until_announced(path: Path, count: int = 1) -> list[int]:
    deadline = time.monotonic() + PATIENCE
    while len(pids := announced(path)) < count:
        if time.monotonic() > deadline:
            raise TimeoutError(f"{len(pids)} of {count} announced themselves at {path}")
        time.sleep(0.001)
    return pids


def pass_gate(number: int, gate: Path | None) -> int:
    if gate is not None:
        wait_for(gate)
    return number


def announce_and_wait(path: Path, gate: Path) -> str:
    announce(path)
    return wait_for(gate)


def announce_and_sleep(path: Path) -> None:
    announce(path)
    time.sleep(600)


def announce_and_spin(path: Path) -> NoReturn:
    announce(path)
    while True:
        pass


WAITING, LAST = (30, 31), 60
"""Tasks of ``wait_for_later`` that wait, and the last one that they wait for."""


def wait_for_later(task: tuple[int, Path]) -> int:
    """Wait, as one of two tasks, for all later ones up to ``LAST``; take a moment as another."""
    index, path = task
    if index in WAITING:
        for later in range(max(WAITING) + 1, LAST + 1):
            wait_for(path / str(later))
    else:
        time.sleep(0.01)
        if index <= LAST:
            (path / str(index)).touch()
    return index


def wait_if_first(task: tuple[int, Path]) -> int:
    """Wait, as task 0, for an action that needs the other tasks' results."""
    index, gate = task
    if index == 0:
        wait_for(gate)
    return index


def count(path: Path) -> int:
    """Append a line to the file, which counts calls."""
    with path.open("a") as file:
        file.write("x\n")
    return len(path.read_text().splitlines())


def count_and_exit(task: tuple[Path, bool]) -> int:
    path, leaves = task
    lines = count(path)
    if leaves:
        sys.exit(4)
    return lines


def runs(path: Path) -> int:
    return len(path.read_text().splitlines()) if path.exists() else 0


# Deaths


def die(how: str) -> NoReturn:
    if how == "exit":
        os._exit(3)
    if how == "segfault":
        # No core file, which would take long to write.
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        os.kill(os.getpid(), signal.SIGSEGV)
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError("still alive")


def speak_and_die() -> NoReturn:
    print("about to die", file=sys.stderr, flush=True)
    die("kill")


def die_if(task: tuple[int, int]) -> int:
    index, victim = task
    if index == victim:
        os._exit(3)
    return index


def die_at_first(path: Path) -> str:
    if count(path) == 1:
        os._exit(3)
    return "lived"


def die_when_counted(path: Path, _: object = None) -> NoReturn:
    count(path)
    os._exit(3)


def raise_it(error: BaseException) -> NoReturn:
    raise error


def announce_and_wait_for_interrupt(path: Path) -> NoReturn:
    announce(path)
    while True:
        time.sleep(0.01)  # a signal that comes just before a sleep does not end the sleep


def fail_until(path: Path, times: int) -> str:
    if count(path) <= times:
        raise ConnectionError(f"try {runs(path)}")
    return "done"


def counted_error(path: Path) -> NoReturn:
    count(path)
    raise KeyError("always")


# Initializers

state: dict[str, Any] = {}


def remember(value: object) -> None:
    state["value"] = value


def recall(_: object = None) -> object:
    return state["value"]


def refuse() -> NoReturn:
    raise RuntimeError("no such device")


def refuse_counted(path: Path) -> NoReturn:
    count(path)
    raise RuntimeError("no such device")


def vanish(path: Path) -> NoReturn:
    count(path)
    os._exit(9)


def killed_until(path: Path, times: int) -> None:
    if count(path) <= times:
        os.kill(os.getpid(), signal.SIGKILL)


def end_slowly(gate: Path) -> None:
    """Let this worker end only once ``gate`` exists, unless it is killed."""
    util.Finalize(None, wait_for, (gate,), exitpriority=1)


def start_slowly(gate: Path) -> None:
    wait_for(gate)


# Objects that do not travel well


class Log:
    """List of items that a method adds to."""

    def __init__(self) -> None:
        self.items: list[int] = []

    def add(self, item: int) -> int:
        self.items.append(item)
        return len(self.items)


class Unpicklable:
    def __reduce__(self) -> NoReturn:
        raise RuntimeError("cannot be pickled")

    def __repr__(self) -> str:
        return "<Unpicklable>"


class Exiting:
    """Does not pickle, and wants to end the process once it has said so ``refusals`` times."""

    def __init__(self, refusals: int = 0) -> None:
        self.refusals = refusals

    def __reduce__(self) -> NoReturn:
        self.refusals -= 1
        raise SystemExit("no") if self.refusals < 0 else TypeError("cannot be pickled")


class ExitingInMaster:
    """A function that unpickles nowhere, with an error that unpickles in workers only."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _raise_exiting, (os.getpid(),)

    def __call__(self, value: object) -> object:
        return value


class _ExitsIn(Exception):
    def __reduce__(self) -> tuple[Any, ...]:
        return _exit_in, self.args


def _exit_in(pid: int) -> _ExitsIn:
    if os.getpid() == pid:
        raise SystemExit("no")
    return _ExitsIn(pid)


def _raise_exiting(pid: int) -> NoReturn:
    raise _ExitsIn(pid)


class Unreprable(Unpicklable):
    def __repr__(self) -> str:
        raise RuntimeError("cannot be shown")


def _refuse_in_worker(parent: int) -> object:
    if os.getpid() != parent:
        raise RuntimeError("cannot be unpickled in a worker")
    return identity


class UnreadableInWorker:
    """Pickles, and unpickles in the process that made it only."""

    def __init__(self) -> None:
        self.parent = os.getpid()

    def __reduce__(self) -> tuple[Any, ...]:
        return _refuse_in_worker, (self.parent,)

    def __call__(self, value: object) -> object:
        return value


def _refuse_in_parent(child: int) -> object:
    if os.getpid() != child:
        raise RuntimeError("cannot be unpickled in the program")
    return None


class UnreadableResult:
    """Pickles in a worker, and unpickles there only."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _refuse_in_parent, (os.getpid(),)


class Exotic(BaseException):
    """Not an Exception."""


def raise_exotic(_: object = None) -> NoReturn:
    raise Exotic("strange")


def odd_results(x: int) -> object:
    """Return a result; one of five does not pickle, and one does not unpickle in the program."""
    if x % 5 == 2:
        return Unpicklable()
    if x % 5 == 3:
        return UnreadableResult()
    return x


def unreprable_result(_: object = None) -> object:
    return Unreprable()


shared: list[int] = []


def grow(x: int) -> list[int]:
    """The same list each time, as an environment returns its one observation buffer."""
    shared.append(x)
    del shared[:-1]
    return shared


def fill(x: int) -> Any:
    """The same array each time, large enough to travel beside the pickle."""
    import numpy as np

    if "array" not in state:
        state["array"] = np.zeros(100_000)
    state["array"][:] = x
    return state["array"]


class Point:
    def __init__(self, x: int) -> None:
        self.x = x

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Point) and pickle.dumps(self) == pickle.dumps(other)

    def __hash__(self) -> int:
        return hash(self.x)

    def scaled(self, factor: int) -> Point:
        return Point(self.x * factor)


def nested_pools(depth: int) -> int:
    """Return how many pools are one within the other below this task."""
    import fiber

    if depth == 0:
        return 0
    with fiber.Pool(1) as pool:
        deeper: int = pool.apply(nested_pools, (depth - 1,))
    return 1 + deeper


def current_name(_: object = None) -> tuple[str, bool]:
    import multiprocessing

    process = multiprocessing.current_process()
    return process.name, process.daemon


class Tattling:
    """Says when it is pickled."""

    def __init__(self, n: int) -> None:
        self.n = n

    def __reduce__(self) -> tuple[Any, ...]:
        state["pickled"].append(self.n)
        return int, (self.n,)


def twice(value: Any) -> Any:
    return [value, value]


def join(one: Any, other: Any) -> Any:
    return one, other


def large(_number: int) -> bytes:
    return b"x" * ((1 << 16) + 1)
