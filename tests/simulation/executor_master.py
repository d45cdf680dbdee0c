"""The real executor over simulated workers, with the calls of the schedule."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from multiprocessing import process as mp_process
from typing import Any

from fiber._backends.remote import RemoteChild
from fiber._engine import tasks as engine
from fiber._runtime.answers import Pickled
from fiber._runtime.executor import PoolExecutor
from fiber._runtime.options import PoolOptions
from fiber._runtime.work_items import Call, Function, InputStream, WorkItem
from fiber._wire import work
from fiber.errors import StartError
from fiber.process import ForkProcess, PoolProcess
from simulation.agents import Child
from simulation.audit import Audit
from simulation.oracle import Account, Violation, limits_of, require
from simulation.outcomes import HEARD, BrokenInput, Outcomes
from simulation.pool_audit import PoolAudit, Reading
from simulation.schedule import Act, Job, Schedule, Task
from simulation.staged import Actor, Interrupted, Stage
from simulation.wire import ERROR, PlannedError, Wire, perform, perform_nowhere, perform_other
from simulation.workers import Ref
from simulation.world import World


class Again(Exception):
    """Error that the pool retries."""


OWNER = "the pool's owner"
"""The thread that made the pool."""

MOST = 100
"""Tasks of one job; more would only take longer."""


class Names:
    """Maps the executor's objects to those of the audit."""

    def account(self, job: engine.Job) -> Account | None:
        """Whose job it is; calls share one."""
        item: WorkItem | None = job.owner
        future: Any = item.future if item is not None else None
        account: Account | None = future.account if future is not None else None
        return account

    def ref(self, job: engine.Job, index: int, item: Any) -> Ref:
        """Return the name of the task that ``item`` is."""
        if not isinstance(item, Call):
            return Ref(*item)
        account = self.account(job)
        if account is not None:  # the same call for all
            return Ref(account.number, index)
        future: Any = item.future
        return Ref(future.account.number, future.call)

    def child(self, worker: engine.WorkerEntry) -> Child:
        """Return the simulated process of a worker."""
        handle = worker.key.child
        if isinstance(handle, RemoteChild):
            seen: Any = handle.observer
            return seen  # type: ignore[no-any-return]
        child: Child = handle
        return child


