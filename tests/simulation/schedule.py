"""Events of one simulated run: drawn from a seed, made smaller when it fails."""

from __future__ import annotations

import enum
import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, TypeAlias

FOREVER = float("inf")


class Act(enum.Enum):
    """End of a task."""

    FINE = enum.auto()
    RAISES = enum.auto()
    RETRIED = enum.auto()
    """Raises an exception that the pool retries, in the first ``times`` runs."""
    POISON = enum.auto()
    """Kills each worker that runs it."""
    FATAL = enum.auto()
    """Kills the first ``times`` workers that run it."""
    UNREADABLE = enum.auto()
    """No worker can unpickle it."""
    UNSENDABLE = enum.auto()
    """Task that does not even pickle."""
    ENDLESS = enum.auto()


@dataclass(frozen=True, slots=True)
class Task:
    """Plan of one task."""

    seconds: float
    act: Act = Act.FINE
    times: int = 0


@dataclass(frozen=True, slots=True)
class Job:
    """Call of the pool's user."""

    at: float
    tasks: tuple[Task, ...]
    bite: int
    """Tasks that are fed at a time."""
    pause: float
    """Seconds between two bites: the user's generator is slow."""
    retries: int = 3
    unit: int = 1
    alone: bool = False
    timeout: float | None = None
    everywhere: bool = False
    """True if its first task is pinned to every existing worker."""
    cancelled_at: float | None = None


@dataclass(frozen=True, slots=True)
class Agent:
    """Host. ``delay`` and ``jitter``, one way, in seconds: none on the master's own."""

    delay: float = 0.0
    jitter: float = 0.0


@dataclass(frozen=True, slots=True)
class Crash:
    """Worker number ``worker`` dies at the ``step``-th point where something can go wrong."""

    worker: int
    step: int


@dataclass(frozen=True, slots=True)
class Kill:
    """A worker dies at a certain time, busy or not."""

    worker: int
    at: float


@dataclass(frozen=True, slots=True)
class StillBirth:
    """A worker dies before it is ready."""

    worker: int


@dataclass(frozen=True, slots=True)
class Stop:
    """A worker does not run for a while."""

    worker: int
    at: float
    seconds: float


@dataclass(frozen=True, slots=True)
class Slow:
    """All that a worker does takes longer, and its watch does not watch."""

    worker: int
    factor: float


@dataclass(frozen=True, slots=True)
class Cut:
    """Cut of an agent from the network for ``seconds``; FOREVER: its host is gone."""

    agent: int
    at: float
    seconds: float


@dataclass(frozen=True, slots=True)
class Repeat:
    """The ``message``-th message of a worker arrives twice."""

    worker: int
    message: int


@dataclass(frozen=True, slots=True)
class Lie:
    """The ``message``-th message of a worker says something wrong in its place."""

    worker: int
    message: int


@dataclass(frozen=True, slots=True)
class Refusal:
    """The ``start``-th time that a worker is to be started the system says no."""

    start: int


@dataclass(frozen=True, slots=True)
class Famine:
    """Time in which no worker becomes ready."""

    at: float
    seconds: float
    exitcode: int
    """Exit code of the workers; REFUSED: the system starts none."""

    REFUSED: ClassVar[int] = 0


@dataclass(frozen=True, slots=True)
class Drain:
    """Some worker is asked to leave."""

    at: float


@dataclass(frozen=True, slots=True)
class Terminate:
    """Every job is cancelled."""

    at: float


Fault: TypeAlias = (
    Crash
    | Kill
    | StillBirth
    | Stop
    | Slow
    | Cut
    | Repeat
    | Lie
    | Refusal
    | Famine
    | Drain
    | Terminate
)


