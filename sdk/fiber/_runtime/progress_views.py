"""Views of a map's progress: a bar of tqdm, a bar of rich, or lines.

tqdm draws in terminals and notebooks, where it is installed.  rich draws in terminals.  Everywhere
else, as in a pipe or in continuous integration, a line is printed now and then.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

from fiber import _logs

if TYPE_CHECKING:
    from fiber._runtime.progress import Progress

LINE_INTERVAL = 10.0
"""Seconds between two lines."""


class View(Protocol):
    """View of one map."""

    def show(self, progress: Progress) -> None:
        """Show the progress now."""

    def finish(self, progress: Progress) -> None:
        """Show the last progress, and leave it."""


def choose_view() -> View:
    """Return a view that fits the standard error stream and the installed packages."""
    if _is_notebook() or _is_terminal():
        with contextlib.suppress(ImportError):
            return BarView()
        if _is_terminal():
            with contextlib.suppress(ImportError):
                return RichView()
    return LineView()


def _is_terminal() -> bool:
    with contextlib.suppress(AttributeError, OSError, ValueError):
        return sys.stderr.isatty()
    return False


def _is_notebook() -> bool:
    return "ipykernel" in sys.modules and type(sys.stderr).__module__.startswith("ipykernel")


class BarView:
    """Bar of ``tqdm.auto``.  Lines of workers on other hosts are written above it."""

    def __init__(self) -> None:
        from tqdm.auto import tqdm  # type: ignore[import-untyped]

        # tqdm starts a thread that looks after slow bars, unless the type has no interval for it.
        self._type: Any = type("Bar", (tqdm,), {"monitor_interval": 0})
        self._bar: Any = None

    def show(self, progress: Progress) -> None:
        """Draw the bar."""
        if self._bar is None:
            _logs.write_around = self._type.external_write_mode
            self._bar = self._type(
                desc=progress.name, total=progress.total, unit="task", dynamic_ncols=True
            )
        self._bar.total = progress.total
        self._bar.n = progress.done
        self._bar.set_postfix_str(facts(progress), refresh=False)
        self._bar.refresh()

    def finish(self, progress: Progress) -> None:
        """Draw the bar for the last time."""
        self.show(progress)
        self._bar.close()


class RichView:
    """Bar of rich."""

    def __init__(self) -> None:
        from rich import progress as bars
        from rich.console import Console

        self._bars = bars.Progress(
            "{task.description}",
            bars.BarColumn(),
            bars.MofNCompleteColumn(),
            bars.TimeRemainingColumn(),
            "{task.fields[facts]}",
            console=Console(stderr=True),
            auto_refresh=False,
        )
        self._task: Any = None

    def show(self, progress: Progress) -> None:
        """Draw the bar."""
        if self._task is None:
            self._bars.start()
            self._task = self._bars.add_task(progress.name, facts="")
        self._bars.update(
            self._task, total=progress.total, completed=progress.done, facts=facts(progress)
        )
        self._bars.refresh()

    def finish(self, progress: Progress) -> None:
        """Draw the bar for the last time."""
        self.show(progress)
        self._bars.stop()


class LineView:
    """Lines on the standard error stream."""

    def __init__(self, write: Callable[[str], object] | None = None) -> None:
        self._write = write
        self._next = LINE_INTERVAL

    def show(self, progress: Progress) -> None:
        """Print a line if the last one is old."""
        if progress.seconds >= self._next:
            self._next = progress.seconds + LINE_INTERVAL
            self._print(progress)

    def finish(self, progress: Progress) -> None:
        """Print the last line."""
        self._print(progress)

    def _print(self, progress: Progress) -> None:
        with contextlib.suppress(OSError, ValueError, AttributeError):  # no such stream
            (self._write or sys.stderr.write)(line(progress) + "\n")


def line(progress: Progress) -> str:
    """Return the progress in one line."""
    total = "" if progress.total is None else f" of {progress.total}"
    parts = [f"{progress.done}{total} tasks", f"{progress.rate:.1f}/s"]
    if progress.left:
        parts.append(f"{_clock(progress.left)} left")
    elif progress.left == 0:
        parts.append(f"in {_clock(progress.seconds)}")
    if rest := facts(progress):
        parts.append(rest)
    return f"[fiber] {progress.name}: {', '.join(parts)}"


def facts(progress: Progress) -> str:
    """Return the facts that a bar does not show by itself."""
    parts = [f"{progress.failed} failed"] if progress.failed else []
    parts += [f"{progress.lost} lost with workers"] if progress.lost else []
    parts += [f"{progress.busy} at work"] if progress.busy else []
    return ", ".join(parts)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
