"""The real dispatcher, asked for what the schedule plans, over simulated workers."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from multiprocessing import process as mp_process
from types import SimpleNamespace
from typing import Any

from fiber._runtime.dispatcher import Terms
from fiber._runtime.requests import Call, Function, Request

from fiber._backends.remote import RemoteChild
from fiber._engine import ledger as engine
from fiber._wire import work
from fiber.errors import StartError
from simulation.agents import Child
from simulation.audit import Audit
from simulation.oracle import Account, Violation
from simulation.outcomes import BrokenInput, Outcomes
from simulation.schedule import Act, Job, Schedule, Task
from simulation.staged import Actor, Stage, StagedDispatcher, StagedProcess, WatchedLock
from simulation.wire import Wire, perform, perform_nowhere, perform_other
from simulation.workers import Ref
from simulation.world import World


class Again(Exception):
    """What the pool retries."""


GRACE = 0.1
"""Seconds within which a pool must have ordered the workers that it needs."""

MOST = 100
"""Tasks of one job; more would only take longer."""


class Names:
    """Tells the audit what the dispatcher's objects stand for."""

    def account(self, job: engine.Job) -> Account | None:
        """Whose job it is; calls share one."""
        sink = job.owner.sink
        account: Account | None = sink.account if sink is not None else None
        return account

    def ref(self, job: engine.Job, index: int, item: Any) -> Ref:
        """Which task ``item`` is."""
        if not isinstance(item, Call):
            return Ref(*item)
        if job.owner.sink is not None:  # the same call for all
            return Ref(job.owner.sink.account.number, index)
        sink: Any = item.sink
        return Ref(sink.account.number, sink.call)

    def child(self, worker: engine.Worker) -> Child:
        """Which process it is."""
        port = worker.key.port
        if isinstance(port, RemoteChild):
            seen: Any = port.observer
            return seen  # type: ignore[no-any-return]
        child: Child = port
        return child