class ExecutorMaster:
    """User of the pool, with one thread for each job."""

    def __init__(self, world: World, make: type[PoolExecutor] = PoolExecutor) -> None:
        self.world = world
        self._stage = Stage(world)
        self._stage.enter()
        self._rng = random.Random(f"{world.schedule.seed} user")
        thread: Any = self._stage.thread
        runtime: Any = self._stage
        self._executor = make(_options(world.schedule), runtime, thread=thread)
        self._ledger = self._executor._ledger
        self.language = Wire(world.schedule.seed)
        self._audit = Audit(world, self._ledger, Names())
        self._pool = PoolAudit(world, self._stage, self._executor, self._check)
        self._futures: dict[int, Outcomes] = {}
        self._open_calls: dict[int, int] = {}
        self._started = False
        self._planned: list[Callable[[], None]] = []
        """Steps of the owner once the pool has started."""

    def begin(self) -> None:
        """Start the workers, and plan the jobs."""
        self._stage.act(OWNER, self._start).start()

    def _start(self, _: Actor) -> None:
        accounts = self.world.oracle.accounts
        try:
            self._executor.start()
        except OSError as error:
            self.world.note("the pool does not start: %s", error)
            for account in accounts:
                account.cancelled = True
        else:
            for account in accounts:
                self.world.loop.comes_after(_user(account), OWNER)
                wait = max(0.0, account.plan.at - self.world.loop.now())
                self._later(wait, account, self._open, account)
        self._started = True
        for planned in self._planned:
            planned()

    def _later(
        self, seconds: float, account: Account, callback: Callable[..., None], *args: Any
    ) -> None:
        self.world.loop.call_later(seconds, self._act, _user(account), callback, *args)

    def _act(self, thread: str, callback: Callable[..., None], *args: Any) -> None:
        with self.world.loop.off_thread(thread):
            callback(*args)

    # The user

    def _open(self, account: Account) -> None:
        plan = account.plan
        future = self._futures[account.number] = Outcomes(self, account)
        style = "broadcast" if plan.everywhere else "call" if self._rng.random() < 0.4 else "map"
        if plan.bite < len(plan.tasks) and style == "map":
            style = "stream"
        if style == "call" and self._rng.random() < 0.7:
            style = "direct call"
        self.world.note("the user opens job %d, a %s", account.number, style)
        try:
            getattr(self, f"_{style.replace(' ', '_')}")(account, future)
        except (ValueError, StartError) as error:
            self._expect_refusal(error)
            self.world.note("job %d is refused: %s", account.number, type(error).__name__)
            account.cancelled = True
        if plan.cancelled_at is not None:
            wait = max(0.0, plan.cancelled_at - self.world.loop.now())
            self._later(wait, account, self._cancel, account)

    def _expect_refusal(self, error: Exception) -> None:
        if not (self.starved if isinstance(error, StartError) else self.is_closing):
            raise error

    def _broadcast(self, account: Account, future: Outcomes) -> None:
        account.closed = True
        self._executor.broadcast(future, perform, (account.number,))

    def _call(self, account: Account, future: Outcomes, start: int = 0) -> None:
        """Make one call after the other; those fed together follow at once."""
        plan = account.plan
        stop = min(start + plan.bite, len(plan.tasks))
        account.closed = stop == len(plan.tasks)
        self._open_calls[account.number] = self._open_calls.get(account.number, 0) + stop - start
        self.world.oracle.fed(account.number, stop - start)
        for index in range(start, stop):
            try:
                self._call_one(account, index)
            except (ValueError, StartError) as error:
                self._expect_refusal(error)
                self._goes_no_further(account, future, stop - index)
                return
        if not account.closed:
            self._later(plan.pause, account, self._go_on_calling, account, future, stop)
        elif not plan.tasks:
            future.set_done()

    def _call_one(self, account: Account, index: int) -> None:
        one = Outcomes(self, account, index)
        self._executor.call(one, perform, self._call_item(account, index), {}, account.plan.timeout)

    def _call_item(self, account: Account, index: int) -> Any:
        item = account.number, index
        unsendable = account.plan.tasks[index].act is Act.UNSENDABLE
        return (self._stage.bad_item(item),) if unsendable else item

    def _go_on_calling(self, account: Account, future: Outcomes, start: int) -> None:
        if not account.cancelled and not account.refused:
            self._call(account, future, start)

    def _goes_no_further(self, account: Account, future: Outcomes, refused: int) -> None:
        """End a job early: only its earlier calls count."""
        self.world.note("job %d goes no further", account.number)
        account.fed -= refused
        account.closed = account.refused = True
        self._open_calls[account.number] -= refused
        if not self._open_calls[account.number] and not account.cancelled:
            future.set_done()

    def _direct_call(self, account: Account, future: Outcomes) -> None:
        """Take the result of one call after the other."""
        if account.plan.tasks:
            body = partial(self._apply_all, account)
            self._stage.act(_user(account), body).start()
        else:
            account.closed = True
            future.set_done()

    def _apply_all(self, account: Account, actor: Actor) -> None:
        plan = account.plan
        self._open_calls[account.number] = 0
        for index in range(len(plan.tasks)):
            account.fed += 1
            account.closed = account.fed == len(plan.tasks)
            self._open_calls[account.number] += 1
            self._apply_one(Outcomes(self, account, index, actor), index)
            if account.cancelled or account.refused:
                return
            if account.fed % plan.bite == 0 and plan.pause:
                actor.sleep(plan.pause)

    def _apply_one(self, one: Outcomes, index: int) -> None:
        account = one.account
        item, timeout = self._call_item(account, index), account.plan.timeout
        try:
            outcome = self._executor.call_and_wait(one, perform, item, {}, timeout)
        except PlannedError:
            one.answered(Pickled(work.ERROR, ERROR, ()))
        except Interrupted:
            one.interrupted()
        except (ValueError, StartError) as error:
            self._expect_refusal(error)
            self._goes_no_further(account, self._futures[account.number], 1)
        else:
            if outcome is not HEARD:
                one.answered(outcome)

    def ended_call(self, account: Account) -> bool:
        """A call has ended; whether it was the last."""
        self._open_calls[account.number] -= 1
        return not self._open_calls[account.number] and account.closed

    def refused_call(self, account: Account, call: int) -> None:
        """A call came when the pool was closed already; and so did all after it."""
        account.fed = min(account.fed, call)
        account.delivered &= account.everything  # some of those after it could not be sent
        account.closed = account.refused = True
        if self.ended_call(account):
            self.world.oracle.finished(account.number)

    def _item(self, account: Account, future: Outcomes) -> WorkItem:
        plan = account.plan
        future.item = WorkItem(
            work.MAP,
            function=self._function(account),
            future=future,
            unit=plan.unit,
            eager=self._rng.random() < 0.3,
            timeout=plan.timeout,
        )
        return future.item

    def _items(self, account: Account) -> list[Any]:
        # Any thread pickles plain values; the loop must not pickle the others.
        kind: Callable[[tuple[int, int]], Any] = self._rng.choice((tuple, self._stage.item))
        tasks = account.plan.tasks
        if any(task.act is Act.UNSENDABLE for task in tasks):
            kind = self._stage.item
        return [
            (self._stage.bad_item if task.act is Act.UNSENDABLE else kind)((account.number, index))
            for index, task in enumerate(tasks)
        ]

    def _function(self, account: Account) -> Function:
        account.broken = self._rng.random() < 0.08
        some = perform, perform_other
        function = perform_nowhere if account.broken else some[account.number % 2]
        return self._executor.function(function)

    def _map(self, account: Account, future: Outcomes) -> None:
        account.closed = True
        self.world.oracle.fed(account.number, len(account.plan.tasks))
        self._executor.submit(self._item(account, future), self._items(account))

    def _stream(self, account: Account, future: Outcomes) -> None:
        future.limit = self._rng.choice((None, None, 1, 5))
        item = self._item(account, future)
        stream = self._executor.open_stream(item, future.limit, lambda: future.consumed)
        reader = f"the reader of job {account.number}"
        self.world.loop.comes_after(reader, _user(account))
        actor = self._stage.act(reader, partial(self._read, account, item, stream))
        credit: Any = actor
        stream._credit = credit
        self._pool.watch(Reading(item, stream, actor, future))
        self.world.loop.call_later(self.world.loop.moment(), actor.start)

    def _read(self, account: Account, item: WorkItem, stream: InputStream, actor: Actor) -> None:
        broken = self._rng.random() < 0.2
        tells = self._rng.random() < 0.5  # the error in place of a result, or the caller
        try:
            stream.read(self._slowly(actor, account, broken))
        except BrokenInput as error:
            self.world.note("the input of job %d is broken", account.number)
            account.refused = True
            if tells:
                account.closed = True
                self._executor.finish(item, error)
            else:
                self._cancel(account)
            return
        account.closed = True
        self._executor.finish(item)

    def _slowly(self, actor: Actor, account: Account, broken: bool) -> Iterator[Any]:
        future = self._futures[account.number]
        for index, item in enumerate(self._items(account), 1):
            if future.limit is not None and not self._pool.joined:
                held = index - future.consumed
                most = max(future.limit, account.plan.unit)
                require(held <= most, f"{held} tasks are read and not consumed")
            yield item
            if index % account.plan.bite == 0 and account.plan.pause:
                actor.sleep(account.plan.pause)
        if broken:
            raise BrokenInput

    def consume_soon(self, future: Outcomes) -> None:
        """The user takes a result, a little later."""
        self._later(self.world.loop.moment(), future.account, self._consume, future)

    def _consume(self, future: Outcomes) -> None:
        assert future.item is not None
        if not self._pool.joined:
            future.consumed += 1
            if future.item.stream is not None:
                future.item.stream.ask()

    def holds_back(self, item: WorkItem) -> bool:
        """Return whether the user has more results than it reads; until a little later."""
        future: Any = item.future
        if self._pool.joined or self._rng.random() >= 0.05:
            return False
        self.world.note("job %d is held back", future.account.number)
        wait = self._rng.choice((0.0, 1e-3, 0.5))
        self._later(wait, future.account, self._executor.resume, item)
        return True

    def waits_for_all(self, account: Account) -> None:
        """Check that the pool is joined if all results of an unread job are taken."""
        require(self._pool.joined, f"job {account.number} is not held back any more")

    def _cancel(self, account: Account) -> None:
        item = self._futures[account.number].item
        if item is None or account.finished or account.cancelled:
            return
        self.world.note("job %d is cancelled", account.number)
        self._executor.cancel(item)
        # Results that come until the loop has the news belong to the user.
        self.world.loop.call_soon(self._is_cancelled, account)

    def _is_cancelled(self, account: Account) -> None:
        if not account.finished:
            account.cancelled = True

    def drain(self) -> None:
        """Close the pool, and perhaps wait for its end."""
        self._once_started(self._close)

    def terminate(self) -> None:
        """Terminate the pool."""
        self._once_started(self._terminate)

    def _once_started(self, action: Callable[[], None]) -> None:
        if self._started:
            self._act(OWNER, action)
        else:
            self._planned.append(action)

    def _close(self) -> None:
        self.world.note("the pool is closed")
        self._executor.close()
        if self._rng.random() < 0.5:
            self._pool.joined = True
            self.world.loop.call_soon(self._executor._lift_limits)

    def _terminate(self) -> None:
        self.world.note("the pool is terminated")
        self._executor.terminate(RuntimeError("terminated"))

    def heard_late(self, child: Child, said: Any) -> None:
        """A child handle reports no event after the end of its child."""

    # Invariants

    @property
    def is_closing(self) -> bool:
        """Return whether the pool is closed to new work."""
        return self._executor._scheduler.closing

    @property
    def starved(self) -> bool:
        """Return whether the pool may say that no worker starts."""
        return self._pool.starved

    def _check(self) -> None:
        """Something has happened."""
        for job in self._ledger.jobs:
            account = Names().account(job)
            if account is not None:
                account.fed = job.fed
        for batch in self._ledger.batches.values():
            if batch.pin:
                self.language.pinned[batch.seq] = batch.start
        self._audit.check()

    def check_end(self) -> None:
        """Close the pool when all is quiet, and check that no object is left."""
        for account in self.world.oracle.accounts:
            missing = len(account.plan.tasks) - account.fed
            excused = account.cancelled or account.refused or account.plan.everywhere
            if missing and not excused:
                raise Violation(f"only {account.fed} tasks of job {account.number} were fed")
        if not self.is_closing:
            self._pool.check_rest()
            self._act(OWNER, self._close)
        self.world.run_out()
        self._pool.check_end()
        for worker in self.world.workers:
            if worker.born and not worker.dead:
                raise Violation(f"{worker.name} outlives the pool")

    def done(self) -> bool:
        """Every job is over, and the pool too if it was closed."""
        accounts = self.world.oracle.accounts
        over = all(account.finished or account.cancelled for account in accounts)
        return over and self._executor.ended.is_set() is self.is_closing

    def leave_process(self) -> None:
        """Leave no trace in this process."""
        members: list[Any] = list(self._executor._scheduler.workers.members)
        for member in members:
            mp_process._children.discard(member.process)  # type: ignore[attr-defined]
        self._stage.leave()


