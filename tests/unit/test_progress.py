"""Progress of maps: what is counted, and what each view shows."""

from __future__ import annotations

import builtins
import gc
import io
import sys
import threading
from functools import partialmethod
from typing import Any

import pytest

from census import wait_until
from fiber import _logs
from fiber._runtime import progress_views
from fiber._runtime.answers import TaskFailure
from fiber._runtime.progress import ProgressFuture, ProgressReporter
from fiber._runtime.progress_views import (
    BarView,
    LineView,
    MapProgress,
    RichView,
    choose_view,
    line,
)
from fiber._runtime.work_items import WorkItem
from fiber._wire import work
from patience import PATIENCE
from terminal import drawn


class Future:
    """A ``TaskFuture`` that notes what it gets."""

    def __init__(self) -> None:
        self.seen: list[Any] = []

    def add_results(self, start: int, outcomes: list[Any], mixed: bool, size: int = 0) -> bool:
        self.seen.append((start, len(outcomes), mixed, size))
        return True

    def has_room(self) -> bool:
        return False

    def lift_bound(self) -> None:
        self.seen.append("lifted")

    def set_done(self) -> None:
        self.seen.append("done")

    def set_exception(self, error: BaseException) -> None:
        self.seen.append(error)


class Looks:
    """A view that notes what it shows."""

    def __init__(self) -> None:
        self.shown: list[MapProgress] = []
        self.last: MapProgress | None = None

    def show(self, progress: MapProgress) -> None:
        self.shown.append(progress)

    def finish(self, progress: MapProgress) -> None:
        self.last = progress


def item_of(future: Future) -> WorkItem:
    return WorkItem(work.MAP, future=future)


def counting(item: WorkItem, total: int | None, reporter: ProgressReporter) -> ProgressFuture:
    """Put a future that counts before the future of a map."""
    item.future = made = ProgressFuture(item, "f", total, lambda: 0, reporter.wake)
    return made


def progress(**facts: Any) -> MapProgress:
    usual = {"name": "f", "done": 0, "total": 10, "failed": 0, "lost": 0, "busy": 0, "seconds": 0.0}
    return MapProgress(**{**usual, **facts})


def is_shown() -> bool:
    return "fiber-progress" in [thread.name for thread in threading.enumerate()]


def test_results_are_counted_and_passed_on() -> None:
    future = Future()
    counted = ProgressFuture(item_of(future), "f", 4, lambda: 3, bool)
    assert counted.add_results(0, [1, 2], False, 9)
    assert counted.add_results(2, [TaskFailure(ValueError()), 4], True)
    found = counted.look()
    assert (found.done, found.total, found.failed, found.busy) == (4, 4, 1, 3)
    assert not counted.has_room()
    counted.lift_bound()
    counted.set_done()
    assert bool(counted.is_over)
    assert future.seen == [(0, 2, False, 9), (2, 2, True, 0), "lifted", "done"]


def test_a_map_that_fails_is_over() -> None:
    future, error = Future(), ValueError()
    counted = ProgressFuture(item_of(future), "f", None, lambda: 0, bool)
    counted.set_exception(error)
    assert counted.is_over
    assert future.seen == [error]


def test_the_thread_ends_with_the_last_map() -> None:
    view = Looks()
    reporter = ProgressReporter(lambda: view)
    item = item_of(Future())
    reporter.show(item, counting(item, 3, reporter))
    assert wait_until(lambda: bool(view.shown), PATIENCE)
    assert view.shown[0].total == 3
    assert item.future is not None
    item.future.add_results(0, [1, 2, 3], False)
    item.future.set_done()
    assert wait_until(lambda: view.last is not None, PATIENCE)
    assert view.last is not None
    assert view.last.done == 3
    assert wait_until(lambda: not is_shown(), PATIENCE)


def test_a_finished_map_is_shown_at_once_and_once() -> None:
    view = Looks()
    reporter = ProgressReporter(lambda: view)
    item = item_of(Future())
    reporter.show(item, counting(item, None, reporter))
    reporter.finish(item)
    assert view.last is not None
    view.last = None
    reporter.finish(item)
    reporter.close()
    assert view.last is None