@dataclass(frozen=True, slots=True)
class Schedule:
    """Everything that is not the ledger's choice.  ``seed`` also decides delays and flushes."""

    seed: int
    jobs: tuple[Job, ...]
    agents: tuple[Agent, ...] = (Agent(),)
    faults: tuple[Fault, ...] = ()
    min_workers: int = 1
    max_workers: int = 1
    left: int | None = None
    """maxtasksperchild."""
    linger: float | None = None
    """Seconds after which an idle worker leaves."""

    @property
    def size(self) -> tuple[int, int]:
        """Smaller is simpler."""
        return len(self.faults), sum(len(job.tasks) + 1 for job in self.jobs)


_SECONDS = {
    "tiny": (2e-6, 5e-5),
    "short": (1e-4, 1e-3),
    "medium": (1e-3, 2e-2),
    "long": (5e-2, 0.5),
    "mixed": (2e-6, 0.1),
}


def draw(seed: int) -> Schedule:
    """The schedule of a seed."""
    return _Draw(seed).schedule()


class _Draw:
    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.rng = random.Random(seed)
        self.liars = random.Random(f"{seed} liars")
        self.horizon = 5e-3
        """Seconds within which most will have happened: the first workers start, and the work."""

    def schedule(self) -> Schedule:
        rng = self.rng
        remote = rng.choice((0, 0, 1, 2))
        agents = [Agent(), *(self.remote_agent() for _ in range(remote))]
        max_workers = rng.choice((1, 2, 2, 3, 4, 6))
        min_workers = max_workers if rng.random() < 0.6 else rng.randint(0, max_workers)
        jobs = []
        for _ in range(rng.choice((1, 1, 2, 3))):
            jobs.append(self.job())
            self.horizon += sum(task.seconds for task in jobs[-1].tasks) / max_workers
        return Schedule(
            seed=self.seed,
            jobs=tuple(jobs),
            agents=tuple(agents),
            faults=tuple(self.faults(max_workers, remote)),
            min_workers=min_workers,
            max_workers=max_workers,
            left=rng.choice((None, None, None, 1, 2, 5)),
            linger=None if min_workers == max_workers else rng.choice((0.0, 1e-3, 0.05)),
        )

    def remote_agent(self) -> Agent:
        delay = self.rng.choice((1e-4, 1e-3, 2e-2))
        return Agent(delay, delay * self.rng.random())

    def time(self) -> float:
        return self.rng.random() * self.horizon

    def job(self) -> Job:
        rng = self.rng
        low, high = _SECONDS[rng.choice(list(_SECONDS))]
        odd = rng.choice((0.0, 0.0, 0.05, 0.3))
        timeout = rng.choice((None, None, None, None, 0.05, 0.5))
        acts = [act for act in Act if act is not Act.FINE and (act is not Act.ENDLESS or timeout)]
        many = rng.random() < 0.004
        if many:
            low, high = _SECONDS["tiny"]
        tasks = []
        for _ in range(2500 if many else rng.choice((0, 1, 2, 5, 10, 20, 40, 80))):
            # Times spread evenly over their magnitudes.
            seconds = low * (high / low) ** rng.random()
            act = rng.choice(acts) if rng.random() < odd else Act.FINE
            tasks.append(Task(seconds, act, rng.randint(1, 3)))
        everywhere = rng.random() < 0.15
        at = rng.choice((0.0, self.time()))
        cancelled_at = at + rng.choice((0.0, 1e-4, self.time()))
        return Job(
            at=at,
            tasks=tuple(tasks) or ((Task(low),) if everywhere else ()),
            bite=rng.choice((300, 3000)) if many else rng.choice((3000, 3000, 1, 7)),
            pause=rng.choice((0.0, 1e-4, 1e-2)),
            retries=rng.choice((3, 3, 1, 0)),
            unit=rng.choice((1, 1, 1, 1, 2, 5)),
            alone=timeout is not None or rng.random() < 0.1,
            timeout=timeout,
            everywhere=everywhere,
            cancelled_at=cancelled_at if rng.random() < (0.4 if everywhere else 0.2) else None,
        )

    def faults(self, workers: int, remote: int) -> Iterator[Fault]:
        rng = self.rng
        kinds = ["crash", "crash", "kill", "birth", "stop", "slow", "repeat", "refusal", "drain"]
        kinds += ["cut"] * (3 if remote else 0)
        for _ in range(rng.choice((0, 1, 1, 2, 4, 8))):
            # Also those workers that replace the first ones.
            worker = rng.randrange(workers + 3)
            match rng.choice(kinds):
                case "crash":
                    yield Crash(worker, rng.randint(1, rng.choice((5, 20, 80))))
                case "kill":
                    yield Kill(worker, self.time())
                case "birth":
                    yield StillBirth(worker)
                case "stop":
                    yield Stop(worker, self.time(), rng.choice((1e-3, 0.05, 3.0)))
                case "slow":
                    yield Slow(worker, rng.choice((3.0, 100.0)))
                case "repeat":
                    yield Repeat(worker, rng.randint(1, 10))
                case "refusal":
                    yield Refusal(workers + rng.randint(1, 5))
                case "drain":
                    yield Drain(self.time())
                case "cut":
                    seconds = rng.choice((0.1, 5.0, 14.0, 16.0, 40.0, FOREVER))
                    yield Cut(rng.randint(1, remote), self.time(), seconds)
        if self.liars.random() < 0.15:
            yield Lie(self.liars.randrange(workers + 3), self.liars.randint(1, 10))
        if rng.random() < 0.05:
            yield Terminate(self.time())
        if rng.random() < 0.1:
            at = rng.choice((0.0, 5e-3, self.time()))
            exitcode = rng.choice((1, -9, Famine.REFUSED))
            yield Famine(at, rng.choice((0.3, 3.0, 15.0, 15.0, 100.0)), exitcode)
            if at:
                yield Kill(rng.randrange(workers), at + self.time())


