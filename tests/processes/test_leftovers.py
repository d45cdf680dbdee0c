"""An agent among processes of its own user: they read nothing of it and outlive no master."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from fiber._agent import main
from patience import PATIENCE

USED = {
    "_DEPENDENCIES", "_PAUSE", "_PR_SET_DUMPABLE", "_descendants", "_place_of", "_reap",
    "end_descendants", "hide_this_process", "keep_search_path",
}  # fmt: skip


def source() -> str:
    """Return the part of the module that needs the standard library alone."""
    text = Path(main.__file__).read_text(encoding="utf-8")
    parts = ["from __future__ import annotations"]
    for node in ast.parse(text).body:
        names = [target.id for target in getattr(node, "targets", []) if hasattr(target, "id")]
        if isinstance(node, ast.Import) or USED.intersection([*names, getattr(node, "name", "")]):
            parts.append(ast.get_source_segment(text, node) or "")
    return "\n".join(parts) + "\n"


SOURCE = source()

AS_A_USER = """
if os.geteuid() == 0:  # whom the kernel lets read everything
    os.setresgid(65534, 65534, 65534)
    os.setresuid(65534, 65534, 65534)
ctypes.CDLL(None).prctl(4, 1)  # dumpable, as processes are that begin as a user
"""

SPY = """
if os.fork() == 0:
    for name in ("mem", "environ", "fd", "maps"):
        path = "/proc/%d/%s" % (os.getppid(), name)
        with contextlib.suppress(PermissionError):
            os.listdir(path) if name == "fd" else open(path, "rb").close()
            print("reads", name, flush=True)
    os._exit(0)
os.wait()
"""


def run(program: str, first: str = AS_A_USER) -> str:
    command = [sys.executable, "-I", "-S", "-c", SOURCE + first + program]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert done.stderr == ""
    return done.stdout


def test_no_process_of_its_user_reads_a_hidden_one() -> None:
    assert run("hide_this_process()" + SPY) == ""


def test_an_unhidden_process_is_readable_to_processes_of_its_user() -> None:
    assert "reads environ" in run(SPY)


def test_a_kernel_that_refuses_to_hide_it_is_noticed() -> None:
    refuses = "ctypes.CDLL = lambda name: type('', (), {'prctl': lambda *arguments: -1})\n"
    answers = "print(hide_this_process())"
    assert run(f"{answers}\n{refuses}\n{answers}") == "True\nFalse\n"


def test_modules_come_only_from_where_modules_came_from(tmp_path: Path) -> None:
    """``used`` has one of this process, ``kept`` has a dependency that is imported late."""
    for place, name in [
        ("used", "mine"), ("used", "wave"), ("used", "late"), ("kept", "pynng"), ("cwd", "msvcrt"),
    ]:  # fmt: skip
        (tmp_path / place).mkdir(exist_ok=True)
        (tmp_path / place / f"{name}.py").write_text("")
    before = f"sys.path[:0] = [{str(tmp_path)!r} + each for each in ('/cwd', '/used', '/kept')]\n"
    after = """
import mine
keep_search_path()
import wave, late
try: import msvcrt
except ImportError: print("no msvcrt")
print(os.path.dirname(wave.__file__) == sysconfig.get_path("stdlib"))
print([os.path.basename(place) for place in sys.path][-2:])
"""
    assert run(after, before) == "no msvcrt\nTrue\n['used', 'kept']\n"


LEAVES = """
ctypes.CDLL(None).prctl(36, 1)  # a subreaper, as an agent that serves several masters
reader, writer = os.pipe()
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        os.write(writer, str(os.getpid()).encode())
        time.sleep(600)
    os._exit(0)
left = int(os.read(reader, 100))
print(end_descendants(60))
print(os.path.exists("/proc/%d" % left))
"""


def test_a_process_that_left_its_parents_and_session_is_ended() -> None:
    assert run(LEAVES) == "True\nFalse\n"


def test_a_process_that_cannot_be_ended_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(main, "_reap", lambda: True)
    monkeypatch.setattr(main, "_descendants", list)
    assert not main.end_descendants(0.0)
