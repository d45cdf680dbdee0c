"""Output of remote children, and a stderr that does not keep up with it."""

from __future__ import annotations

import io
import re
import threading
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

from fiber import _logs
from fiber._logs import OutputWriter
from patience import PATIENCE

SAID = re.compile(r"\[fiber\] (\d+) lines are left out here")


class Stuck(io.StringIO):
    """A terminal that takes nothing for as long as it is told to."""

    def __init__(self) -> None:
        super().__init__()
        self.goes_on = threading.Event()
        self.changed = threading.Condition()

    def write(self, text: str) -> int:
        assert self.goes_on.wait(PATIENCE)
        with self.changed:
            written = super().write(text)
            self.changed.notify_all()
            return written

    def wait_for(self, text: str) -> None:
        with self.changed:
            assert self.changed.wait_for(lambda: text in self.getvalue(), PATIENCE)


@pytest.fixture
def stderr(monkeypatch: pytest.MonkeyPatch) -> Stuck:
    stuck = Stuck()
    # pytest puts its own sys.stderr in place after the fixtures.
    monkeypatch.setattr(_logs, "sys", SimpleNamespace(stderr=stuck))
    monkeypatch.setattr(_logs, "_ROOM", 1000)
    return stuck


@pytest.fixture
def lines(stderr: Stuck) -> Iterator[OutputWriter]:
    lines = OutputWriter()
    yield lines
    stderr.goes_on.set()
    lines.close()


def numbers(stderr: Stuck) -> list[int]:
    return [int(line.split()[-1]) for line in stderr.getvalue().splitlines() if "[w]" in line]


def test_lines_beyond_the_limit_of_a_stuck_stderr_are_left_out_and_counted(
    stderr: Stuck, lines: OutputWriter
) -> None:
    for number in range(1000):
        lines.write("w", f"line {number}")
    assert lines._waiting < 1100
    stderr.goes_on.set()
    stderr.wait_for("left out")
    written = numbers(stderr)
    assert written == list(range(len(written)))
    assert SAID.findall(stderr.getvalue()) == [str(1000 - len(written))]


def test_lines_after_a_gap_follow_the_note_about_it(stderr: Stuck, lines: OutputWriter) -> None:
    for number in range(1000):
        lines.write("w", f"line {number}")
    stderr.goes_on.set()
    stderr.wait_for("left out")
    lines.write("w", "line 1000")
    lines.close()
    assert numbers(stderr)[-1] == 1000
    assert "left out" in stderr.getvalue().splitlines()[-2]


def test_lines_left_out_at_the_end_are_counted_too(stderr: Stuck, lines: OutputWriter) -> None:
    for number in range(1000):
        lines.write("w", f"line {number}")
    threading.Timer(0.05, stderr.goes_on.set).start()
    lines.close()
    assert "left out" in stderr.getvalue().splitlines()[-1]


def test_a_stderr_that_keeps_up_gets_every_line(stderr: Stuck, lines: OutputWriter) -> None:
    stderr.goes_on.set()
    for number in range(1000):
        lines.write("w", f"line {number}")
        stderr.wait_for(f"line {number}\n")
    assert numbers(stderr) == list(range(1000))


def test_the_progress_line_stays_below_other_lines(stderr: Stuck, lines: OutputWriter) -> None:
    stderr.goes_on.set()
    lines.show("1 of 2")
    stderr.wait_for("1 of 2")
    lines.write("w", "line 1")
    stderr.wait_for("line 1")
    lines.show("2 of 2")
    stderr.wait_for("2 of 2")
    lines.show("")
    lines.close()
    erase = _logs._ERASE
    assert stderr.getvalue() == f"1 of 2{erase}[w] line 1\n1 of 2{erase}2 of 2{erase}"


def test_a_standing_line_is_removed_at_the_end(stderr: Stuck, lines: OutputWriter) -> None:
    stderr.goes_on.set()
    lines.show("1 of 2")
    lines.close()
    assert stderr.getvalue() in (f"1 of 2{_logs._ERASE}", "")


def test_a_stuck_stderr_gathers_no_lines_that_were_shown(
    stderr: Stuck, lines: OutputWriter
) -> None:
    for number in range(1000):
        lines.show(f"{number} of 1000")
    assert lines._lines.qsize() <= 2
    stderr.goes_on.set()
    stderr.wait_for("999 of 1000")
    assert stderr.getvalue().count("of 1000") <= 3


def test_without_a_thread_lines_are_written_at_the_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    lines = OutputWriter()
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", refuse)
        lines.write("one", "first")
        lines.write("one", "second")
        lines.close()
    assert capsys.readouterr().err == "[one] first\n[one] second\n"
