"""What follows from what happens to a pool, and who works for it, until nobody is left.

Whatever happens, to a worker or to a request, is handled in the same way: under ``_lock`` the
ledger and the crew take it in, ``_step`` decides what follows, and after the lock is released
``_act`` does it.  So no event can forget to send what can be sent now, to replace or dismiss a
worker, or to end a pool that has nothing left to do.
"""

from __future__ import annotations

import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from fiber._engine.ledger import Batch, Job, Ledger, Worker
from fiber._runtime.crew import Crew
from fiber._runtime.pump import Pump
from fiber._runtime.requests import Sink
from fiber._runtime.workers import Link, dismiss
from fiber._transport.loop import Loop, Timer

TICK = 1e-4
"""Seconds that any timer waits: less, by a rounding error, would be too early again and again."""


class Terms(NamedTuple):
    """What a pool promises its workers and callers."""

    context: Any
    initializer: Callable[..., object] | None = None
    initargs: tuple[Any, ...] = ()
    minimum: int = 1
    maximum: int = 1
    maxtasks: int | None = None
    retries: int = 3
    retryable: tuple[type[BaseException], ...] = ()
    idle_timeout: float = 60.0


class Plan(NamedTuple):
    """What follows from an event: batches to send, workers to dismiss, the pool's end."""

    batches: list[Batch]
    leaving: list[Link]
    over: bool


