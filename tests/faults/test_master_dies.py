"""Deaths of the program: within two seconds all its processes are gone."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import shutil
import signal
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from faults.program import LOOPBACK, Program, alive, stop_and_wait, wait_for

PR_SET_CHILD_SUBREAPER = 36

IDLE_AND_BUSY = """
    import fiber, time
    from faults import targets
    if __name__ == "__main__":
        fiber.set_start_method("{method}")
        children = [fiber.Process(target=targets.block) for _ in range(2)]
        children.append(fiber.Process(target=targets.spin, daemon=True))
        children.append(fiber.Process(target=targets.shrug_off_signals))
        for child in children:
            child.start()
        print("ready", flush=True)
        children[0].join()
"""


@pytest.mark.parametrize(
    ("signum", "method"),
    [(signal.SIGKILL, "forkserver"), (signal.SIGSEGV, "spawn"), (signal.SIGTERM, "forkserver")],
)
def test_a_killed_program_leaves_no_process(
    launch_on: Callable[..., Program], method: str, signum: signal.Signals
) -> None:
    program = launch_on(IDLE_AND_BUSY.format(method=method))
    assert program.line() == "ready"
    assert len(program.family()) >= 5
    program.signal(signum)
    assert program.wait() == -signum
    assert program.left() == []


NESTED = """
    import fiber, os, sys
    from faults import targets
    def nest(depth):
        if depth:
            child = fiber.Process(target=nest, args=(depth - 1,))
            child.start()
            # In one piece: all of them write to the same pipe, and print() may take two.
            os.write(1, f"{child.pid}\\n".encode())
            child.join()
        else:
            os.write(1, b"deepest\\n")
            targets.block()
    if __name__ == "__main__":
        nest(4)
"""


def nested(launch: Callable[..., Program], **options: Any) -> tuple[Program, list[int]]:
    program = launch(NESTED, **options)
    lines = [program.line() for _ in range(5)]
    return program, [int(line) for line in lines if line != "deepest"]


def test_killed_it_takes_all_generations_with_it(launch: Callable[..., Program]) -> None:
    program, _ = nested(launch)
    program.kill()
    assert program.left() == []


def test_a_nested_parent_that_is_killed_takes_its_descendants_and_only_them(
    launch: Callable[..., Program],
) -> None:
    program, pids = nested(launch)
    parent, middle, *below = pids
    os.kill(middle, signal.SIGKILL)
    wait_for(lambda: not any(map(alive, below)))
    # Each generation above ends by itself: its child did.
    program.rest()
    assert program.wait() == 0
    assert not alive(parent)
    assert program.left() == []


@pytest.mark.parametrize("spared", ["zygote|fiber.agent", "zygote", "fiber.agent", None])
def test_a_program_killed_while_its_children_are_stopped_leaves_no_process(
    launch_on: Callable[..., Program], spared: str | None
) -> None:
    program = launch_on(IDLE_AND_BUSY.format(method="forkserver"))
    assert program.line() == "ready"
    for found in program.family():
        if spared is None or not re.search(spared, found.command):
            stop_and_wait(found.pid)
    program.kill()
    assert program.left() == []


@pytest.fixture
def adopting() -> Iterator[list[int]]:
    """Adopt processes whose parents die, as a supervisor does; reap those that the test names."""
    libc = ctypes.CDLL(None)
    pids: list[int] = []
    libc.prctl(PR_SET_CHILD_SUBREAPER, 1)
    yield pids
    libc.prctl(PR_SET_CHILD_SUBREAPER, 0)
    for pid in pids:
        with contextlib.suppress(ChildProcessError):
            os.waitpid(pid, 0)


def test_a_program_killed_while_it_is_stopped_leaves_no_process_to_a_supervisor(
    adopting: list[int], launch_on: Callable[..., Program]
) -> None:
    # The kernel lets no group go on that has a parent in its session, as here.
    program = launch_on(IDLE_AND_BUSY.format(method="forkserver"))
    assert program.line() == "ready"
    adopting += [found.pid for found in program.family()]
    for pid in adopting:
        stop_and_wait(pid)
    program.kill()
    assert program.left() == []


AT_A_STAGE = """
    import fiber, os, signal, tempfile, threading, time
    from faults import targets
    if __name__ == "__main__":
        tempfile.gettempdir()  # the first call has a file in the directory for a moment
        threading.Timer({delay}, os.kill, (os.getpid(), signal.SIGKILL)).start()
        while True:
            fiber.Process(target=targets.block).start()