@pytest.mark.parametrize(
    ("facts", "text"),
    [
        ({"done": 5, "seconds": 10.0}, "5 of 10 tasks, 0.5/s, 0:10 left"),
        ({"done": 5, "total": None, "seconds": 10.0}, "5 tasks, 0.5/s"),
        ({"done": 10, "seconds": 5000.0}, "10 of 10 tasks, 0.0/s, in 1:23:20"),
        (
            {"failed": 2, "lost": 1, "busy": 3},
            "0 of 10 tasks, 0.0/s, 2 failed, 1 lost with workers",
        ),
    ],
)
def test_the_words_of_a_line(facts: dict[str, Any], text: str) -> None:
    assert line(progress(**facts)).startswith(f"[fiber] f: {text}")


def test_lines_come_now_and_then_and_at_the_end() -> None:
    lines: list[str] = []
    view = LineView(lines.append)
    for seconds in (0.0, 5.0, 10.0, 11.0, 21.0):
        view.show(progress(done=1, seconds=seconds))
    assert len(lines) == 2
    view.finish(progress(done=10, seconds=22.0))
    assert "10 of 10 tasks" in lines[2]


def test_a_program_without_standard_errors_shows_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", None)
    view = choose_view()
    assert isinstance(view, LineView)
    view.finish(progress())


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def use_terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Let the standard error stream be a terminal."""
    made = Terminal()
    monkeypatch.setattr(sys, "stderr", made)
    monkeypatch.setattr(_logs, "write_around", _logs.write_around)
    monkeypatch.setenv("COLUMNS", "200")
    return made


def without(monkeypatch: pytest.MonkeyPatch, *packages: str) -> None:
    """Let imports of these packages fail."""
    find = builtins.__import__

    def find_others(name: str, *rest: Any) -> Any:
        if name.partition(".")[0] in packages:
            raise ModuleNotFoundError(name)
        return find(name, *rest)

    monkeypatch.setattr(builtins, "__import__", find_others)


@pytest.mark.parametrize(("missing", "kind"), [(("tqdm",), RichView), (("tqdm", "rich"), LineView)])
def test_a_terminal_has_the_best_view_that_is_installed(
    monkeypatch: pytest.MonkeyPatch, missing: tuple[str, ...], kind: type[object]
) -> None:
    use_terminal(monkeypatch)
    without(monkeypatch, *missing)
    assert type(choose_view()) is kind


def test_a_pipe_has_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    assert type(choose_view()) is LineView


@pytest.mark.parametrize("kind", [BarView, RichView])
def test_a_bar_shows_the_counts(
    monkeypatch: pytest.MonkeyPatch, kind: type[progress_views.View]
) -> None:
    if kind is BarView:
        pytest.importorskip("tqdm", reason="tqdm is optional, as for users")
    terminal = use_terminal(monkeypatch)
    view = kind()
    view.show(progress(done=5, failed=1))
    view.finish(progress(done=10, failed=1, seconds=1.0))
    assert "10/10" in terminal.getvalue()
    assert "1 failed" in terminal.getvalue()


def test_a_bar_that_appears_late_counts_from_the_maps_begin(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("tqdm", reason="tqdm is optional, as for users")
    terminal = use_terminal(monkeypatch)
    BarView().finish(progress(done=5, seconds=3600.0))
    assert "[1:00:0" in terminal.getvalue()


def test_a_bar_that_tqdm_has_disabled_shows_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    tqdm = pytest.importorskip("tqdm.auto", reason="tqdm is optional, as for users").tqdm
    monkeypatch.setattr(tqdm, "__init__", partialmethod(tqdm.__init__, disable=True))
    terminal = use_terminal(monkeypatch)
    BarView().finish(progress(done=5))
    assert terminal.getvalue() == ""


def test_a_bar_that_is_dropped_draws_no_last_state(monkeypatch: pytest.MonkeyPatch) -> None:
    # A forked process has a copy, which would write to the terminal of the program.
    pytest.importorskip("tqdm", reason="tqdm is optional, as for users")
    terminal = use_terminal(monkeypatch)
    view = BarView()
    view.show(progress(done=5))
    before = terminal.getvalue()
    del view
    gc.collect()
    assert terminal.getvalue() == before


def test_bars_of_rich_share_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = use_terminal(monkeypatch)
    first, second = RichView(), RichView()
    first.show(progress(name="first"))
    second.show(progress(name="second"))
    first.finish(progress(name="first", done=10))
    second.finish(progress(name="second", done=10))
    assert sys.stderr is terminal
    assert [line.split()[0] for line in drawn(terminal.getvalue()) if line] == ["first", "second"]
