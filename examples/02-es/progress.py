"""Progress bar in the last line of a terminal; without a terminal only the lines."""

from __future__ import annotations

import shutil
import sys
import time
from types import TracebackType

REDRAW_SECONDS = 0.1
ERASE_LINE = "\r\x1b[K"


class Progress:
    """Counter up to `total`; as a context manager, it removes its bar at the end."""

    def __init__(self, total: int, unit: str) -> None:
        self._total = total
        self._unit = unit
        self._done = 0
        self._visible = sys.stdout.isatty()
        self._started = time.monotonic()
        self._next_draw = self._started

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._erase()

    def advance(self, count: int) -> None:
        """Count so many more as done."""
        self._done += count
        now = time.monotonic()
        if self._visible and now >= self._next_draw:
            self._next_draw = now + REDRAW_SECONDS
            self._draw(now - self._started)

    def say(self, line: str) -> None:
        """Print a line above the bar."""
        self._erase()
        print(line, flush=True)
        self._next_draw = 0

    def _draw(self, elapsed: float) -> None:
        part = self._done / self._total
        left = elapsed / part - elapsed
        text = f" {part:4.0%}  {self._done:,} of {self._total:,} {self._unit}, {left:.0f} s left"
        width = max(10, min(40, shutil.get_terminal_size().columns - len(text) - 1))
        bar = "━" * round(part * width)
        print(f"{ERASE_LINE}{bar:·<{width}}{text}", end="", flush=True)

    def _erase(self) -> None:
        if self._visible:
            print(ERASE_LINE, end="", flush=True)