class DispatcherMaster:
    """Plays the pool's user."""

    def __init__(self, world: World, dispatcher: type[StagedDispatcher] = StagedDispatcher) -> None:
        self.world = world
        self.stage = Stage(world)
        self.stage.enter()
        self._rng = random.Random(f"{world.schedule.seed} user")
        schedule = world.schedule
        self._dispatcher = dispatcher(self.stage, _terms(schedule))
        self._ledger = self._dispatcher._ledger
        self.language = Wire(schedule.seed)
        self._audit = Audit(world, self._ledger, Names())
        lock: Any = WatchedLock(self._check)
        self._dispatcher._lock = self._dispatcher.crew._lock = lock
        self._sinks: dict[int, Outcomes] = {}
        self._actors: list[Actor] = []
        self._open_calls: dict[int, int] = {}
        self._short_since: float | None = None

    def begin(self) -> None:
        """Start the workers, and plan the jobs."""
        with self.world.loop.off_thread():
            self._dispatcher.start()
        for account in self.world.oracle.accounts:
            self._later(account.plan.at, self._open, account)

    def _later(self, seconds: float, callback: Callable[..., None], *args: Any) -> None:
        self.world.loop.call_later(seconds, self._act, callback, args)

    def _act(self, callback: Callable[..., None], args: tuple[Any, ...]) -> None:
        with self.world.loop.off_thread():
            callback(*args)

    # The user

    def _open(self, account: Account) -> None:
        plan = account.plan
        sink = self._sinks[account.number] = Outcomes(self, account)
        style = "broadcast" if plan.everywhere else "call" if self._rng.random() < 0.3 else "map"
        if plan.bite < len(plan.tasks) and style == "map":
            style = "stream"
        self.world.note("the user opens job %d, a %s", account.number, style)
        try:
            getattr(self, f"_{style}")(account, sink)
        except (ValueError, StartError) as error:
            if not self._dispatcher._closing and self.world.oracle.stillborn < 3:
                raise
            self.world.note("job %d is refused: %s", account.number, type(error).__name__)
            account.cancelled = True
        if plan.cancelled_at is not None:
            self._later(max(0.0, plan.cancelled_at - self.world.loop.now()), self._cancel, account)

    def _broadcast(self, account: Account, sink: Outcomes) -> None:
        account.closed = True
        self._dispatcher.broadcast(sink, perform, (account.number,))

    def _call(self, account: Account, sink: Outcomes, start: int = 0) -> None:
        """One call after the other; those fed together follow at once."""
        plan = account.plan
        stop = min(start + plan.bite, len(plan.tasks))
        account.closed = stop == len(plan.tasks)
        self._open_calls[account.number] = self._open_calls.get(account.number, 0) + stop - start
        self.world.oracle.fed(account.number, stop - start)
        for index in range(start, stop):
            one = Outcomes(self, account, index)
            item: Any = (account.number, index)
            if plan.tasks[index].act is Act.UNSENDABLE:
                item = (self.stage.bad_item(item),)
            call = self._rng.choice((self._dispatcher.call, self._dispatcher.post))
            call(one, perform, item, {}, timeout=plan.timeout)
        if not account.closed:
            self._later(plan.pause, self._go_on_calling, account, sink, stop)
        elif not plan.tasks:
            sink.end()

    def _go_on_calling(self, account: Account, sink: Outcomes, start: int) -> None:
        if account.cancelled:
            return
        fed = account.fed
        try:
            self._call(account, sink, start)
        except (ValueError, StartError) as error:
            # What was asked before counts.
            self.world.note("job %d goes no further: %s", account.number, type(error).__name__)
            self._open_calls[account.number] -= account.fed - fed
            account.fed = fed
            account.closed = account.refused = True
            if not self._open_calls[account.number]:
                sink.end()

    def ended_call(self, account: Account) -> bool:
        """A call has ended; whether it was the last."""
        self._open_calls[account.number] -= 1
        return not self._open_calls[account.number] and account.closed

    def _options(self, account: Account) -> dict[str, Any]:
        plan = account.plan
        exact = self._rng.random() < 0.3
        return {"unit": plan.unit, "exact": exact, "timeout": plan.timeout}

    def _items(self, account: Account) -> list[Any]:
        # What is plain is pickled on any thread, the rest must not be on the loop's.
        kind: Callable[[tuple[int, int]], Any] = self._rng.choice((tuple, self.stage.item))
        tasks = account.plan.tasks
        if any(task.act is Act.UNSENDABLE for task in tasks):
            kind = self.stage.item
        return [
            (self.stage.bad_item if task.act is Act.UNSENDABLE else kind)((account.number, index))
            for index, task in enumerate(tasks)
        ]

    def _function(self, account: Account) -> Function:
        account.broken = self._rng.random() < 0.03
        some = perform, perform_other
        function = perform_nowhere if account.broken else some[account.number % 2]
        return self._dispatcher.function(function)

    def _map(self, account: Account, sink: Outcomes) -> None:
        account.closed = True
        self.world.oracle.fed(account.number, len(account.plan.tasks))
        sink.request = self._dispatcher.map(
            work.MAP, self._function(account), self._items(account), sink, **self._options(account)
        )

    def _stream(self, account: Account, sink: Outcomes) -> None:
        limit = self._rng.choice((None, None, 1, 5))
        request = sink.request = self._dispatcher.stream(
            work.MAP, self._function(account), sink, limit=limit, **self._options(account)
        )
        actor = Actor(self.stage, lambda actor: self._read(actor, account, request))
        assert request.reader is not None
        gate: Any = actor
        request.reader._gate = gate
        self._actors.append(actor)
        actor.start()

    def _read(self, actor: Actor, account: Account, request: Request) -> None:
        broken = self._rng.random() < 0.2
        tells = self._rng.random() < 0.5  # the error in place of a result, or the caller
        try:
            self._dispatcher.read(request, self._slowly(actor, account, broken))
        except BrokenInput as error:
            self.world.note("the input of job %d is broken", account.number)
            account.refused = True
            if tells:
                account.closed = True
                self._dispatcher.finish(request, error)
            else:
                self._cancel(account)
            return
        account.closed = True
        self._dispatcher.finish(request)

    def _slowly(self, actor: Actor, account: Account, broken: bool) -> Iterator[Any]:
        for index, item in enumerate(self._items(account), 1):
            yield item
            if index % account.plan.bite == 0 and account.plan.pause:
                actor.sleep(account.plan.pause)
        if broken:
            raise BrokenInput

    def _cancel(self, account: Account) -> None:
        request = self._sinks[account.number].request
        if request is None or account.finished or account.cancelled:
            return
        self.world.note("job %d is cancelled", account.number)
        account.cancelled = True
        self._dispatcher.cancel(request)

    def drain(self) -> None:
        """Close the pool."""
        self.world.note("the pool is closed")
        self._act(self._dispatcher.close, ())

    def terminate(self) -> None:
        """Terminate the pool."""
        self.world.note("the pool is terminated")
        self._act(self._dispatcher.terminate, (RuntimeError("terminated"),))

    def heard_late(self, child: Child, said: Any) -> None:
        """A port says nothing after the end of its child."""

    # What must hold

    def _check(self) -> None:
        """The dispatcher's lock is released."""
        self.world.count()
        if self.stage.pickled_on_loop:
            raise Violation("the user's code runs on the loop's thread")
        for job in self._ledger.jobs:
            request: Request = job.owner
            if isinstance(request.sink, Outcomes):
                request.sink.account.fed = job.fed
        for batch in self._ledger.batches.values():
            if batch.pin:
                self.language.pinned[batch.seq] = batch.start
        self._audit.check()
        self._check_size()

    def _check_size(self) -> None:
        if not self._is_short():
            self._short_since = None
        elif self._short_since is None:
            self._short_since = self.world.loop.now()
            self._later(GRACE, self._check_still_short, self._short_since)

    def _check_still_short(self, since: float) -> None:
        if self._short_since == since:
            raise Violation("there is work, but the pool does not grow")

    def _is_short(self) -> bool:
        """Whether there is work for more workers, and none are on their way."""
        crew = self._dispatcher.crew
        if self._dispatcher._closing or crew.error or crew.pause() or crew.starting:
            return False
        tasks = sum(job.fed - job.done for job in self._ledger.jobs)
        # A worker that still runs what was cancelled is not there for the others.
        lost = sum(bool(it.queue) and it.queue[0].job is None for it in self._ledger.workers)
        return bool(tasks) and crew.size < min(tasks + lost, crew.maximum)

    def check_end(self) -> None:
        """All is quiet: then the pool closes, and nothing stays behind."""
        for account in self.world.oracle.accounts:
            missing = len(account.plan.tasks) - account.fed
            excused = account.cancelled or account.refused or account.plan.everywhere
            if missing and not excused:
                raise Violation(f"only {account.fed} tasks of job {account.number} were fed")
        if not self._dispatcher._closing:
            self._check_rest()
            self.drain()
        self.world.run_out()
        if not self._dispatcher.ended.is_set():
            raise Violation("the pool does not end")
        if self._dispatcher.crew.links or self._ledger.demand() or self._dispatcher._deadlines:
            raise Violation("the pool leaves something behind")
        for worker in self.world.workers:
            if worker.born and not worker.dead:
                raise Violation(f"{worker.name} outlives the pool")

    def _check_rest(self) -> None:
        """Nothing was to be done for long."""
        crew = self._dispatcher.crew
        if self.world.has_links or crew.error or crew.pause():
            return
        if crew.size != crew.minimum:
            raise Violation(f"the pool rests with {crew.size} workers")

    def done(self) -> bool:
        """Every job is over, and the pool too if it was closed."""
        accounts = self.world.oracle.accounts
        over = all(account.finished or account.cancelled for account in accounts)
        return over and self._dispatcher.ended.is_set() is self._dispatcher._closing

    def leave_process(self) -> None:
        """Leave no trace in this process."""
        for actor in self._actors:
            actor.abandon()
        for link in self._dispatcher.crew.links:
            mp_process._children.discard(link.process)  # type: ignore[attr-defined]
        self.stage.leave()


def _terms(schedule: Schedule) -> Terms:
    return Terms(
        context=SimpleNamespace(Process=StagedProcess),
        minimum=schedule.min_workers,
        maximum=schedule.max_workers,
        maxtasks=schedule.left,
        retries=schedule.jobs[0].retries,
        retryable=(Again,),
        idle_timeout=60.0 if schedule.linger is None else schedule.linger + 1e-3,
    )


def for_pool(schedule: Schedule) -> Schedule:
    """What the user of a pool can ask for: retries, for one, are the pool's."""
    retries = schedule.jobs[0].retries
    return replace(schedule, jobs=tuple(_for_pool(job, retries) for job in schedule.jobs))


def _for_pool(job: Job, retries: int) -> Job:
    if job.everywhere:  # a broadcast has no timeout
        tasks = tuple(task for task in job.tasks if task.act not in (Act.ENDLESS, Act.UNSENDABLE))
        job = replace(job, tasks=tasks or (Task(1e-3),), timeout=None)
    tasks = job.tasks[:MOST]
    return replace(job, tasks=tasks, retries=retries, alone=job.timeout is not None)
