"""Exit functions of a child run once: atexit, finalizers, queues."""

from __future__ import annotations

import atexit
import os
import subprocess
import sys
import textwrap
from multiprocessing import util
from pathlib import Path
from typing import Any

import pytest

import fiber
from patience import PATIENCE

METHODS = ["forkserver", "spawn"]


def note(path: Path, word: str) -> None:
    with path.open("a") as file:
        file.write(f"{word}\n")


def register(path: Path) -> int:
    atexit.register(note, path, "atexit")
    util.Finalize(None, note, (path, "finalizer"), exitpriority=1)
    return os.getpid()


def register_and_end(path: Path, status: int) -> None:
    register(path)
    sys.exit(status)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("status", [0, 3])
def test_exit_functions_of_a_process_run(tmp_path: Path, method: Any, status: int) -> None:
    notes = tmp_path / "notes"
    process = fiber.get_context(method).Process(target=register_and_end, args=(notes, status))
    process.start()
    process.join(PATIENCE)
    assert process.exitcode == status
    assert sorted(notes.read_text().split()) == ["atexit", "finalizer"]
    process.close()


@pytest.mark.parametrize("method", METHODS)
def test_exit_functions_of_a_pool_worker_run(tmp_path: Path, method: Any) -> None:
    notes = tmp_path / "notes"
    with fiber.get_context(method).Pool(1) as pool:
        pool.apply(register, (notes,))
        pool.close()
        pool.join()
    assert sorted(notes.read_text().split()) == ["atexit", "finalizer"]


def run_script(folder: Path, text: str) -> subprocess.CompletedProcess[str]:
    script = folder / "program.py"
    script.write_text(textwrap.dedent(text))
    return subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=PATIENCE, cwd=folder
    )


@pytest.mark.parametrize("method", METHODS)
def test_a_queue_of_multiprocessing_sends_its_items(tmp_path: Path, method: str) -> None:
    done = run_script(
        tmp_path,
        f"""
        import fiber, multiprocessing
        def target(queue):
            for number in range(1000):
                queue.put(number)
        if __name__ == "__main__":
            queue = multiprocessing.get_context("spawn").Queue()
            process = fiber.get_context("{method}").Process(target=target, args=(queue,))
            process.start()
            print(sum(queue.get(timeout={PATIENCE}) for _ in range(1000)))
            process.join()
        """,
    )
    assert (done.stdout, done.stderr) == ("499500\n", "")


@pytest.mark.parametrize("method", METHODS)
def test_output_of_exit_functions_is_not_lost(tmp_path: Path, method: str) -> None:
    done = run_script(
        tmp_path,
        f"""
        import atexit, fiber
        def target():
            atexit.register(print, "the end", end="")
        if __name__ == "__main__":
            process = fiber.get_context("{method}").Process(target=target)
            process.start()
            process.join()
            print(process.exitcode)
        """,
    )
    assert (done.stdout, done.stderr) == ("the end0\n", "")


def test_exit_functions_of_the_main_module_belong_to_the_importing_process(tmp_path: Path) -> None:
    # Forked children share objects with their zygote, say a folder: none may remove it.
    done = run_script(
        tmp_path,
        """
        import atexit, os, sys, fiber
        atexit.register(lambda: print("end of", __name__, flush=True))
        def target():
            pass
        if __name__ == "__main__":
            for method in ("forkserver", "forkserver", "spawn", "spawn"):
                print(method, flush=True)
                process = fiber.get_context(method).Process(target=target)
                process.start()
                process.join()
        """,
    )
    assert done.stderr == ""
    spawn = ["spawn", "end of __mp_main__"] * 2
    zygote_and_program = ["end of __mp_main__", "end of __main__"]
    lines = done.stdout.splitlines()
    assert lines == ["forkserver", "forkserver", *spawn, *zygote_and_program]


def test_a_child_ends_the_runtime_that_it_made(tmp_path: Path) -> None:
    done = run_script(
        tmp_path,
        """
        import fiber
        def target():
            pool = fiber.Pool(1)
            print(pool.apply(abs, (-1,)), *[process.pid for process in pool._pool])
        if __name__ == "__main__":
            process = fiber.Process(target=target)
            process.start()
            process.join()
            print(process.exitcode)
        """,
    )
    value, worker, status = done.stdout.split()
    assert (value, status, done.stderr) == ("1", "0", "")
    assert not Path("/proc", worker).exists()
