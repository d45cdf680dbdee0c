"""Captured output: whole lines, the last of them remembered, never a hang."""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import subprocess
from collections.abc import Callable, Iterator
from typing import TypeVar

import pytest

import census
from fiber._agent.service import LAST_LINES, Capture
from fiber._transport.loop import Loop
from patience import PATIENCE

_T = TypeVar("_T")


class Captured:
    """A capture whose child is the test itself."""

    def __init__(self, loop: Loop) -> None:
        self.texts: list[str] = []
        self.busy = False
        self._loop = loop
        self._capture = self._on_loop(lambda: Capture(loop, self.texts.append, lambda: self.busy))
        self.out = os.dup(self._capture.stdio[0])
        self._on_loop(self._capture.started)

    def _on_loop(self, function: Callable[[], _T]) -> _T:
        results: queue.SimpleQueue[_T] = queue.SimpleQueue()
        self._loop.call_soon(lambda: results.put(function()))
        return results.get(timeout=PATIENCE)

    def write(self, data: bytes) -> None:
        os.write(self.out, data)

    def lines(self) -> list[str]:
        return "\n".join(self.texts).split("\n") if self.texts else []

    def wait_for(self, count: int) -> list[str]:
        assert census.wait_until(lambda: len(self.lines()) >= count, PATIENCE), self.texts
        return self.lines()

    def is_watched(self) -> bool:
        """Return whether the output wakes the loop."""
        return self._capture._reader in self._loop._readers

    def hang_up(self) -> None:
        os.close(self.out)

    def finish(self) -> tuple[str, ...]:
        return self._on_loop(self._capture.finish)


@pytest.fixture
def captured(loop: Loop) -> Iterator[Captured]:
    made = Captured(loop)
    yield made
    made.finish()


def test_lines_are_passed_on_as_they_come_and_the_rest_at_the_end(captured: Captured) -> None:
    captured.write(b"one\ntwo\nthr")
    assert captured.wait_for(2) == ["one", "two"]
    captured.write(b"ee\nfour")
    assert captured.wait_for(3) == ["one", "two", "three"]
    captured.hang_up()
    assert captured.finish() == ("one", "two", "three", "four")
    assert captured.lines() == ["one", "two", "three", "four"]


def test_only_the_last_lines_are_remembered(captured: Captured) -> None:
    captured.write(b"".join(b"line %d\n" % index for index in range(100)))
    captured.hang_up()
    assert captured.finish() == tuple(f"line {index}" for index in range(100 - LAST_LINES, 100))
    assert len(captured.lines()) == 100


def test_windows_ends_of_lines_and_broken_text_do_no_harm(captured: Captured) -> None:
    captured.write(b"a\r\n\xff\xfe\n\n")
    captured.hang_up()
    assert captured.finish() == ("a", "\ufffd\ufffd", "")


def test_an_endless_line_is_passed_on_in_pieces(captured: Captured) -> None:
    captured.write(b"x" * 20_000)
    assert [len(piece) for piece in captured.wait_for(2)] == [8192, 8192]
    captured.hang_up()
    assert sum(map(len, captured.finish())) == 20_000


def test_an_output_that_was_closed_early_costs_no_processor(captured: Captured) -> None:
    captured.write(b"last\n")
    captured.hang_up()
    captured.wait_for(1)
    assert census.wait_until(lambda: not captured.is_watched(), PATIENCE)
    assert captured.finish() == ("last",)


def test_the_writer_waits_while_the_link_is_behind_and_no_output_is_lost(
    captured: Captured,
) -> None:
    captured.busy = True
    os.set_blocking(captured.out, False)
    written = 0
    with contextlib.suppress(BlockingIOError):
        while True:
            written += os.write(captured.out, b"0123456789abcde\n" * 64)
    assert written < 1 << 20, "the pipe is full, no more was taken"
    captured.busy = False
    assert len(captured.wait_for(written // 16)) == written // 16
    captured.hang_up()


def test_a_process_that_writes_without_end_does_not_delay_the_end(captured: Captured) -> None:
    flood = subprocess.Popen(["yes"], stdout=captured.out)
    captured.hang_up()
    captured.wait_for(1000)
    assert captured.finish() == ("y",) * LAST_LINES
    assert flood.wait(PATIENCE) == -signal.SIGPIPE


def test_finished_twice_is_finished_once(captured: Captured) -> None:
    captured.write(b"only\n")
    captured.hang_up()
    assert captured.finish() == captured.finish() == ("only",)
    assert captured.lines() == ["only"]


def test_a_child_that_never_started_leaves_no_descriptor(loop: Loop) -> None:
    before = len(os.listdir("/proc/self/fd"))
    made = Capture(loop, print, lambda: False)
    assert made.finish() == ()
    assert len(os.listdir("/proc/self/fd")) == before