"""


@pytest.mark.parametrize("delay", [0.02, 0.1, 0.3])
def test_killed_while_it_starts_processes_it_leaves_none(
    launch_on: Callable[..., Program], delay: float
) -> None:
    program = launch_on(AT_A_STAGE.format(delay=delay))
    assert program.wait() == -signal.SIGKILL
    assert program.left() == []


POOL_AND_QUEUE = """
    import fiber, time
    from faults import targets
    if __name__ == "__main__":
        queue = fiber.Queue()
        queue.put(bytes(1 << 20))
        pool = fiber.Pool(2)
        results = pool.map_async(time.sleep, [60] * 10)
        child = fiber.Process(target=targets.get_for_ever, args=(queue,))
        child.start()
        print("ready", flush=True)
        results.get()
"""


def test_a_program_killed_with_pool_queue_and_pipes_leaves_no_process(
    launch_on: Callable[..., Program],
) -> None:
    program = launch_on(POOL_AND_QUEUE)
    assert program.line() == "ready"
    program.kill()
    assert program.left() == []


ONE_CHILD = """
    import fiber
    from faults import targets
    if __name__ == "__main__":
        fiber.Process(target=targets.block).start()
        print("ready", flush=True)
        targets.block()
"""


def test_killed_together_with_its_zygotes_it_leaves_no_process(
    launch_on: Callable[..., Program],
) -> None:
    program = launch_on(ONE_CHILD)
    assert program.line() == "ready"
    zygotes = [found.pid for found in program.family() if "zygote" in found.command]
    assert zygotes
    for pid in zygotes:
        os.kill(pid, signal.SIGKILL)
    program.kill()
    # No process is left that could remove its directory.
    wait_for(lambda: not program.family())
    for directory in program.temporary.iterdir():
        shutil.rmtree(directory)


STARTING_WORKER = """
    import fiber, os, time
    from faults import targets
    if __name__ == "__main__":
        pool = fiber.Pool(1, initializer=targets.outlive, initargs=(os.getpid(), "initializing"))
        while not os.path.exists("initializing"):
            time.sleep(0.001)
        os._exit(0)
"""


def test_a_worker_that_becomes_ready_without_a_master_writes_no_error(
    launch: Callable[..., Program],
) -> None:
    program = launch(STARTING_WORKER)
    assert program.wait() == 0
    assert program.left() == []
    assert program.stderr == ""


ENDS = """
    import fiber, os, sys
    from faults import targets
    if __name__ == "__main__":
        child = fiber.Process(target=targets.block, daemon=True)
        child.start()
        print("ready", flush=True)
        {end}
"""


@pytest.mark.parametrize(
    ("end", "status"),
    [
        ("pass", 0),
        ("sys.exit(3)", 3),
        ("1 / 0", 1),
        ("os._exit(4)", 4),
        ("os.abort()", -signal.SIGABRT),
        ("os.execv('/bin/true', ['true'])", 0),
    ],
)
def test_however_it_ends_itself_its_daemons_end_too(
    launch: Callable[..., Program], end: str, status: int
) -> None:
    program = launch(ENDS.format(end=end), env=LOOPBACK if "os." in end else {})
    assert program.line() == "ready"
    assert program.wait() == status
    assert program.left() == []
