"""Invariants of a pool's executor and scheduler, checked after every turn of the loop."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

from fiber._engine.chunks import TaskPace
from fiber._engine.scheduler import Decisions, PoolMember
from fiber._engine.start_failures import (
    KILLED_PATIENCE,
    LAST_PAUSE,
    LAST_PAUSE_AT_WORK,
    RAISED_PATIENCE,
    SAID_AFTER,
    TRIES,
    StartFailure,
)
from fiber._engine.tasks import Loss
from fiber._runtime.executor import PoolExecutor
from fiber._runtime.jobs import TICK
from fiber._runtime.work_items import AHEAD, InputStream, WorkItem
from simulation.audit import workers_wanted
from simulation.oracle import require
from simulation.world import MOMENTS

if TYPE_CHECKING:
    from simulation.outcomes import Outcomes
    from simulation.staged import Actor, Stage
    from simulation.world import World

GRACE = 0.1
"""Seconds within which a pool must have started the workers that it needs."""

PROMPTLY = 5 * max(MOMENTS)
"""Seconds within which a waiter for a thread and the loop must have an answer."""


class Reading(NamedTuple):
    """A stream, and who is at its ends."""

    item: WorkItem
    stream: InputStream
    actor: Actor
    outcomes: Outcomes


class PoolAudit:
    """Checks the actions of one executor; ``check_ledger`` checks its ledger."""

    def __init__(
        self, world: World, stage: Stage, executor: PoolExecutor, check_ledger: Callable[[], None]
    ) -> None:
        self._world = world
        self._stage = stage
        self._executor = executor
        self._scheduler = executor._scheduler
        self._ledger = executor._ledger
        self._workers = self._scheduler.workers
        self._check_ledger = check_ledger
        self.starved = False
        """True once no worker has started for long enough."""
        self.joined = False
        """The user waits for the pool's end, and takes no results."""
        self._moved = False
        self._failures: list[tuple[float, bool]] = []
        self._alone_since = 0.0
        self._told = False
        self._since: dict[Any, float] = {}
        self._readings: list[Reading] = []
        self._real = SimpleNamespace(
            decide=self._scheduler.decide,
            ready=self._scheduler.ready,
            gone=self._scheduler.gone,
            news=self._workers.news,
        )
        vars(self._scheduler).update(decide=self._decide, ready=self._ready, gone=self._gone)
        vars(self._workers)["news"] = self._news
        world.loop.after_turn = self._after_turn

    # Its actions

    def _decide(self, now: float) -> Decisions:
        require(self._world.loop.on_thread(), "the executor acts on another thread")
        self._world.count()
        self._moved = True
        decisions: Decisions = self._real.decide(now)
        return decisions

    def _ready(self, member: PoolMember, now: float) -> None:
        before = member.worker
        self._real.ready(member, now)
        if member.worker is not before:
            require(before is None, "a worker is ready twice")
            require(member in self._workers.members, "an unknown worker is ready")
            self._failures.clear()
            self._told = self.starved = False

    def _gone(
        self, member: PoolMember, now: float, *, failure: StartFailure | None = None, **rest: Any
    ) -> list[Loss]:
        require(member in self._workers.members, "an unknown worker is gone")
        counts = member.worker is None and not member.leaving and failure is not None
        gives_up = False
        if failure is not None and counts:
            self._failures.append((now, failure.killed))
            self.starved |= self._fails_for_long(now, failure.killed, 0.0)
            gives_up = self._fails_for_long(now, failure.killed, self._alone_since)
        had = self._workers.error
        losses: list[Loss] = self._real.gone(member, now, failure=failure, **rest)
        at_work = any(member.worker is not None for member in self._workers.staying())
        if member.worker is not None and not at_work:
            self._alone_since = now
        if self._workers.error is not had:
            require(gives_up, "the pool gives up too early")
            require(not at_work, "the pool gives up though workers are at work")
        elif gives_up and not had:
            require(at_work, "the pool does not give up")
        return losses

    def _fails_for_long(self, now: float, killed: bool, alone_since: float) -> bool:
        """Return whether workers have failed like the last one for as long as a pool allows."""
        times = [time for time, other in self._failures if killed or not other]
        patience = KILLED_PATIENCE if killed else RAISED_PATIENCE
        return len(times) >= TRIES and now - max(times[0], alone_since) >= patience

    def _news(self, failure: StartFailure, now: float) -> str:
        news: str = self._real.news(failure, now)
        if news:
            require(not self._told, "the user is told twice")
            self._told = True
        return news

    # After every turn

    def _after_turn(self) -> None:
        require(not self._stage.user_code_on_loop, "the user's code runs on the loop thread")
        if self._moved:
            self._moved = False
            self._check_ledger()
            self._check_workers()
            self._check_messages()
            self._check_news()
            self._check_size()
            for reading in self._readings:
                self._check_reading(reading)
        elif self._ledger._load.idle and any(job.has_next for job in self._ledger.jobs):
            wake, now = self._executor._wake, self._world.loop.now()
            soon = wake is not None and wake.due <= now + 2 * TICK
            require(soon, "a task waits though a worker is idle, and nobody will look")

    def _check_workers(self) -> None:
        workers = self._workers
        staying = workers.staying()
        starting = [member for member in staying if member.worker is None]
        require(workers.size == len(staying), f"{len(staying)} workers count as {workers.size}")
        require(workers.starting == len(starting), f"{len(starting)} workers start")
        require(workers.size <= workers.maximum, f"the pool has {workers.size} workers")
        ready = {member.worker for member in workers.members if member.worker is not None}
        require(ready == self._ledger.workers, "the ledger knows other workers")
        leased = sum(worker.leased for worker in self._ledger.workers)
        require(leased == self._scheduler.ledger.leased, f"{leased} workers are leased")
        unused = bool(self._executor._leases._idle)
        needed = any(job.has_next for job in self._ledger.jobs) or bool(self._ledger._pins)
        otherwise = "a task waits for a worker that is leased and not in use"
        self._lasts("leased", unused and needed, lambda: PROMPTLY, otherwise)

    def _check_messages(self) -> None:
        held = self._ledger.batches.keys()
        require(self._executor._sender._unsent <= held, "what is not sent is not held by anybody")
        require(
            self._executor._sender._limits._timers.keys() <= held, "a deadline belongs to no batch"
        )

    def _check_news(self) -> None:
        if self._failures and self._workers.error is None and not self._told:
            lasts = self._failures[-1][0] - self._failures[0][0]
            require(lasts < SAID_AFTER, "no worker starts, and the user is not told")

    # States that may last for a moment only

    def _lasts(self, key: Any, holds: bool, allowed: Callable[[], float], otherwise: str) -> None:
        """Violation if ``holds`` is so for longer than ``allowed``."""
        if not holds:
            self._since.pop(key, None)
        elif key not in self._since:
            now = self._since[key] = self._world.loop.now()
            self._world.loop.call_later(allowed(), self._still_so, key, now, allowed, otherwise)

    def _still_so(
        self, key: Any, since: float, allowed: Callable[[], float], otherwise: str
    ) -> None:
        if self._since.get(key) != since:
            return
        left = since + allowed() - self._world.loop.now()
        require(left > 0, otherwise)
        self._world.loop.call_later(left, self._still_so, key, since, allowed, otherwise)

    def _check_size(self) -> None:
        short = self._is_short()
        self._lasts("size", short, self._pause, "there is work, but the pool does not grow")

    def _pause(self) -> float:
        if not self._workers._failures.pause:
            return GRACE
        at_work = self._workers.size > self._workers.starting
        return GRACE + (LAST_PAUSE_AT_WORK if at_work else LAST_PAUSE)

    def _is_short(self) -> bool:
        """Return whether there is work for more workers, and none are on their way."""
        workers = self._workers
        if self._scheduler.terminated or workers.error is not None or workers.starting:
            return False
        tasks = workers_wanted(self._ledger)
        # A worker that still runs a cancelled task is not free for others.
        held_up = [it for it in self._ledger.workers if it.queue and not it.leaving]
        lost = sum(worker.queue[0].job is None for worker in held_up)
        wanted = max(tasks and tasks + lost, 0 if self._scheduler.closing else workers.minimum)
        return workers.size < min(wanted, workers.maximum)

    # Streams

    def watch(self, reading: Reading) -> None:
        """Watch a stream."""
        self._readings.append(reading)
        real, stream = reading.stream.grant, reading.stream

        def grant(waiting: int, workers: int, pace: TaskPace, target: float) -> None:
            before = waiting + stream._granted - stream._taken
            real(waiting, workers, pace, target)
            ahead = waiting + stream._granted - stream._taken
            unit = reading.item.unit
            bound = AHEAD * max(workers, 1) * max(pace.message_size(target), unit)
            fits = ahead < bound + unit or ahead == before
            require(fits, f"{ahead} tasks are read ahead, more than {bound}")

        vars(stream)["grant"] = grant

    def _check_reading(self, reading: Reading) -> None:
        item, stream, actor, outcomes = reading
        job = item.job
        hungry = (
            item in self._executor._jobs._streams
            and job is not None
            and not job.waiting
            and actor.starves
            and (self.joined or self._room(reading) >= item.unit)
        )
        otherwise = f"the stream of job {outcomes.account.number} starves"
        self._lasts(stream, hungry, lambda: PROMPTLY, otherwise)

    @staticmethod
    def _room(reading: Reading) -> float:
        outcomes = reading.outcomes
        if outcomes.limit is None:
            return float("inf")
        held = reading.stream._granted - outcomes.consumed
        return max(outcomes.limit, reading.item.unit) - held

    # At the end

    def check_end(self) -> None:
        """The pool is over."""
        executor = self._executor
        require(executor.ended.is_set(), "the pool does not end")
        left: Iterable[Any] = (
            self._workers.members,
            self._ledger.demand(),
            self._ledger.batches,
            executor._sender._limits._timers,
            executor._sender._unsent,
            executor._jobs._streams,
            *(queue.called for queue in executor.calls._queues),
            executor._leases._workers,
            executor._leases._leases,
        )
        require(not any(left), "the pool leaves something behind")

    def check_rest(self) -> None:
        """Check the pool after a long idle time."""
        workers = self._workers
        if self._world.has_links or workers.error is not None or workers._failures.pause:
            return
        require(workers.size == workers.minimum, f"the pool rests with {workers.size} workers")
