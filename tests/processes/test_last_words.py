"""The stacks that a child leaves: how much of them is kept, and that no child lives for them."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from pathlib import Path

import pytest

import fiber
from census import wait_until
from fiber._agent import last_words, zygote
from fiber._agent.last_words import ProgressTable
from patience import PATIENCE
from processes.test_zygote import Master


def left(text: str, *, told: bool = True) -> str:
    fd = last_words.make_file()
    os.write(fd, text.encode())
    return last_words.read(fd, told=told)


def test_frames_of_fibers_own_are_left_out() -> None:
    ours = os.path.dirname(last_words.__file__)
    text = f"""Fatal Python error: Aborted

Current thread 0x1 (most recent call first):
  File "/task.py", line 1 in task
  File "{ours}/worker.py", line 1 in run
  File "/lib/process.py", line 1 in run

Thread 0x2 (most recent call first):
  File "/thread.py", line 1 in run

Extension modules: numpy, torch (total: 2)
"""
    assert left(text).splitlines() == [
        "Fatal Python error: Aborted",
        "",
        "Current thread 0x1 (most recent call first):",
        '  File "/task.py", line 1 in task',
        "",
        "Thread 0x2 (most recent call first):",
        '  File "/thread.py", line 1 in run',
    ]


def test_long_stacks_are_cut() -> None:
    found = left('  File "/deep.py", line 1 in down\n' * 10_000)
    assert last_words.LIMIT // 2 < len(found) <= last_words.LIMIT
    assert found.endswith("\n...")


def test_a_late_answer_is_no_reason_of_a_death() -> None:
    late = 'Current thread 0x1 (most recent call first):\n  File "/task.py", line 1 in task\n'
    assert left(late, told=False) == ""
    crash = 'Fatal Python error: Aborted\n\nCurrent thread 0x1:\n  File "/task.py", line 2 in task'
    assert left(late * 10_000 + crash, told=False) == crash


def test_the_thread_that_runs_the_task_comes_first() -> None:
    other = 'Thread 0x2 (most recent call first):\n  File "/lib.py", line 1 in wait'
    current = 'Current thread 0x1 (most recent call first):\n  File "/task.py", line 1 in task'
    others = "\n\n".join([other] * 1000)
    assert left(f"{others}\n\n{current}\n").startswith(f"{current}\n\n{other}")
    crash = "Fatal Python error: Aborted"
    assert left(f"{crash}\n\n{others}\n\n{current}\n").startswith(f"{crash}\n\n{current}\n\n")


def test_without_a_descriptor_no_file_for_last_words_is_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object) -> int:
        raise OSError(24, "too many open files")

    monkeypatch.setattr(os, "memfd_create", refuse)
    assert last_words.make_file() == -1


def ignore_and_announce(signum: int, path: Path) -> None:
    signal.signal(signum, signal.SIG_IGN)
    path.touch()
    time.sleep(600)


def test_a_child_that_does_not_write_them_is_killed(tmp_path: Path) -> None:
    table = ProgressTable()
    master = Master(table)
    ready = tmp_path / "ready"
    try:
        master.started(1, target=ignore_and_announce, args=(last_words.TELL, ready))
        assert wait_until(ready.exists, PATIENCE)
        master.say(zygote.SIGNAL, 1, last_words.TELL)
        assert master.hear() == (zygote.EXITED, 1, -signal.SIGKILL)
    finally:
        master.close()
        table.close()


def write_and_announce(path: Path) -> None:
    """Write a late answer to SHOW, as a child does that was stopped."""
    (fd,) = open_memory_files()
    os.write(int(fd), b"late answer\n")
    path.touch()
    time.sleep(600)


def test_the_stack_of_a_killed_child_has_no_late_answer(tmp_path: Path) -> None:
    table = ProgressTable()
    master = Master(table)
    ready = tmp_path / "ready"
    try:
        master.started(1, target=write_and_announce, args=(ready,))
        assert wait_until(ready.exists, PATIENCE)
        master.say(zygote.SIGNAL, 1, last_words.TELL)
        *end, stack = master.hear()
        assert end == [zygote.EXITED, 1, -signal.SIGKILL]
        assert " in write_and_announce" in stack
        assert "late answer" not in stack
    finally:
        master.close()
        table.close()


def test_a_child_that_is_unknown_has_no_stack() -> None:
    table = ProgressTable()
    master = Master(table)
    try:
        master.say(zygote.SIGNAL, 1, last_words.SHOW)
        kind, child, text = master.hear()
        assert (kind, child) == (zygote.STACK, 1)
        assert "it has not started" in text
    finally:
        master.close()
        table.close()


def open_memory_files(_: object = None) -> list[str]:
    return [fd for fd in os.listdir("/proc/self/fd") if "last-words" in name_of(fd)]


def name_of(fd: str) -> str:
    with contextlib.suppress(FileNotFoundError):  # that of the listing
        return os.readlink(f"/proc/self/fd/{fd}")
    return ""


def test_a_child_has_its_own_alone() -> None:
    with fiber.Pool(4) as pool:
        assert [len(found) for found in pool.broadcast(open_memory_files)] == [1] * 4
    pool.join()
