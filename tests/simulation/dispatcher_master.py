"""The real dispatcher, asked for what the schedule plans, over simulated workers."""

from __future__ import annotations

import pickle
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from multiprocessing import process as mp_process
from types import SimpleNamespace
from typing import Any

from fiber._backends.remote import RemoteChild
from fiber._engine import ledger as engine
from fiber._runtime.dispatcher import Terms
from fiber._runtime.outcome import Encoded, Failure
from fiber._runtime.requests import Call, Request
from fiber._wire import work
from fiber._wire.packet import Message
from fiber.errors import StartError, TimeoutError, WorkerDied
from simulation.agents import Child
from simulation.audit import Audit
from simulation.oracle import Account, Violation
from simulation.schedule import Act, Job, Schedule, Task
from simulation.staged import Actor, Stage, StagedDispatcher, StagedProcess, WatchedLock
from simulation.workers import Ready, Ref, Results, Unknown, Unreadable, Work, Worker
from simulation.world import World


class Again(Exception):
    """What the pool retries."""


class BrokenInput(Exception):
    """What an iterable raises instead of its next item."""


GRACE = 0.1
"""Seconds within which a pool must have ordered the workers that it needs."""

MOST = 100
"""Tasks of one job; more would only take longer."""

ERROR = pickle.dumps(ValueError("as planned"))


def perform(job: int, index: int) -> int:
    """Stands for the user's function; it never runs."""
    raise NotImplementedError


def perform_other(job: int, index: int) -> int:
    """Another one."""
    raise NotImplementedError


def _value(ref: Ref) -> int:
    return ref.job * 1000 + ref.task


class Wire:
    """The dispatcher's own messages, from the worker's side."""

    def __init__(self, batches: dict[int, engine.Batch], seed: int) -> None:
        self._batches = batches
        self._rng = random.Random(f"{seed} wire")
        self.pinned: dict[int, int] = {}
        """The index of the task in each batch that carries a broadcast call."""

    def work(
        self, worker: Worker, seq: int, payload: bytes, buffers: Sequence[memoryview]
    ) -> Work | Unknown | None:
        """What a packet says."""
        head = work.Head._make(work.HEAD.unpack_from(payload))
        body = memoryview(payload)[work.HEAD.size :]
        if head.kind == work.STOP:
            return None
        if head.kind == work.CALLS:
            calls = [pickle.loads(call)[1] for call, _ in work.unpack_calls(body, head.size)]
            if seq in self.pinned:
                calls = [(calls[0][0], self.pinned[seq])]
            return Work(seq, [Ref(*call) for call in calls], 1, 1, apart=True)
        if self._rng.random() < 0.02:
            worker.functions.clear()
        if head.size:
            worker.functions.add(head.function)
        elif head.function not in worker.functions:
            return Unknown(seq)
        items = pickle.loads(body[head.size :])
        return Work(seq, [Ref(*item) for item in items], head.stride or 1, head.unit)

    def message(self, said: Any) -> Message:
        """What a worker says."""
        words: tuple[Any, ...]
        if isinstance(said, Ready):
            words = (work.READY,)
        elif isinstance(said, Unknown):
            words = (work.UNKNOWN, said.seq)
        elif isinstance(said, Unreadable):
            words = (work.UNREADABLE, said.seq, ERROR)
        else:
            words = self._results(said)
        return Message(memoryview(pickle.dumps(words)), [], [])

    def _results(self, said: Results) -> tuple[Any, ...]:
        values: list[int | None] = []
        odd = []
        for at, (ref, act) in enumerate(said.tasks):
            values.append(_value(ref) if act is Act.FINE else None)
            if act is not Act.FINE:
                kind = work.AGAIN if act is Act.RETRIED else work.ERROR
                odd.append((at, kind, ERROR, 0))
        return said.seq, said.offset, said.kept, said.seconds, values, odd


class Outcomes:
    """Where the dispatcher puts the outcomes of one job, or of one call of it; a ``Sink``."""

    def __init__(self, master: DispatcherMaster, account: Account, call: int | None = None) -> None:
        self.account = account
        self.call = call
        self.request: Request | None = None
        self._master = master
        self._oracle = master.world.oracle
        self._ended = False

    def put(self, start: int, outcomes: list[Any], mixed: bool = True) -> None:
        """Outcomes of tasks from ``start`` on."""
        for index, outcome in enumerate(outcomes, start if self.call is None else self.call):
            self._put(Ref(self.account.number, index), outcome)
        if self.request is not None and self.request.reader is not None:
            # The user takes them a little later.
            self._master.stage.soon(self.request.reader.consume, len(outcomes))

    def _put(self, ref: Ref, outcome: Any) -> None:
        error = outcome.error if type(outcome) is Failure else None
        if isinstance(error, BrokenInput):
            if self.request is None or ref.task != self.request.job.fed:
                raise Violation(f"the error of the input takes the place of {ref}")
        elif isinstance(error, WorkerDied):
            self._oracle.died(ref, error.attempts)
        elif isinstance(error, TimeoutError):
            self._oracle.delivered(ref, "too late")
        elif type(outcome) is Encoded:
            act = self._master.world.task(ref).act
            if act is Act.UNREADABLE:
                self._oracle.delivered(ref, "unreadable")
            elif (act is Act.RETRIED) is not (outcome.kind == work.AGAIN):
                raise Violation(f"{ref} has the error of another task")
            else:
                self._oracle.delivered(ref, act)
        elif outcome != _value(ref):
            raise Violation(f"{ref} has the result {outcome!r}")
        else:
            self._oracle.delivered(ref, Act.FINE)

    def end(self) -> None:
        """That was all."""
        if self._ended:
            raise Violation(f"job {self.account.number} ends twice")
        self._ended = True
        if self.call is None or self._master.ended_call(self.account):
            self._master.world.note("job %d is finished", self.account.number)
            self._oracle.finished(self.account.number)

    def abort(self, error: BaseException) -> None:
        """There will be no more."""
        if isinstance(error, StartError) and self._oracle.stillborn < 3:
            raise Violation("the pool gives up though workers can start")
        if self.account.finished:
            raise Violation(f"job {self.account.number} is aborted after it was finished")
        self._master.world.note("job %d is aborted: %s", self.account.number, type(error).__name__)
        self.account.cancelled = True


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
        self.language = Wire(self._ledger.batches, schedule.seed)
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
            arguments = (account.number, index)
            self._dispatcher.call(one, perform, arguments, {}, timeout=plan.timeout)
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
        kind = self._rng.choice((tuple, Ref._make))  # pickled on any thread, or only on some
        return [kind((account.number, index)) for index in range(len(account.plan.tasks))]

    def _map(self, account: Account, sink: Outcomes) -> None:
        account.closed = True
        self.world.oracle.fed(account.number, len(account.plan.tasks))
        function = self._dispatcher.function(perform if account.number % 2 else perform_other)
        sink.request = self._dispatcher.map(
            work.MAP, function, self._items(account), sink, **self._options(account)
        )

    def _stream(self, account: Account, sink: Outcomes) -> None:
        function = self._dispatcher.function(perform)
        limit = self._rng.choice((None, None, 1, 5))
        request = sink.request = self._dispatcher.stream(
            work.MAP, function, sink, limit=limit, **self._options(account)
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
        tasks = tuple(task for task in job.tasks if task.act is not Act.ENDLESS)
        job = replace(job, tasks=tasks or (Task(1e-3),), timeout=None)
    tasks = job.tasks[:MOST]
    return replace(job, tasks=tasks, retries=retries, alone=job.timeout is not None)