def simpler(schedule: Schedule) -> Iterator[Schedule]:
    """Schedules with something left out, the ones that leave out most first."""
    faults, jobs = schedule.faults, schedule.jobs
    for at in range(len(jobs)):
        if len(jobs) > 1:
            yield replace(schedule, jobs=jobs[:at] + jobs[at + 1 :])
    for size in (len(faults) // 2, 1) if len(faults) > 1 else (1,):
        for at in range(0, len(faults), size):
            yield replace(schedule, faults=faults[:at] + faults[at + size :])
    for at, job in enumerate(jobs):
        for tasks in _fewer(job.tasks):
            yield replace(schedule, jobs=_with(jobs, at, replace(job, tasks=tasks)))
    yield from _plainer(schedule)


def _plainer(schedule: Schedule) -> Iterator[Schedule]:
    """The same with one special condition less."""
    for at, job in enumerate(schedule.jobs):
        for plain in (
            replace(job, cancelled_at=None),
            replace(job, bite=3000),
            replace(job, unit=1),
            replace(job, at=0.0),
            replace(job, everywhere=False),
        ):
            if plain != job:
                yield replace(schedule, jobs=_with(schedule.jobs, at, plain))
    if schedule.left is not None:
        yield replace(schedule, left=None)
    if schedule.linger is not None:
        yield replace(schedule, linger=None, min_workers=schedule.max_workers)
    if schedule.max_workers > 1:
        few = schedule.max_workers - 1
        yield replace(schedule, max_workers=few, min_workers=min(few, schedule.min_workers))


def _fewer(tasks: tuple[Task, ...]) -> Iterator[tuple[Task, ...]]:
    size = len(tasks) // 2
    while size:
        for at in range(0, len(tasks), size):
            yield tasks[:at] + tasks[at + size :]
        size //= 2


def _with(jobs: tuple[Job, ...], at: int, job: Job) -> tuple[Job, ...]:
    return (*jobs[:at], job, *jobs[at + 1 :])
