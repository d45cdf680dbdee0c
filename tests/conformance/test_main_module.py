"""Functions, classes and errors of ``__main__`` work however the program was started."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

import pytest

from conformance.main_checks import CALL, DEFINITIONS, PATIENCE, PROGRAM, RESULT

TESTS = Path(__file__).parents[1]
BACKENDS = ["local", "loopback"]
LIMIT = 60
pytestmark = pytest.mark.timeout(LIMIT)

ONCE = "top level of __main__\n"
"""Output of a program whose children need not, or must not, import it."""


class Programs:
    """``program.py``, and the same as package, folder and archive, in a folder."""

    def __init__(self, folder: Path, backend: str) -> None:
        self.folder = folder
        (folder / "program.py").write_text(PROGRAM)
        (folder / "package").mkdir()
        (folder / "package" / "__init__.py").touch()
        (folder / "package" / "__main__.py").write_text(PROGRAM)
        with zipfile.ZipFile(folder / "app.pyz", "w") as archive:
            archive.writestr("__main__.py", PROGRAM)
        self.environment = {
            **os.environ,
            "FIBER_BACKEND": backend,
            "PYTHONPATH": os.pathsep.join([str(TESTS), *filter(None, sys.path)]),
            "HOME": str(folder),  # sessions keep their history there, and kernels their files
        }

    def run(self, *arguments: str, **options: Any) -> str:
        """Return the interpreter's output with these arguments."""
        done: subprocess.CompletedProcess[str] = subprocess.run(
            [sys.executable, *arguments],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=LIMIT,
            **options,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout


@pytest.fixture(params=BACKENDS)
def programs(request: pytest.FixtureRequest, tmp_path: Path) -> Programs:
    return Programs(tmp_path, request.param)


def from_file(programs: Programs) -> str:
    with (programs.folder / "program.py").open() as file:
        return programs.run("-", stdin=file)


def through_runpy(call: str) -> Callable[[Programs], str]:
    return lambda programs: programs.run("-c", f"import runpy; runpy.{call}")


IMPORTED: Mapping[str, Callable[[Programs], str]] = {
    "file": lambda programs: programs.run("program.py"),
    "module": lambda programs: programs.run("-m", "program"),
    "run_path": through_runpy("run_path('program.py', run_name='__main__')"),
    "run_module, altering sys": through_runpy(
        "run_module('program', run_name='__main__', alter_sys=True)"
    ),
}
BY_VALUE: Mapping[str, Callable[[Programs], str]] = {
    "command": lambda programs: programs.run("-c", PROGRAM),
    "package": lambda programs: programs.run("-m", "package"),
    "folder": lambda programs: programs.run("package"),
    "archive": lambda programs: programs.run("app.pyz"),
    "pipe": lambda programs: programs.run(input=PROGRAM),
    "standard input": from_file,
    "run_module": through_runpy("run_module('program', run_name='__main__')"),
    "%run": lambda programs: programs.run("-m", "IPython", "-c", "%run program.py"),
}


@pytest.mark.timeout(LIMIT)
@pytest.mark.parametrize("start", IMPORTED.values(), ids=IMPORTED.keys())
def test_children_import_the_program_without_its_guarded_part(
    programs: Programs, start: Callable[[Programs], str]
) -> None:
    output = start(programs)
    imported = output.replace("top level of __mp_main__\n", "")
    assert imported == ONCE + RESULT
    assert output != imported


@pytest.mark.timeout(LIMIT)
@pytest.mark.parametrize("start", BY_VALUE.values(), ids=BY_VALUE.keys())
def test_functions_of_a_program_that_children_do_not_import_travel_by_value(
    programs: Programs, start: Callable[[Programs], str]
) -> None:
    assert start(programs) == ONCE + RESULT


@pytest.mark.timeout(LIMIT)
def test_a_program_from_standard_input_needs_no_guard(tmp_path: Path) -> None:
    unguarded = DEFINITIONS + CALL
    assert Programs(tmp_path, "local").run(input=unguarded) == ONCE + RESULT


GLOBALS = """\
import fiber

number, words = 1, ["one"]

def read(calls=[]): calls.append(0); return number, words[-1], len(calls)

def total(x): return x + number

def rebind(f): f.extra = number; return f(1)

with fiber.Pool(1) as pool, fiber.futures.ProcessPoolExecutor(1) as executor:
    for changed in (1, 2, 1):
        number = changed
        words.append(str(changed))
        print(pool.apply(read), pool.apply(total, (1,)), end=" ")
        print(pool.apply_async(total, (2,)).get(), pool.map(total, [3]), end=" ")
        print(executor.submit(total, 4).result(), pool.apply(rebind, (total,)))
    class Count: step = 5
    def total(x): return x + number + Count.step
    print(pool.apply(total, (1,)))
    Count.step = 6
    print(pool.apply(total, (1,)), pool.map(total, [2]))
"""
"""Session that changes what its functions read."""


@pytest.mark.timeout(LIMIT)
def test_changes_of_a_sessions_globals_reach_its_workers(programs: Programs) -> None:
    assert programs.run("-c", GLOBALS).splitlines() == [
        "(1, '1', 1) 2 3 [4] 5 2",
        "(2, '2', 1) 3 4 [5] 6 3",
        "(1, '1', 1) 2 3 [4] 5 2",
        "7",
        "8 [9]",
    ]


@pytest.mark.timeout(LIMIT)
def test_a_program_under_a_debugger_prints_its_result(programs: Programs) -> None:
    output = programs.run("-m", "pdb", "-c", "continue", "program.py", input="quit\n")
    assert RESULT in output.replace("top level of __mp_main__\n", "")


# Sessions


def typed(programs: Programs, *arguments: str, **environment: str) -> str:
    """Return the text of a terminal in which the program is typed to the interpreter."""
    programs.environment.update(environment)
    ours, theirs = pty.openpty()
    with os.fdopen(ours, "r+b", buffering=0) as terminal:
        session = subprocess.Popen(
            [sys.executable, *arguments],
            cwd=programs.folder,
            env=programs.environment,
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
        )
        os.close(theirs)
        for line in f"{DEFINITIONS}{CALL}exit()\n".splitlines(keepends=True):
            terminal.write(line.encode())
        shown = _read_to_the_end(terminal)
        assert session.wait(PATIENCE) == 0, shown
    return shown


def _read_to_the_end(terminal: IO[bytes]) -> str:
    shown = b""
    while True:
        try:
            data = terminal.read(1 << 16)
        except OSError:  # EIO: no process has the terminal open
            data = b""
        if not data:
            return shown.decode().replace("\r\n", "\n")
        shown += data


@pytest.mark.timeout(LIMIT)
@pytest.mark.parametrize("terminal", ["xterm", "dumb"])
def test_an_interactive_session_can_start_processes(programs: Programs, terminal: str) -> None:
    shown = typed(programs, "-q", TERM=terminal)
    assert RESULT in shown, shown


@pytest.mark.timeout(LIMIT)
def test_an_interactive_session_after_a_program_can_start_processes(programs: Programs) -> None:
    (programs.folder / "before.py").touch()
    shown = typed(programs, "-i", "before.py", TERM="dumb")
    assert RESULT in shown, shown


@pytest.mark.timeout(LIMIT)
def test_a_notebook_can_start_processes(programs: Programs) -> None:
    for name, cell in (("first", DEFINITIONS), ("second", CALL)):
        (programs.folder / name).write_text(cell)
    assert programs.run("-m", "jupyter_client.runapp", "first", "second") == ONCE + RESULT
