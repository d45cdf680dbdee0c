"""Messages during a wait: one live line on a terminal, few lines elsewhere."""

from __future__ import annotations

import os
import sys
from types import SimpleNamespace
from typing import Any

import pytest

from fiber._backends.kubernetes import waiting
from fiber._backends.kubernetes.waiting import Progress
from memory_link import SimulatedLoop


class Said:
    """An ``Output`` that keeps what is said, and when."""

    def __init__(self, loop: SimulatedLoop) -> None:
        self.loop = loop
        self.shown: list[tuple[float, str]] = []
        self.written: list[tuple[float, str]] = []

    def show(self, line: str) -> None:
        self.shown.append((self.loop.now(), line))

    def write(self, who: str, text: str) -> None:
        self.written.append((self.loop.now(), f"{who}: {text}"))


@pytest.fixture
def loop() -> SimulatedLoop:
    return SimulatedLoop()


@pytest.fixture
def said(loop: SimulatedLoop) -> Said:
    return Said(loop)


@pytest.fixture
def wait(loop: SimulatedLoop, said: Said) -> Progress:
    output: Any = said
    return Progress(loop, output, lambda: f"0 of 8 pods ready at {loop.now():g}")


def stderr_is(monkeypatch: pytest.MonkeyPatch, stderr: object) -> None:
    monkeypatch.setattr(waiting, "sys", SimpleNamespace(stderr=stderr))


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    stderr_is(monkeypatch, SimpleNamespace(isatty=lambda: True, fileno=lambda: 2))
    size = os.terminal_size((28, 24))
    monkeypatch.setattr(os, "get_terminal_size", lambda descriptor: size)


@pytest.fixture
def file(monkeypatch: pytest.MonkeyPatch) -> None:
    stderr_is(monkeypatch, SimpleNamespace(isatty=lambda: False))


@pytest.mark.usefixtures("terminal")
class TestOnATerminal:
    def test_the_progress_line_is_shown_each_second_and_removed(
        self, loop: SimulatedLoop, wait: Progress, said: Said
    ) -> None:
        wait.start()
        loop.run_for(2.5)
        wait.stop()
        loop.run_for(60)
        assert [time for time, _ in said.shown] == [1.0, 2.0, 2.5]
        assert said.shown[-1][1] == ""
        assert said.written == []

    def test_the_progress_line_is_cut_to_the_width_of_the_terminal(
        self, loop: SimulatedLoop, wait: Progress, said: Said
    ) -> None:
        wait.start()
        loop.run_for(1)
        assert said.shown == [(1.0, "[fiber] 0 of 8 pods ready at 1"[:27])]

    def test_a_short_wait_shows_no_line(
        self, loop: SimulatedLoop, wait: Progress, said: Said
    ) -> None:
        wait.start()
        loop.run_for(0.9)
        wait.stop()
        assert {line for _, line in said.shown} == {""}

    def test_a_wait_that_begins_again_shows_again(
        self, loop: SimulatedLoop, wait: Progress, said: Said
    ) -> None:
        for _ in range(2):
            wait.start()
            wait.start()
            loop.run_for(1)
            wait.stop()
            wait.stop()
        assert [line[:16] for _, line in said.shown] == ["[fiber] 0 of 8 p", ""] * 2

    def test_a_terminal_that_does_not_say_how_wide_it_is(
        self,
        loop: SimulatedLoop,
        wait: Progress,
        said: Said,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        def refuse(descriptor: int) -> os.terminal_size:
            raise OSError("not a terminal after all")

        monkeypatch.setattr(os, "get_terminal_size", refuse)
        wait.start()
        loop.run_for(1)
        assert said.shown == [(1.0, "[fiber] 0 of 8 pods ready at 1")]


@pytest.mark.usefixtures("file")
class TestElsewhere:
    def test_a_line_is_written_after_five_seconds_and_then_each_minute(
        self, loop: SimulatedLoop, wait: Progress, said: Said
    ) -> None:
        wait.start()
        loop.run_for(70)
        wait.stop()
        loop.run_for(600)
        assert said.written == [
            (5.0, "fiber: 0 of 8 pods ready at 5"),
            (65.0, "fiber: 0 of 8 pods ready at 65"),
        ]
        assert said.shown == []

    @pytest.mark.parametrize("stderr", [None, sys.__stderr__])
    def test_a_missing_or_closed_stderr_is_not_a_terminal(
        self,
        loop: SimulatedLoop,
        wait: Progress,
        said: Said,
        monkeypatch: pytest.MonkeyPatch,
        stderr: object,
    ) -> None:
        def closed() -> bool:
            raise ValueError("I/O operation on closed file")

        stderr_is(monkeypatch, stderr and SimpleNamespace(isatty=closed))
        wait.start()
        loop.run_for(5)
        assert len(said.written) == 1
