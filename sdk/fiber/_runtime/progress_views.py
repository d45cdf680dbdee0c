"""Views of a map's progress: a bar of tqdm, a bar of rich, or lines.

tqdm draws in terminals and notebooks, where it is installed.  rich draws in terminals.  Everywhere
else, as in a pipe or in continuous integration, a line is printed now and then.  So it is in
children, whose bars would overwrite each other and the program's.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from multiprocessing.process import parent_process
from typing import Any, ClassVar, NamedTuple, Protocol

from fiber import _logs

LINE_INTERVAL = 10.0
"""Seconds between two lines."""

QUIET = 0.5
"""Seconds that a map runs before a ``LateView`` of it appears."""


class MapProgress(NamedTuple):
    """Progress of a map at one moment."""

    name: str
    """Label of the map: the user's, or the name of the function."""
    done: int
    total: int | None
    """Number of tasks; None while the input is being read."""
    failed: int
    lost: int
    """Runs that were lost with their workers."""
    busy: int
    """Workers at work in the pool."""
    seconds: float
    """Seconds since the map began."""

    @property
    def rate(self) -> float:
        """Tasks a second since the map began."""
        return self.done / self.seconds if self.seconds > 0 else 0.0

    @property
    def left(self) -> float | None:
        """Seconds until the end at this rate; None if that is not known."""
        if self.total is None or not self.done:
            return None
        return (self.total - self.done) / self.rate


class View(Protocol):
    """View of one map."""

    def show(self, progress: MapProgress) -> None:
        """Show the progress now."""

    def finish(self, progress: MapProgress) -> None:
        """Show the last progress, and leave it."""


def choose_view() -> View:
    """Return a view that fits the standard error stream and the installed packages."""
    if is_interactive() and not is_child():
        with contextlib.suppress(Exception):  # not installed, or its installation is broken
            return BarView()
        if _is_terminal():
            with contextlib.suppress(Exception):
                return RichView()
    return LineView()


def is_interactive() -> bool:
    """Return whether the standard error stream is a terminal or a notebook."""
    return _is_notebook() or _is_terminal()


def is_child() -> bool:
    """Return whether this process is a child of a program, as a worker is."""
    return parent_process() is not None


def _is_terminal() -> bool:
    with contextlib.suppress(AttributeError, OSError, ValueError):
        return sys.stderr.isatty()
    return False


def _is_notebook() -> bool:
    return "ipykernel" in sys.modules and type(sys.stderr).__module__.startswith("ipykernel")


class LateView:
    """View that is made when its map has run for ``after`` seconds: a shorter map shows nothing."""

    def __init__(self, make_view: Callable[[], View], after: float) -> None:
        self._make_view = make_view
        self._after = after
        self._view: View | None = None

    def show(self, progress: MapProgress) -> None:
        """Show the progress, unless the map is young."""
        if view := self._made(progress):
            view.show(progress)

    def finish(self, progress: MapProgress) -> None:
        """Show the last progress, unless the map was young."""
        if view := self._made(progress):
            view.finish(progress)

    def _made(self, progress: MapProgress) -> View | None:
        if self._view is None and progress.seconds >= self._after:
            self._view = self._make_view()
        return self._view


class BarView:
    """Bar of ``tqdm.auto``.  Lines of workers on other hosts are written above it."""

    def __init__(self) -> None:
        from tqdm.auto import tqdm  # type: ignore[import-untyped]

        class Bar(tqdm):  # type: ignore[misc]
            monitor_interval = 0  # else tqdm starts a thread that looks after slow bars

            def __del__(self) -> None:
                """Draw nothing: the copy of a bar in a forked process is not the last state."""

        self._type: Any = Bar
        self._bar: Any = None

    def show(self, progress: MapProgress) -> None:
        """Draw the bar."""
        if self._bar is None:
            _logs.write_around = self._type.external_write_mode
            self._bar = self._type(
                desc=progress.name, total=progress.total, unit="task", dynamic_ncols=True
            )
            if not self._bar.disable:  # by a variable of tqdm
                self._bar.start_t -= progress.seconds
        self._bar.total = progress.total
        self._bar.n = progress.done
        self._bar.set_postfix_str(facts(progress), refresh=False)
        self._bar.refresh()

    def finish(self, progress: MapProgress) -> None:
        """Draw the bar for the last time."""
        # tqdm takes the lock again.  Without it a ``tqdm.write`` may come between bar and line end.
        with self._type.get_lock():
            self.show(progress)
            self._bar.close()


class RichView:
    """Bar of rich.  The bars of the program share one display, as rich has one at a time."""

    _display: ClassVar[Any] = None
    _open: ClassVar[int] = 0
    """Number of bars in the display."""

    def __init__(self) -> None:
        import rich.progress  # noqa: F401 - missing packages are noticed here

        self._task: Any = None

    def show(self, progress: MapProgress) -> None:
        """Draw the bar."""
        display = RichView._display or self._start()
        if self._task is None:
            self._task = display.add_task(progress.name, total=progress.total, facts="")
            RichView._open += 1
        display.update(
            self._task, total=progress.total, completed=progress.done, facts=facts(progress)
        )
        display.refresh()

    def finish(self, progress: MapProgress) -> None:
        """Draw the bar for the last time, above those that go on."""
        self.show(progress)
        display = RichView._display
        RichView._open -= 1
        if RichView._open:
            (task,) = (task for task in display.tasks if task.id == self._task)
            display.console.print(display.make_tasks_table([task]))
            display.remove_task(self._task)
        else:
            RichView._display = None
            display.stop()

    @staticmethod
    def _start() -> Any:
        from rich import progress as bars
        from rich.console import Console

        RichView._display = display = bars.Progress(
            bars.TextColumn("{task.description}", markup=False),
            bars.BarColumn(),
            bars.MofNCompleteColumn(),
            bars.TimeRemainingColumn(),
            bars.TextColumn("{task.fields[facts]}", markup=False),
            console=Console(stderr=True),
            auto_refresh=False,
            # What the program prints appears above the bars.  A file or pipe gets it unchanged.
            redirect_stdout=sys.stdout is not None and sys.stdout.isatty(),
        )
        display.start()
        return display


class LineView:
    """Lines on the standard error stream."""

    def __init__(self, write: Callable[[str], object] | None = None) -> None:
        self._write = write
        self._next = LINE_INTERVAL

    def show(self, progress: MapProgress) -> None:
        """Print a line if the last one is old."""
        if progress.seconds >= self._next:
            self._next = progress.seconds + LINE_INTERVAL
            self._print(progress)

    def finish(self, progress: MapProgress) -> None:
        """Print the last line."""
        self._print(progress)

    def _print(self, progress: MapProgress) -> None:
        with contextlib.suppress(OSError, ValueError, AttributeError):  # no such stream
            (self._write or sys.stderr.write)(line(progress) + "\n")


def line(progress: MapProgress) -> str:
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


def facts(progress: MapProgress) -> str:
    """Return the facts that a bar does not show by itself."""
    parts = [f"{progress.failed} failed"] if progress.failed else []
    parts += [f"{progress.lost} lost with workers"] if progress.lost else []
    parts += [f"{progress.busy} at work"] if progress.busy else []
    return ", ".join(parts)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
