"""Simulated run: time, hosts, workers, and the master that gives them work."""

from __future__ import annotations

import heapq
import random
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Protocol

from fiber._agent.interface import ChildObserver
from fiber._transport.loop import LoopTimer
from memory_link import SimulatedLoop
from simulation import schedule
from simulation.agents import LOST_AFTER, Agent, Child
from simulation.oracle import Oracle, Violation
from simulation.remote_hosts import RemoteHost
from simulation.schedule import (
    Crash,
    Cut,
    Drain,
    Famine,
    Fault,
    Kill,
    Lie,
    Repeat,
    Schedule,
    Slow,
    StillBirth,
    Stop,
    Task,
    Terminate,
)
from simulation.workers import NO_OP, Broken, Ref, Unknown, Work, Worker

PATIENCE = 300
"""Simulated seconds after which a missing event of a link counts as lost."""

CALLS = 50_000
"""More calls than any schedule needs: it goes round in circles."""

MOMENTS = 1e-5, 1e-4, 3e-3
"""Seconds until another thread gets its turn, at most: on an idle machine, on a busy one."""

INSTANT = 1e-9
"""Seconds between two events one of which must come first."""

END = 1e6
"""Simulated seconds after which no event can be left."""


class Loop(SimulatedLoop):
    """The simulated loop, and threads beside it.

    What another thread does happens at once, but what it asks of the loop comes there later, by
    what the seed chooses, and as each thread asked for it in turn: that thread may be interrupted
    before it asks, and the loop may be busy.
    """

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.after_turn: Callable[[], None] = lambda: None
        """Called whenever something was done on the loop thread."""
        self._rng = random.Random(f"{seed} threads")
        self._longest = self._rng.choice(MOMENTS)
        self._thread: str | None = None
        self._asked: dict[str, deque[Callable[[], object]]] = defaultdict(deque)
        self._heard_at: dict[str, float] = {}

    def depend(self, dependent: object) -> None:
        """Ignore the dependent: this loop never fails."""

    def on_thread(self) -> bool:
        """Return whether the caller may take this for the loop thread."""
        return self._thread is None

    @contextmanager
    def off_thread(self, name: str) -> Iterator[None]:
        """Run the block on the thread of this name."""
        before, self._thread = self._thread, name
        try:
            yield
        finally:
            self._thread = before

    def moment(self) -> float:
        """Seconds until another thread gets its turn."""
        return self._rng.random() * self._longest

    def heard_in(self, thread: str) -> float:
        """Return the seconds until the loop has received all that ``thread`` has asked for."""
        return max(0.0, self._heard_at.get(thread, 0.0) - self._now)

    def comes_after(self, thread: str, earlier: str) -> None:
        """Order the requests of ``thread`` after all earlier requests of ``earlier``."""
        heard_at = self._heard_at.get(earlier, 0.0), self._heard_at.get(thread, 0.0)
        self._heard_at[thread] = max(heard_at) + INSTANT

    def call_soon(self, callback: Callable[..., object], *args: Any) -> None:
        """Call it in the next turn; if another thread asks, when the seed says."""
        thread = self._thread
        if thread is None:
            call: Any = partial(callback, *args)
            self._ready.append(call)
            return
        self._asked[thread].append(partial(callback, *args))
        due = max(self._now + self.moment(), self._heard_at.get(thread, 0.0))
        self._heard_at[thread] = due
        self.call_later(due - self._now, self._heed, thread)

    def _heed(self, thread: str) -> None:
        self._asked[thread].popleft()()

    def call_later(self, seconds: float, callback: Callable[..., object], *args: Any) -> Any:
        """Call it once, ``seconds`` from now."""
        timer: Any = LoopTimer(self._now + seconds, partial(callback, *args))
        heapq.heappush(self._timers, (timer.due, next(self._sequence), timer))
        return timer

    def _turn(self, end: float) -> bool:
        turned = super()._turn(end)
        self.after_turn()
        return turned


class Language(Protocol):
    """Format of the messages between master and workers."""

    def work(
        self, worker: Worker, seq: int, payload: Any, buffers: Sequence[memoryview]
    ) -> Work | Unknown | Broken | None:
        """Return the content of a delivered packet, or of a message to ``worker``; None: stop."""

    def message(self, said: Any) -> Any:
        """Return a worker's message, as its observer gets it."""


