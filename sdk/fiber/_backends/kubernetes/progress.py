"""Line on stderr that tells what is waited for, while that lasts."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

from fiber._backends.output import Output
from fiber._transport.link import EventLoop, Timer

_FIRST_SHOWN, _SHOWN_AGAIN = 1.0, 1.0
"""Seconds on a terminal, where each line takes the place of the one before."""

_FIRST_WRITTEN, _WRITTEN_AGAIN = 5.0, 60.0
"""Seconds elsewhere, where lines stay."""

_COLUMNS = 80


class Progress:
    """Says what ``describe()`` does, again and again while a wait lasts.

    On the loop's thread.
    """

    def __init__(self, loop: EventLoop, output: Output, describe: Callable[[], str]) -> None:
        self._loop = loop
        self._output = output
        self._describe = describe
        self._timer: Timer | None = None
        self._shows = False

    def start(self) -> None:
        """The wait begins, or goes on."""
        if self._timer is None:
            self._shows = _is_terminal()
            first = _FIRST_SHOWN if self._shows else _FIRST_WRITTEN
            self._timer = self._loop.call_later(first, self._say)

    def stop(self) -> None:
        """End the waiting: remove the line from a terminal."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
            if self._shows:
                self._output.show("")

    def _say(self) -> None:
        text = self._describe()
        if self._shows:
            # A line that wraps cannot be taken away.
            self._output.show(f"[fiber] {text}"[: _columns() - 1])
        else:
            self._output.write("fiber", text)
        again = _SHOWN_AGAIN if self._shows else _WRITTEN_AGAIN
        self._timer = self._loop.call_later(again, self._say)


def _is_terminal() -> bool:
    try:
        return sys.stderr.isatty()
    except (AttributeError, ValueError):  # there is none, or it is closed
        return False


def _columns() -> int:
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns or _COLUMNS
    except (AttributeError, OSError, ValueError):  # some terminals do not say
        return _COLUMNS
