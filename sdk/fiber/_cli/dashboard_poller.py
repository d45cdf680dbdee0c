"""Poller of the live page: asks a program again and again, on a thread, while a page wants it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from fiber._cli.asking import Ask
from fiber._cli.dashboard_model import same_start
from fiber._cli.failures import NOT_FOUND, CommandError
from fiber._monitor import client

PATIENCE = 4.0
"""Seconds that a program of this machine may take for a part of its answer."""

_INTERVAL = 0.5
"""Seconds between two answers while a page is open."""

_QUIET_INTERVAL = 1.0
"""Seconds between two answers while no page is open, if the program has asked for its page."""

_ANSWER_SHARE = 3
_QUIET_ANSWER_SHARE = 30
"""Pauses are so many times as long as an answer takes, so that a program with much to say works."""


class News(NamedTuple):
    """Answers of the program to one look at it, or why there are none."""

    program: dict[str, Any] | None = None
    activity: dict[str, Any] | None = None
    state: dict[str, list[dict[str, Any]]] | None = None
    problem: str = ""
    has_ended: bool = False


class ProgramPoller:
    """Thread that asks a program and passes on its ``News``.

    ``find`` returns the function that asks the program, and CommandError if there is no such
    program.  ``publish`` runs on the thread.
    """

    def __init__(
        self, find: Callable[[], Ask], publish: Callable[[News], None], *, always: bool
    ) -> None:
        self._find = find
        self._publish = publish
        self._always = always
        self._ask: Ask | None = None
        self._pid: int | None = None
        """Process that is shown; a pod may have several that use Fiber."""
        self._since = 0
        self._start = 0.0
        self._pages = 0
        self._changed = threading.Condition()
        self._is_due = False
        """True if a page waits for an answer."""
        self._has_ended = self._is_ending = False
        self._thread = threading.Thread(target=self._run, name="fiber-dashboard", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def opened(self) -> None:
        """Note that a page is open: look at once."""
        with self._changed:
            self._pages += 1
            self._is_due = True
            self._changed.notify()

    def closed(self) -> None:
        """Note that a page is closed."""
        with self._changed:
            self._pages -= 1

    def end(self, seconds: float) -> None:
        """Look for the last time, now, and end; wait so many seconds for that."""
        with self._changed:
            self._is_ending = True
            self._changed.notify()
        self._thread.join(seconds)

    def _run(self) -> None:
        pause, is_last = 0.0, False
        while not is_last:
            self._wait(pause)
            is_last = self._is_ending
            began = time.monotonic()
            news = self.look()
            took = time.monotonic() - began
            self._has_ended = news.has_ended
            self._publish(news)
            pause = self._pause(0.0 if news.problem else took)

    def _pause(self, took: float) -> float:
        if self._pages:
            return max(_INTERVAL, _ANSWER_SHARE * took)
        return max(_QUIET_INTERVAL, _QUIET_ANSWER_SHARE * took)

    def _wait(self, pause: float) -> None:
        """Wait until the program is to be asked."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_due or self._is_ending, pause)
            self._changed.wait_for(lambda: self._is_due or self._is_ending or self._is_wanted())
            self._is_due = False

    def _is_wanted(self) -> bool:
        return not self._has_ended and (self._always or self._pages > 0)

    def look(self) -> News:
        """Return the program's answers now."""
        try:
            if self._ask is None:
                self._ask = self._find()
            return self._answers(self._ask)
        except client.ProgramGone as error:
            self._ask = None
            return News(problem=str(error), has_ended=True)
        except client.NoAnswer as error:
            return News(problem=str(error))
        except CommandError as error:
            self._ask = None
            reason = f"{error.what}: {error.why}" if error.why else error.what
            return News(problem=reason, has_ended=error.status == NOT_FOUND)

    def _answers(self, ask: Ask) -> News:
        activity = self._activity(ask)
        if not activity["complete"] and not same_start(activity["start"], self._start):
            self._since = 0
            activity = self._activity(ask)
        program, lines = self._chosen(ask({"ask": "state"}))
        state: dict[str, list[dict[str, Any]]] = {"pools": [], "children": [], "deaths": []}
        kinds = {"pool": "pools", "child": "children", "death": "deaths"}
        for line in lines:
            for kind, facts in line.items():
                if kind in kinds:
                    state[kinds[kind]].append(facts)
        # Only now: if the second answer fails, the first one is asked for again.
        self._since, self._start = activity["revision"], activity["start"]
        return News(program, activity, state)

    def _activity(self, ask: Ask) -> dict[str, Any]:
        _, lines = self._chosen(ask({"ask": "activity", "since": self._since}))
        for line in lines:
            if "activity" in line:
                found: dict[str, Any] = line["activity"]
                return found
        raise client.NoAnswer("the program's answer has no activity")

    def _chosen(
        self, answer: Iterator[dict[str, Any]]
    ) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """Return the facts and the lines of the process that is shown."""
        processes: dict[int, tuple[dict[str, Any], list[dict[str, Any]]]] = {}
        lines: list[dict[str, Any]] = []
        for line in answer:
            if "program" in line:
                lines = []
                processes[line["program"]["pid"]] = (line["program"], lines)
            elif "error" in line:
                raise CommandError("cannot read the program's answer", str(line["error"]))
            else:
                lines.append(line)
        if not processes:
            raise client.ProgramGone("the program has ended")
        if self._pid not in processes:
            self._pid = max(processes, key=lambda pid: int(processes[pid][0]["children"]))
            self._start = 0.0  # its record is another one
        return processes[self._pid]