class Master(Protocol):
    """The master, which gives the workers work."""

    @property
    def language(self) -> Language:
        """Format of the messages to and from its workers."""

    def begin(self) -> None:
        """Set the schedule's jobs and workers going."""

    def heard_late(self, child: Child, said: Any) -> None:
        """A worker that was given up says something."""

    def drain(self) -> None:
        """Ask some worker to leave."""

    def terminate(self) -> None:
        """Cancel all jobs."""

    def check_end(self) -> None:
        """Check that no work is left over after the last event."""

    def done(self) -> bool:
        """Return whether only heartbeats are left to happen."""

    def leave_process(self) -> None:
        """Undo its changes of the process."""


class World:
    """Runs one schedule."""

    def __init__(
        self,
        plans: Schedule,
        make_master: Callable[[World], Master],
        trace: list[str] | None = None,
        make_remote: Callable[[World, int, schedule.Agent], Agent] = Agent,
    ) -> None:
        self.schedule = plans
        self.loop = Loop(plans.seed)
        self.oracle = Oracle(plans)
        self.make_channel: Callable[[Child], Any] = lambda child: None
        """A child's channel for direct use, if there is such a thing."""
        self._trace = trace
        self.workers: list[Worker] = []
        self._calls = 0
        self._faults: dict[int, list[Fault]] = {}
        for fault in plans.faults:
            if isinstance(fault, Crash | StillBirth | Slow | Repeat | Lie):
                self._faults.setdefault(fault.worker, []).append(fault)
        self._master = make_master(self)
        self.language = self._master.language
        self.agents = [
            (make_remote if plan.delay else Agent)(self, number, plan)
            for number, plan in enumerate(plans.agents)
        ]

    def run(self) -> None:
        """Let everything happen; Violation if a promise is broken."""
        try:
            self._master.begin()
            for fault in self.schedule.faults:
                self._plan(fault)
            self.run_out()
            self.oracle.check_end()
            self._master.check_end()
        finally:
            self._master.leave_process()

    @property
    def has_links(self) -> bool:
        """Return whether there are links, whose heartbeats never end."""
        return any(isinstance(agent, RemoteHost) for agent in self.agents)

    def run_out(self) -> None:
        """Let everything happen."""
        if not self.has_links:
            self.loop.run_for(END)
            return
        end = self.loop.now() + PATIENCE
        while not self._master.done() and self.loop.now() < end:
            self.loop.run_for(5)
        self.loop.run_for(2 * LOST_AFTER)  # processes out of reach notice it, too

    def note(self, text: str, *args: object) -> None:
        """Write it into the trace, if there is one."""
        if self._trace is not None:
            self._trace.append(f"{self.loop.now():12.6f}  {text % args}")

    def count(self) -> None:
        """The master did something; it must come to an end."""
        self._calls += 1
        if self._calls > CALLS:
            raise Violation("it goes round in circles")

    def child(self, agent: Agent, observer: ChildObserver) -> Child:
        """A worker on ``agent``, to be started."""
        child = Child(agent, self.next_worker(), observer)
        self.workers.append(child.worker)
        self.note("%s is started on %s", child.name, agent.host)
        return child

    def next_worker(self) -> int:
        """The number of the next worker."""
        return len(self.workers)

    def faults_of(self, worker: int) -> list[Fault]:
        """Return the faults of a worker during its work."""
        return self._faults.get(worker, [])

    def famine(self) -> int | None:
        """Return the exit code with which all workers that start now die, if they do."""
        now = self.loop.now()
        for fault in self.schedule.faults:
            if isinstance(fault, Famine) and fault.at <= now < fault.at + fault.seconds:
                return fault.exitcode
        return None

    def task(self, ref: Ref) -> Task:
        """Return the plan of a task."""
        if ref == NO_OP:
            return Task(0.0)
        job = self.schedule.jobs[ref.job]
        return job.tasks[0 if job.everywhere else ref.task]

    def heard_late(self, child: Child, said: Any) -> None:
        """A worker that was given up says something."""
        self.note("%s is late: %s", child.name, said)
        self._master.heard_late(child, said)

    def _plan(self, fault: Fault) -> None:
        later = self.loop.call_later
        if isinstance(fault, Kill):
            later(fault.at, self._on_worker, fault.worker, lambda worker: worker.die(-9))
        elif isinstance(fault, Stop):
            seconds = fault.seconds
            later(fault.at, self._on_worker, fault.worker, lambda it: it.stop_for(seconds))
        elif isinstance(fault, Cut) and fault.agent < len(self.agents):
            later(fault.at, self.agents[fault.agent].cut, fault.seconds)
        elif isinstance(fault, Drain):
            later(fault.at, self._master.drain)
        elif isinstance(fault, Terminate):
            later(fault.at, self._master.terminate)

    def _on_worker(self, number: int, act: Callable[[Worker], None]) -> None:
        if number < len(self.workers):
            act(self.workers[number])
