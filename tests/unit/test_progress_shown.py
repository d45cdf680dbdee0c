"""Maps whose progress is shown, by their call or by the configuration, and broken streams."""

from __future__ import annotations

import builtins
import io
import sys
import threading
from collections.abc import Iterable, Iterator
from typing import Any

import pytest

from census import wait_until
from fiber import config
from fiber._runtime import progress, progress_views
from fiber._runtime.progress import ProgressReporter, follow
from fiber._runtime.progress_views import LateView, LineView, MapProgress, choose_view
from fiber._runtime.work_items import Function, WorkItem
from fiber._wire import work
from patience import PATIENCE


class Shown:
    """View that notes that it was shown."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    def show(self, progress: MapProgress) -> None:
        self.seen.append("now")

    def finish(self, progress: MapProgress) -> None:
        self.seen.append(f"last of {progress.name}")


class Future:
    """A ``TaskFuture`` that takes anything."""

    def add_results(self, start: int, outcomes: list[Any], mixed: bool, size: int = 0) -> bool:
        return True

    def has_room(self) -> bool:
        return True

    def lift_bound(self) -> None: ...

    def set_done(self) -> None: ...

    def set_exception(self, error: BaseException) -> None: ...


def item() -> WorkItem:
    return WorkItem(work.MAP, function=Function(1, "f", b"", [], None), future=Future())


@pytest.fixture
def view(monkeypatch: pytest.MonkeyPatch) -> Iterator[Shown]:
    """The view of a reporter, to which a map is short if it takes no time."""
    made = Shown()
    monkeypatch.setattr(progress, "reporter", ProgressReporter(lambda: made))
    monkeypatch.setattr(progress, "QUIET", 1e-9)
    yield made
    progress.reporter.close()
    assert wait_until(lambda: not is_shown(), PATIENCE)


@pytest.fixture
def settings() -> Iterator[None]:
    before = config._current
    yield
    config._current = before


def is_shown() -> bool:
    return "fiber-progress" in [thread.name for thread in threading.enumerate()]


def at(seconds: float) -> MapProgress:
    return MapProgress("f", 0, 1, 0, 0, 0, seconds)


@pytest.mark.parametrize(
    ("wanted", "key", "place", "label"),
    [
        (None, "never", "terminal", ""),
        (None, "auto", "terminal", "f"),
        (None, "auto", "pipe", ""),
        (None, "auto", "child", ""),
        (None, "always", "pipe", "f"),
        (None, "always", "child", ""),
        (False, "always", "terminal", ""),
        (True, "never", "pipe", "f"),
        ("mine", "never", "pipe", "mine"),
        (True, "never", "child", "f"),
    ],
)
def test_a_call_wins_over_the_configuration(
    view: Shown,
    settings: None,
    monkeypatch: pytest.MonkeyPatch,
    wanted: bool | str | None,
    key: Any,
    place: str,
    label: str,
) -> None:
    config.install(config.load({"progress": key}, environ={}))
    monkeypatch.setattr(progress, "is_interactive", lambda: place == "terminal")
    monkeypatch.setattr(progress, "is_child", lambda: place == "child")
    made = item()
    follow(made, wanted, [range(3)], lambda: 0)
    progress.reporter.finish(made)
    assert view.seen[-1:] == ([f"last of {label}"] if label else [])


def test_a_short_map_shows_nothing() -> None:
    shown = Shown()
    view = LateView(lambda: shown, after=0.5)
    view.show(at(0.2))
    view.finish(at(0.4))
    assert shown.seen == []


def test_a_longer_map_shows_its_end() -> None:
    shown = Shown()
    view = LateView(lambda: shown, after=0.5)
    view.show(at(0.4))
    view.show(at(0.6))
    view.finish(at(0.7))
    assert shown.seen == ["now", "last of f"]


class NoLength:
    def __len__(self) -> int:
        raise ValueError("this length is not known")

    def __iter__(self) -> Iterator[int]:
        return iter(())


@pytest.mark.parametrize(
    ("iterables", "total"),
    [
        ([range(3)], 3),
        ([range(3), [1, 2]], 2),
        ([range(3), iter([1])], None),
        ([NoLength()], None),
        ([], None),
    ],
)
def test_the_number_of_tasks(iterables: list[Iterable[Any]], total: int | None) -> None:
    assert progress._total(iterables) == total


# ---- views that fail


class Broken:
    """View that raises."""

    def show(self, progress: MapProgress) -> None:
        raise OSError("the terminal is gone")

    finish = show


def test_a_view_that_raises_is_left_out() -> None:
    reporter = ProgressReporter(Broken)
    made = item()
    reporter.show(made, progress.ProgressFuture(made, "f", 3, lambda: 0, bool))
    reporter.finish(made)
    assert wait_until(lambda: not is_shown(), PATIENCE)


class NoTerminal:
    """Stream that a program or a test runner has put in the place of the usual one."""

    def __init__(self) -> None:
        self.text = ""

    def write(self, text: str) -> None:
        self.text += text


def test_a_stream_that_can_only_write_gets_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = NoTerminal()
    monkeypatch.setattr(sys, "stderr", stream)
    choose_view().finish(at(1.0))
    assert stream.text.startswith("[fiber] f: 0 of 1 tasks")


def test_a_closed_stream_gets_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    stream.close()
    monkeypatch.setattr(sys, "stderr", stream)
    view = choose_view()
    assert type(view) is LineView
    view.finish(at(1.0))


def test_a_child_prints_lines_in_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress_views, "is_interactive", lambda: True)
    monkeypatch.setattr(progress_views, "is_child", lambda: True)
    assert type(choose_view()) is LineView


def test_a_broken_installation_of_a_view_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    find = builtins.__import__

    def find_others(name: str, *rest: Any) -> Any:
        if name.partition(".")[0] in ("tqdm", "rich"):
            raise AttributeError(f"{name} is broken")
        return find(name, *rest)

    monkeypatch.setattr(progress_views, "is_interactive", lambda: True)
    monkeypatch.setattr(builtins, "__import__", find_others)
    assert type(choose_view()) is LineView
