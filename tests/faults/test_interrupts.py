"""Ctrl-C in each blocking call: KeyboardInterrupt at once, and no leak."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from faults.program import Program, wait_for
from patience import PATIENCE

SCRIPT = """
    import fiber, sys, time
    from faults import targets
    from fiber import connection
    if __name__ == "__main__":
        ours, theirs = fiber.Pipe()
        queue = fiber.Queue()
        full = fiber.Queue(1)
        full.put(1)
        done = fiber.Event()
        semaphore = fiber.Semaphore(0)
        joinable = fiber.JoinableQueue()
        joinable.put(1)
        child = fiber.Process(target=targets.block)
        child.start()
        {prepare}
        try:
            print("ready", flush=True)
            {call}
        except KeyboardInterrupt:
            print("interrupted", flush=True)
            child.kill()
            {clean}
        else:
            print("returned", flush=True)
"""

CALLS = [
    "child.join()",
    "child.join(60)",
    "ours.recv()",
    "ours.poll(60)",
    "ours.send_bytes(bytes(1 << 24)); ours.send_bytes(bytes(1 << 24))",
    "connection.wait([ours, child.sentinel])",
    "queue.get()",
    "queue.get(timeout=60)",
    "full.put(2)",
    "done.wait()",
    "semaphore.acquire()",
    "joinable.join()",
    "time.sleep(60)",
]


def interrupt(program: Program, *, group: bool = False) -> None:
    """Send Ctrl-C once the program blocks, and wait until it says that it was interrupted."""
    assert program.line() == "ready"
    wait_for(lambda: _sleeps(program.pid))
    if group:
        os.killpg(program.pid, signal.SIGINT)
    else:
        program.signal(signal.SIGINT)
    assert program.line() == "interrupted"


def _sleeps(pid: int) -> bool:
    with open(f"/proc/{pid}/stat") as file:
        return file.read().rpartition(") ")[2][0] == "S"


@pytest.mark.parametrize("call", CALLS)
def test_each_blocking_call(launch: Callable[..., Program], call: str) -> None:
    program = launch(SCRIPT.format(prepare="pass", call=call, clean="joinable.task_done()"))
    interrupt(program)
    assert program.finish() == ""


POOL_CALLS = [
    "pool.map(time.sleep, [60] * 10)",
    "pool.apply(time.sleep, (60,))",
    "pool.map_async(time.sleep, [60] * 10).get()",
    "pool.map_async(time.sleep, [60] * 10).wait()",
    "list(pool.imap(time.sleep, [60] * 10))",
    "list(pool.imap_unordered(time.sleep, [60] * 10))",
    "pool.starmap(time.sleep, [(60,)] * 10_000, chunksize=1)",
    "pool.apply_async(time.sleep, (60,)); pool.close(); pool.join()",
]


@pytest.mark.parametrize("call", POOL_CALLS)
def test_each_blocking_call_of_a_pool(launch: Callable[..., Program], call: str) -> None:
    script = SCRIPT.format(prepare="pool = fiber.Pool(2)", call=call, clean="pool.terminate()")
    program = launch(script)
    interrupt(program)
    assert program.finish() == ""
    assert "Traceback" not in program.stderr, "only the master saw it"


@pytest.mark.parametrize("backend", ["local", "loopback"])
@pytest.mark.parametrize("call", ["pool.map(time.sleep, [60] * 10)", "child.join()", "queue.get()"])
def test_ctrl_c_in_a_terminal_interrupts_the_program_only(
    launch: Callable[..., Program], backend: str, call: str
) -> None:
    script = SCRIPT.format(
        prepare="pool = fiber.Pool(2)", call=call, clean="pool.terminate(); pool.join()"
    )
    program = launch(script, env={"FIBER_BACKEND": backend}, process_group=0)
    interrupt(program, group=True)
    assert program.finish() == ""
    assert "Traceback" not in program.stderr
    assert "KeyboardInterrupt" not in program.stderr


UNCAUGHT = """
    import fiber, time
    if __name__ == "__main__":
        pool = fiber.Pool(2)
        print("ready", flush=True)
        pool.map(time.sleep, [60] * 100)
"""


@pytest.mark.parametrize("backend", ["local", "loopback"])
def test_uncaught_it_ends_the_program_and_all_of_it(
    launch: Callable[..., Program], backend: str
) -> None:
    program = launch(UNCAUGHT, env={"FIBER_BACKEND": backend}, process_group=0)
    assert program.line() == "ready"
    wait_for(lambda: _sleeps(program.pid))
    os.killpg(program.pid, signal.SIGINT)
    assert program.wait() == -signal.SIGINT
    assert program.left() == []
    assert program.stderr.count("KeyboardInterrupt") == 1


UNCAUGHT_WITH_CHILDREN = """
    import fiber
    from faults import targets

    def start_another(connection):
        fiber.Process(target=targets.block).start()
        targets.report_and_block(connection)

    if __name__ == "__main__":
        ours, theirs = fiber.Pipe()
        child = fiber.Process(target={target}, args=(theirs,), name="the child")
        child.start()
        ours.recv()
        print("ready", flush=True)
        child.join()
