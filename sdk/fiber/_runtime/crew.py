"""Who works for a pool: how many there should be, and when it is no use to try again.

Guarded by the pool's lock: methods are called with it held, unless they say otherwise.
"""

from __future__ import annotations

import threading
from typing import Any

from fiber._agent import worker
from fiber._agent.interface import ExitReport
from fiber._runtime.workers import Link, PoolProcess, Supervisor, dismiss
from fiber.errors import FiberError, StartError

TRIES = 3
"""Workers that may fail to start, one after the other, before the pool gives up or hesitates."""

LONGEST_PAUSE = 60.0
"""Seconds between two tries, at most, while workers that are there go on."""

IDLE_PAUSE = 1.0
"""Seconds before one is replaced when many have died with nothing to do."""


class Crew:
    """The workers of a pool, ``minimum`` to ``maximum`` of them.

    ``links`` are those whose processes were started and are not gone, ``size`` counts those that
    are to stay, ``starting`` those of them that are not ready; both with what is only ``ordered``.
    ``failures`` counts the workers that were gone before they were ready, since the last that was;
    ``idle_deaths`` those that died with nothing to do, since the last that did something.
    ``trouble`` says why none starts, after some tries and until one does; with nobody at work it
    is also the ``error``, and there is no point in going on.
    """

    def __init__(
        self,
        supervisor: Supervisor,
        lock: threading.Lock,
        context: Any,
        arguments: tuple[Any, ...],
        minimum: int,
        maximum: int,
    ) -> None:
        self.links: dict[Link, None] = {}
        self.size = 0
        self.starting = 0
        self.ordered = 0
        self.minimum = minimum
        self.maximum = maximum
        self.failures = 0
        self.idle_deaths = 0
        self.trouble: StartError | None = None
        self.error: FiberError | None = None
        self._supervisor = supervisor
        self._lock = lock
        self._context = context
        self._arguments = arguments

    def staying(self) -> list[Link]:
        """Those that were not told to go."""
        return [link for link in self.links if not link.leaving]

    def wanted(self, demand: int) -> int:
        """How many workers there should be for so many tasks."""
        return min(max(demand, self.minimum), self.maximum)

    def missing(self, demand: int, newcomers: int) -> int:
        """Workers to order for so many tasks, ``newcomers`` of which only new workers may run."""
        missing = self.wanted(demand) - self.size
        return max(missing, min(newcomers - self.starting, self.maximum - self.size), 0)

    def pause(self) -> float:
        """Seconds to wait before the next order, after what happened to the last ones."""
        if self.failures >= TRIES and self.size > self.starting:
            return min(2.0 ** min(self.failures - TRIES, 10), LONGEST_PAUSE)
        # With nobody at work the next failure is the end: no need to put it off.
        return IDLE_PAUSE if self.idle_deaths > TRIES + self.maximum else 0.0

    def order(self, count: int) -> None:
        """Count workers that somebody will ``hire``."""
        self.size += count
        self.starting += count
        self.ordered += count

    def hire(self) -> Link | None:
        """Start one that was ordered, if any; without the lock.

        The supervisor hears what becomes of it.
        """
        with self._lock:
            if not self.ordered:
                return None
            self.ordered -= 1
            link = Link(self._supervisor)
            self.links[link] = None
        process = PoolProcess(link, self._context, target=worker.run, args=self._arguments)
        try:
            process.start()
        except BaseException:
            with self._lock:
                self.links.pop(link, None)
                self._uncount(link)
            raise
        link.process = process
        if link.leaving:  # it was told to before it could be reached
            dismiss((link,))
        return link

    def cancel(self) -> None:
        """Forget what is ordered and not hired yet."""
        self.size -= self.ordered
        self.starting -= self.ordered
        self.ordered = 0

    def ready(self) -> None:
        """One that was starting is ready."""
        self.starting -= 1
        self.failures = 0
        self.trouble = None

    def let_go(self, link: Link) -> None:
        """It is not to stay; the caller sees to it that it hears of that, or dies."""
        self._uncount(link)
        link.leaving = True

    def gone(self, link: Link, report: ExitReport) -> None:
        """It is gone."""
        self.links.pop(link, None)
        if link.leaving:
            return
        self._uncount(link)
        if link.worker is not None:
            self.idle_deaths += not link.worker.queue
        elif not report.reason.startswith("agent "):  # a lost host says nothing of the worker
            text = link.complaint or "\n".join(report.log)
            reason = "it raised an error" if link.complaint else report.reason
            # A signal may be an accident, and hit several that start at the same time.
            tries = TRIES + (min(self.maximum, TRIES) if report.exitcode < 0 else 0)
            self._failed(StartError(f"pool worker {link.name!r}", reason, text, tries), tries)

    def refused(self, reason: BaseException) -> None:
        """One could not even be asked for."""
        error = StartError("a pool worker", str(reason), "", TRIES)
        error.__cause__ = reason
        self._failed(error, TRIES)

    def _failed(self, error: StartError, tries: int) -> None:
        self.failures += 1
        if self.failures >= tries:
            self.trouble = error
            if self.size == self.starting:
                self.error = error

    def _uncount(self, link: Link) -> None:
        if not link.leaving:
            self.size -= 1
            self.starting -= link.worker is None