class Staff(ABC):
    """The part of a dispatcher that knows no messages; ``Exchange`` adds them."""

    crew: Crew

    def __init__(self, terms: Terms, loop: Loop, pump: Pump, callbacks: Pump) -> None:
        self.terms = terms
        self.pump = pump
        self.callbacks = callbacks
        self.ended = threading.Event()
        self._loop = loop
        self._lock = threading.Lock()
        self._ledger = Ledger()
        self._timers: dict[str, Timer] = {}
        self._closing = False
        self._terminated = False

    @abstractmethod
    def _assign(self) -> list[Batch]:
        """Assign all that can be.  Lock held."""

    @abstractmethod
    def _send_safely(self, batches: Iterable[Batch]) -> None:
        """Send batches, on any thread."""

    @abstractmethod
    def _abort(self, job: Job, error: BaseException) -> None:
        """Fail what is not done of a job.  Lock held."""

    # What follows

    def _step(self) -> Plan:
        """Decide what follows from what happened.  Lock held; ``_act`` does it."""
        crew = self.crew
        self._ledger.starting = crew.starting
        batches = self._assign()
        leaving: list[Link] = []
        for worker in self._ledger.spent():
            crew.let_go(worker.key)
            leaving.append(worker.key)
        if crew.size < crew.maximum:
            self._order()
        if crew.size > crew.minimum:
            self._watch_idle()
        over = False
        if self._closing:
            leaving += self._nobody_needed()
            over = self._is_over()
        return Plan(batches, leaving, over)

    def _act(self, plan: Plan, ends: Iterable[Sink] = ()) -> None:
        """Do what was decided, on any thread."""
        self._send_safely(plan.batches)
        self._tell(plan, ends)

    def _tell(self, plan: Plan, ends: Iterable[Sink] = ()) -> None:
        """Tell everyone but the workers that get work."""
        for sink in ends:
            sink.end()
        if plan.leaving:
            dismiss(plan.leaving)
        if plan.over:
            self._end()

    def _later(self, name: str, seconds: float, action: Callable[[], None]) -> None:
        """Do something once the time comes, unless that is intended already.  Lock held."""
        if name not in self._timers:
            delay = max(seconds, TICK)
            self._timers[name] = self._loop.call_later(delay, self._due, name, action)

    def _due(self, name: str, action: Callable[[], None]) -> None:
        with self._lock:
            self._timers.pop(name, None)
        action()

    def _reconsider(self) -> None:
        """Time has passed."""
        with self._lock:
            plan = self._step()
        self._act(plan)

    # Who works

    def _order(self) -> None:
        """Order workers that are missing.  Lock held."""
        count = self._missing()
        if not count:
            return
        pause = self.crew.pause()
        if pause:
            self._later("hire", pause, self._try_again)
        else:
            self._hire_soon(count)

    def _missing(self) -> int:
        if self._terminated or self.crew.error is not None:
            return 0
        if self._closing and not self._ledger.jobs:
            return 0
        return self.crew.missing(self._ledger.demand(), len(self._ledger.homeless()))

    def _try_again(self) -> None:
        """The pause after failures is over: one more try."""
        with self._lock:
            if self._missing():
                self._hire_soon(1)

    def _hire_soon(self, count: int) -> None:
        self.crew.order(count)
        # Not on the loop's thread, which agents may need for it.
        self.pump.post(self._hire)

    def _hire(self) -> None:
        """Start the workers that are ordered."""
        while self.crew.ordered:
            try:
                link = self.crew.hire()
            except Exception as error:
                # Want of descriptors or memory, mostly.
                with self._lock:
                    self.crew.refused(error)
                    self._check_crew()
            else:
                if link is not None and self._terminated:
                    link.kill()
        self._reconsider()

    def _watch_idle(self) -> None:
        """Look again when the worker that has been idle for longest may leave.  Lock held."""
        idle = self._longest_idle()
        if idle is not None and self.terms.idle_timeout < math.inf:
            due = idle.since + self.terms.idle_timeout
            self._later("idle", due - self._loop.now(), self._thin_out)

    def _longest_idle(self) -> Worker | None:
        """The worker that may leave first, if there are more than there should be."""
        idle = self._ledger.longest_idle()
        if idle is None or self.crew.size <= self.crew.wanted(self._ledger.demand()):
            return None
        return idle

    def _thin_out(self) -> None:
        """Let go workers that have had nothing to do for a while."""
        leaving: list[Link] = []
        with self._lock:
            now, timeout = self._loop.now(), self.terms.idle_timeout
            while (idle := self._longest_idle()) is not None and now >= idle.since + timeout:
                # The ledger has the last word: one that was given work since stays.
                if not self._ledger.leave(idle):
                    break
                self.crew.let_go(idle.key)
                leaving.append(idle.key)
            plan = self._step()
        dismiss(leaving)
        self._act(plan)

    def _check_crew(self) -> None:
        """If workers do not start, fail what depends on it.  Lock held."""
        crew = self.crew
        if self._terminated or crew.trouble is None:
            return
        if crew.error is not None:
            self._give_up(crew.error)
        else:
            for job in set(self._ledger.homeless()):
                self._abort(job, crew.trouble)

    # The end

    def _give_up(self, error: BaseException) -> None:
        """Fail all that is not done, and end the workers.  Lock held."""
        for job in list(self._ledger.jobs):
            self._abort(job, error)
        self.crew.cancel()
        for link in self.crew.staying():
            self.crew.let_go(link)
            link.terminate()

    def _nobody_needed(self) -> list[Link]:
        """Workers to let go since the pool is closed and has nothing left for them.  Lock held."""
        leaving: list[Link] = []
        if not self._ledger.jobs and self.crew.size:
            for link in self.crew.staying():
                if link.worker is None or self._ledger.leave(link.worker):
                    self.crew.let_go(link)
                    leaving.append(link)
        return leaving

    def _is_over(self) -> bool:
        """Whether a closed pool has ended.  Lock held."""
        if self.crew.links or self.crew.ordered:
            return False
        return not self._ledger.jobs or self._terminated or self.crew.error is not None

    def _end(self) -> None:
        """Nobody is left."""
        with self._lock:
            if self.ended.is_set():
                return
            self.ended.set()
            timers, self._timers = self._timers, {}
        for timer in timers.values():
            timer.cancel()
        self.pump.stop()
        self.callbacks.stop()