"""


@pytest.mark.parametrize("backend", ["local", "loopback"])
@pytest.mark.parametrize("target", ["targets.report_and_block", "start_another"])
def test_uncaught_it_ends_processes_that_the_program_waits_for(
    launch: Callable[..., Program], target: str, backend: str
) -> None:
    script = UNCAUGHT_WITH_CHILDREN.format(target=target)
    program = launch(script, env={"FIBER_BACKEND": backend}, process_group=0)
    assert program.line() == "ready"
    os.killpg(program.pid, signal.SIGINT)
    assert program.wait() == -signal.SIGINT
    assert program.left() == []


@pytest.mark.parametrize("backend", ["local", "loopback"])
def test_it_names_the_processes_that_ignore_it_and_a_second_one_ends_them(
    launch: Callable[..., Program], backend: str
) -> None:
    script = UNCAUGHT_WITH_CHILDREN.format(target="targets.ignore_sigint")
    program = launch(script, env={"FIBER_BACKEND": backend}, process_group=0)
    assert program.line() == "ready"
    os.killpg(program.pid, signal.SIGINT)
    wait_for(lambda: "processes that go on after Ctrl-C: the child." in program.stderr)
    os.killpg(program.pid, signal.SIGINT)
    assert program.wait() == -signal.SIGINT
    assert program.left() == []
    assert "Exception ignored" not in program.stderr
    assert program.stderr.count("Traceback") == 1


@pytest.mark.parametrize("backend", ["local", "loopback"])
def test_caught_it_leaves_the_processes_alone(launch: Callable[..., Program], backend: str) -> None:
    program = launch(CAUGHT, env={"FIBER_BACKEND": backend}, process_group=0)
    interrupt(program, group=True)
    assert program.finish() == ""
    assert program.stderr == ""


CAUGHT = """
    import fiber
    from faults import targets
    if __name__ == "__main__":
        ours, theirs = fiber.Pipe()
        child = fiber.Process(target=targets.echo, args=(theirs,))
        child.start()
        theirs.close()
        try:
            print("ready", flush=True)
            ours.recv()
        except KeyboardInterrupt:
            print("interrupted", flush=True)
        ours.send("still there")
        assert ours.recv() == "still there"
        ours.close()
"""


IMPATIENT = """
    import fiber, time
    from faults import targets
    if __name__ == "__main__":
        pool = fiber.Pool(2)
        children = [fiber.Process(target=targets.shrug_off_signals) for _ in range(2)]
        for child in children:
            child.start()
        print("ready", flush=True)
        pool.map(time.sleep, [60] * 100)
"""


def test_an_impatient_user_presses_it_again_and_again(launch: Callable[..., Program]) -> None:
    program = launch(IMPATIENT, process_group=0)
    assert program.line() == "ready"
    wait_for(lambda: _sleeps(program.pid))

    def ended() -> bool:
        os.killpg(program.pid, signal.SIGINT)
        return program.process.poll() is not None

    wait_for(ended)
    assert program.left() == []


INTERRUPTED_SHUTDOWN = """
    import fiber
    from multiprocessing import managers

    real = managers.dispatch

    def dispatch(connection, ident, method, *arguments):
        if method == "shutdown":
            raise KeyboardInterrupt
        return real(connection, ident, method, *arguments)

    if __name__ == "__main__":
        with fiber.Manager():
            managers.dispatch = dispatch
"""


@pytest.mark.parametrize("backend", ["local", "loopback"])
def test_an_interrupt_during_the_shutdown_of_a_manager_ends_its_server(
    launch: Callable[..., Program], backend: str
) -> None:
    program = launch(INTERRUPTED_SHUTDOWN, env={"FIBER_BACKEND": backend})
    assert program.wait() == -signal.SIGINT
    assert program.left() == []


INTERRUPTED_EXIT = """
    import fiber
    from multiprocessing import util

    def interrupt():
        raise KeyboardInterrupt

    if __name__ == "__main__":
        manager = fiber.Manager()
        util.Finalize(None, interrupt, exitpriority=1)
"""


@pytest.mark.parametrize("backend", ["local", "loopback"])
def test_an_interrupt_of_the_exit_functions_ends_the_server_of_a_manager(
    launch: Callable[..., Program], backend: str
) -> None:
    program = launch(INTERRUPTED_EXIT, env={"FIBER_BACKEND": backend})
    assert program.wait() == 0
    assert program.left() == []


PRINTS_FROM_A_CHILD = """
import fcntl, fiber, termios

def say(word):
    print(word, flush=True)

if __name__ == "__main__":
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    settings = termios.tcgetattr(0)
    settings[3] |= termios.TOSTOP
    termios.tcsetattr(0, termios.TCSANOW, settings)
    with fiber.Pool(1) as pool:
        pool.map_async(say, ["hello"]).get(60)
    child = fiber.get_context("spawn").Process(target=print, args=("goodbye",))
    child.start()
    child.join(60)
    print("exit code", child.exitcode, flush=True)
"""


def test_a_terminal_that_stops_background_jobs_does_not_stop_children(tmp_path: Path) -> None:
    script = tmp_path / "prints.py"
    script.write_text(PRINTS_FROM_A_CHILD)
    ours, theirs = pty.openpty()
    try:
        with subprocess.Popen(
            [sys.executable, str(script)],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
        ) as program:
            os.close(theirs)
            try:
                shown = _read_all(ours)
                assert program.wait(PATIENCE) == 0, shown
            finally:
                program.kill()
    finally:
        os.close(ours)
    assert shown.split() == ["hello", "goodbye", "exit", "code", "0"]


def _read_all(terminal: int) -> str:
    shown = b""
    try:
        while data := os.read(terminal, 4096):
            shown += data
    except OSError:  # a terminal reports in this way that its writer is gone
        pass
    return shown.decode()