def _user(account: Account) -> str:
    """The name of the thread that asks for a job."""
    return f"the user of job {account.number}"


def _options(schedule: Schedule) -> PoolOptions:
    return PoolOptions(
        new_process=partial(PoolProcess, like=ForkProcess),
        minimum=schedule.min_workers,
        maximum=schedule.max_workers,
        max_tasks=schedule.left,
        limits=limits_of(schedule.jobs[0]),
        retryable=(Again,) if _retries(schedule) else (),
        idle_timeout=60.0 if schedule.linger is None else schedule.linger + 1e-3,
    )


def _retries(schedule: Schedule) -> bool:
    return any(task.act is Act.RETRIED for job in schedule.jobs for task in job.tasks)


def for_pool(schedule: Schedule) -> Schedule:
    """Limit a schedule to a pool's features; retries, for one, belong to the pool."""
    retries = schedule.jobs[0].retries
    return replace(schedule, jobs=tuple(_for_pool(job, retries) for job in schedule.jobs))


def _for_pool(job: Job, retries: int) -> Job:
    if job.everywhere:  # a broadcast has no timeout
        tasks = tuple(task for task in job.tasks if task.act not in (Act.ENDLESS, Act.UNSENDABLE))
        job = replace(job, tasks=tasks or (Task(1e-3),), timeout=None)
    tasks = job.tasks[:MOST]
    return replace(job, tasks=tasks, retries=retries, alone=job.timeout is not None)
