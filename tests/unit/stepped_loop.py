"""Loop that a test takes from turn to turn, with a clock that only the test moves."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import pytest

from fiber._transport import loop as loop_module
from fiber._transport.loop import Loop
from patience import PATIENCE

_MOST_TURNS = 10_000
"""Turns until a loop counts as one that never comes to rest."""


class SteppedLoop(Loop):
    """Loop without a thread: callbacks run in ``turn``, ``settle`` and ``run_until`` alone."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        self.calls = 0
        """Callbacks that were made."""
        self.errors: list[BaseException] = []
        """Exceptions of callbacks."""
        self.time = 1000.0
        monkeypatch.setattr(loop_module, "_call", self._count)

    def now(self) -> float:  # type: ignore[override]  # a clock of its own
        return self.time

    def on_thread(self) -> bool:
        return True

    def turn(self) -> int:
        """Run what is ready, without waiting; return the number of callbacks."""
        before = self.calls
        self._ready.append((_nothing, ()))  # so that the loop does not wait
        self._run_once()
        return self.calls - before

    def settle(self) -> None:
        """Run until nothing is ready; fails if that never comes."""
        quiet = 0
        for _ in range(_MOST_TURNS):
            quiet = 0 if self.turn() else quiet + 1
            if quiet == 2:
                break
        else:
            pytest.fail("the loop does not come to rest")
        assert self.errors == []

    def run_until(self, condition: Callable[[], object]) -> None:
        """Run until ``condition``, which other threads or the kernel bring about."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline
            if not self.turn():
                os.sched_yield()
        assert self.errors == []

    def pass_time(self, seconds: float) -> None:
        """Move the clock, second by second, and run what is due."""
        for _ in range(round(seconds)):
            self.time += 1.0
            self.settle()

    def watched(self) -> int:
        """Return the number of descriptors that are watched, without the loop's own."""
        return len(self._readers) - 1

    def _count(self, callback: Callable[..., object], *args: Any) -> None:
        if callback is _nothing:
            return
        self.calls += 1
        try:
            callback(*args)
        except Exception as error:
            self.errors.append(error)


def _nothing() -> None:
    pass
