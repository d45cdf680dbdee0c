"""Modules that a zygote imports for its children, and which threads keep it from being forked."""

from __future__ import annotations

import os
import re
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

import census
from fiber._agent import preload, zygote
from fiber._agent.last_words import ProgressTable
from fiber._agent.preload import Imports
from patience import PATIENCE
from processes.test_zygote import Master, progress_table

__all__ = ["progress_table"]

PYTHON_THREAD = """
import threading
threading.Thread(target=threading.Event().wait, name="waits for ever", daemon=True).start()
"""
NATIVE_THREAD = """
import ctypes
libc = ctypes.CDLL(None)
helper = ctypes.c_ulong()
libc.pthread_create(ctypes.byref(helper), None, libc.pause, None)
libc.pthread_setname_np(helper, b"a helper")
"""
ENDED_THREAD = """
import os, threading, time
thread = threading.Thread(target=int)
thread.start()
thread.join()
while len(os.listdir("/proc/self/task")) > 1:  # the system ends it a moment later
    time.sleep(0.001)
"""
ENDS_BEFORE_A_FORK = """
import os, threading
end = threading.Event()
thread = threading.Thread(target=end.wait)
thread.start()
def stop():
    end.set()
    thread.join()
os.register_at_fork(before=stop)
"""


class Program:
    """A main module with modules beside it, and what zygotes say to it."""

    def __init__(self, folder: Path, table: ProgressTable, **modules: str) -> None:
        for name, text in modules.items():
            (folder / f"{name}.py").write_text(text)
        self.main = str(folder / "main.py")
        self._table = table
        self.preparation = {
            "sys_path": [str(folder), *sys.path],
            "init_main_from_path": self.main,
        }

    def ask(self, imports: Imports | None = None, **options: Any) -> tuple[Any, ...]:
        """The answer of a new zygote to its first START."""
        master = Master(self._table, imports=imports, **options)
        master.start(1, preparation=self.preparation)
        answer = master.hear()
        master.close()
        return answer


@pytest.mark.parametrize("text", [ENDED_THREAD, ENDS_BEFORE_A_FORK], ids=["ended", "ends"])
def test_threads_that_no_fork_finds_do_no_harm(
    progress_table: ProgressTable, tmp_path: Path, text: str
) -> None:
    assert Program(tmp_path, progress_table, main=text).ask()[0] == zygote.STARTED


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "name"),
    [(PYTHON_THREAD, "waits for ever"), (NATIVE_THREAD, "a helper")],
    ids=["python", "native"],
)
def test_threads_that_survive_a_fork_are_reported_once(
    progress_table: ProgressTable,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    text: str,
    name: str,
) -> None:
    program = Program(tmp_path, progress_table, main=text)
    kind, _, safe = program.ask()
    assert kind == zygote.FORK_UNSAFE
    said = capfd.readouterr().err
    assert said.startswith(
        f"fiber: importing {program.main} starts threads ({name}), and a process"
    )
    assert re.search(r"which takes \d+ ms\. Start the threads in a function", said)
    assert program.ask(safe)[0] == zygote.STARTED
    assert program.ask(ancestors=(os.getpid(),))[0] == zygote.FORK_UNSAFE
    assert capfd.readouterr().err == "", "the program's first zygote has said it"


def test_the_next_zygote_gets_the_imports_before_the_first_that_starts_threads(
    progress_table: ProgressTable, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log"
    text = f"""
import os
who = "zygote" if os.getpid() == os.getpgid(0) else "child"
print(__name__, who, os.environ.get("LEVEL"), file=open({str(log)!r}, "a"))
"""
    main = """
import os
os.environ["LEVEL"] = "1"
import quiet
os.environ["LEVEL"] = "2"
from noisy import libc
import later
"""
    program = Program(
        tmp_path, progress_table, main=main, quiet=text, noisy=text + NATIVE_THREAD, later=text
    )
    kind, _, safe = program.ask()
    assert (kind, safe.modules) == (zygote.FORK_UNSAFE, ("os", "quiet"))
    assert "fiber: importing noisy starts threads (a helper)" in capfd.readouterr().err
    assert log.read_text().splitlines() == ["quiet zygote 1", "noisy zygote 2", "later zygote 2"]
    log.write_text("")
    master = Master(progress_table, imports=safe)
    master.start(1, preparation=program.preparation)
    expected = ["quiet zygote 1", "noisy child 2", "later child 2"]
    assert census.wait_until(lambda: log.read_text().splitlines() == expected, PATIENCE)
    master.close()


@pytest.mark.parametrize(
    ("text", "modules"),
    [
        ("import quiet\nquiet.level = 1\nimport later", ("quiet",)),
        ("def f(): import later\nimport quiet\nf()", ()),
        ("import sys\nsys.path.append('x')\nimport later", ("sys", "later")),
        ("'docs'\nfrom __future__ import annotations\nN = 1\nimport quiet, later",
         ("__future__", "quiet", "later")),
    ],
)  # fmt: skip
def test_imports_that_could_depend_on_the_main_module_are_not_made_without_it(
    progress_table: ProgressTable, tmp_path: Path, text: str, modules: tuple[str, ...]
) -> None:
    main = f"{text}\nif True: pass\n{NATIVE_THREAD}"
    kind, _, safe = Program(tmp_path, progress_table, main=main, quiet="", later="").ask()
    assert (kind, safe.modules) == (zygote.FORK_UNSAFE, modules)


def test_imports_that_start_threads_only_there_are_left_out_in_turn(
    progress_table: ProgressTable, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    program = Program(tmp_path, progress_table, main="", quiet="", noisy=NATIVE_THREAD)
    imports = Imports(("quiet", "noisy"), dict(os.environb))
    kind, _, safe = program.ask(imports)
    assert (kind, safe.modules) == (zygote.FORK_UNSAFE, ("quiet",))
    assert program.ask(safe)[0] == zygote.STARTED
    assert capfd.readouterr().err == ""


def test_a_trial_fork_that_fails_or_hangs_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    fork = os.fork

    def refuse() -> int:
        raise BlockingIOError

    def hang() -> int:
        pid = fork()
        if pid == 0:
            signal.pause()
        return pid

    assert preload._trial_fork_ends()
    monkeypatch.setattr(preload, "_TRIAL_TIMEOUT", 0.1)
    for broken in (refuse, hang):
        monkeypatch.setattr(os, "fork", broken)
        assert not preload._trial_fork_ends()
