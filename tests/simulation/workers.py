"""A simulated pool worker: reads a message, runs its tasks, answers, and dies as scheduled.

It keeps the rules of ``fiber._agent.worker``: one message at a time, a note on the board before
each stride of tasks, results in order and in one or more pieces, and, of a batch that runs for too
long, everything given back that has not begun.
"""

from __future__ import annotations

import random
import signal
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from fiber._agent.worker import SPLIT_EAGER_AFTER
from fiber._engine.chunks import LIMIT
from simulation.schedule import Act, Crash, Lie, Repeat, Slow, StillBirth, Task

if TYPE_CHECKING:
    from simulation.agents import Child
    from simulation.world import World

MOMENT = 1e-5
"""Seconds that reading a message or starting a task takes at most."""


class Ref(NamedTuple):
    """Names a task: the number of its job in the schedule, and its index in that."""

    job: int
    task: int


NO_OP = Ref(-1, 0)
"""A call without effect and owner."""


class Work(NamedTuple):
    """A message with tasks."""

    seq: int
    tasks: Sequence[Ref]
    stride: int
    unit: int
    apart: bool = False
    """Each task is unpickled by itself."""


class Results(NamedTuple):
    """``tasks`` of batch ``seq`` from ``offset`` on, and how each of them ended."""

    seq: int
    offset: int
    tasks: list[tuple[Ref, Act]]
    seconds: float
    kept: int | None


class Unreadable(NamedTuple):
    """The message of batch ``seq`` does not unpickle."""

    seq: int


class Unknown(NamedTuple):
    """The worker has forgotten the function of batch ``seq``."""

    seq: int


class Broken(NamedTuple):
    """The function of batch ``seq`` does not unpickle."""

    seq: int


class Ready(NamedTuple):
    """The worker can be given work."""


class Worker:
    """Worker of a pool, as a simulated process."""

    def __init__(self, world: World, number: int, child: Child) -> None:
        self.name = child.name
        self.number = number
        self.functions: set[int] = set()
        """Functions that it remembers."""
        self.born = False
        self.dead = False
        self.board: tuple[int, int] | None = None
        self.work: Work | None = None
        """The batch that it has read and not answered in full."""
        self.running: Ref | None = None
        self.units = 0
        self._world = world
        self._child = child
        self._rng = random.Random(f"{world.schedule.seed} {self.name}")
        self._stopped_until = 0.0
        self._awake = False
        self._at = self._sent = self._stop = 0
        self._began = self._mark = 0.0
        self._results: list[tuple[Ref, Act]] = []
        self._talkative = self._rng.choice((0.0, 0.0, 0.3, 1.0))
        self._steps = self._messages = 0
        faults = world.faults_of(number)
        self._crashes = {fault.step for fault in faults if isinstance(fault, Crash)}
        self._repeats = {fault.message for fault in faults if isinstance(fault, Repeat)}
        self._lies = {fault.message for fault in faults if isinstance(fault, Lie)}
        self.has_lied = False
        self._slowness = max((f.factor for f in faults if isinstance(f, Slow)), default=1.0)
        self._still_born = any(isinstance(fault, StillBirth) for fault in faults)

    # Start and end

    def be_born(self) -> None:
        """Start up."""
        self.born = True
        self._later(self._rng.random() * 2e-3, self._initialize)

    def _initialize(self) -> None:
        if self._still_born:
            self.die(1)
        elif exitcode := self._world.famine():
            self.die(exitcode)
        elif self._reach("while it starts"):
            self._awake = True
            self._say(Ready())
            self.wake()

    def wake(self) -> None:
        """Read if a packet may be there."""
        if self._awake and not self.dead and self._child.inbox:
            self._awake = False
            self._later(self._rng.random() * MOMENT, self._read)

    def stop_for(self, seconds: float) -> None:
        """Stop for a while, as after SIGSTOP."""
        self._world.note("%s is stopped for %g s", self.name, seconds)
        self._stopped_until = max(self._stopped_until, self._world.loop.now() + seconds)

    def die(self, exitcode: int) -> None:
        """End at once."""
        if self.dead:
            return
        self.dead = True
        self._world.note("%s dies with %d, at %s", self.name, exitcode, self.board)
        self._child.died(exitcode, self.board)

    def _reach(self, where: str) -> bool:
        """A point where something can go wrong; False if it does."""
        self._steps += 1
        if self._steps in self._crashes:
            self._world.note("%s crashes %s", self.name, where)
            self.die(-signal.SIGSEGV)
        return not self.dead

    def _later(self, seconds: float, callback: Callable[..., None], *args: Any) -> None:
        self._world.loop.call_later(seconds * self._slowness, self._resume, callback, args)

    def _resume(self, callback: Callable[..., None], args: tuple[Any, ...]) -> None:
        if self.dead:
            return
        asleep = self._stopped_until - self._world.loop.now()
        if asleep > 0:
            self._world.loop.call_later(asleep, self._resume, callback, args)
        else:
            callback(*args)

    # Work

    def _read(self) -> None:
        if not self._reach("before it reads"):
            return
        if not self._child.inbox:  # taken back meanwhile
            self._awake = True
            return
        seq, payload, buffers = self._child.read()
        work = self._world.language.work(self, seq, payload, buffers)
        if work is None:
            self._world.oracle.stopped(self, len(self._child.inbox))
            self.die(0)
        elif isinstance(work, Unknown | Broken):
            self._say(work)
            self._wait()
        else:
            self._start(work)

    def _start(self, work: Work) -> None:
        self.work = work
        if not self._reach("before it notes what it has read"):
            return
        acts = {self._world.task(ref).act for ref in work.tasks}
        if Act.UNREADABLE in acts and not work.apart:
            self._say(Unreadable(work.seq))
            self._wait()
        else:
            self._begin(work)

    def _begin(self, work: Work) -> None:
        self._at = self._sent = 0
        self._stop = len(work.tasks)
        self._results = []
        self._began = self._mark = self._world.loop.now()
        # A slow one is too busy for its watch, too.
        if self._stop > 1 and work.unit == 1 and self._slowness == 1:
            self._later(SPLIT_EAGER_AFTER, self._give_back, work.seq)
        self._next(work)

    def _next(self, work: Work) -> None:
        index = self._at
        if index % work.stride == 0:
            self.board = (work.seq, index)
        if not self._reach("in a task"):
            return
        ref = work.tasks[index]
        self._world.oracle.begins(ref, self)
        self._at += 1
        self.running = ref
        task = self._world.task(ref)
        self._later(task.seconds, self._end_task, work, ref, task)

    def _end_task(self, work: Work, ref: Ref, task: Task) -> None:
        act = task.act
        if act is Act.ENDLESS:
            return
        run = self._world.oracle.runs(ref)
        if act is Act.POISON or (act is Act.FATAL and run <= task.times):
            self.die(-signal.SIGKILL)
            return
        self.running = None
        if act is Act.RETRIED and run > task.times:
            act = Act.FINE
        if not self._reach("after a task"):
            return
        self._results.append((ref, act))
        if self._at == self._stop:
            if self._send(None):
                self._wait()
        elif self._rng.random() >= self._talkative or self._send(None):
            self._next(work)

    def _give_back(self, seq: int) -> None:
        if self.work is not None and self.work.seq == seq and self._at < self._stop:
            self._stop = self._at
            self._send(self._at)

    def _send(self, kept: int | None) -> bool:
        assert self.work is not None
        if not self._reach("before it sends"):
            return False
        now = self._world.loop.now()
        some, self._results = self._results, []
        self._say(Results(self.work.seq, self._sent, some, now - self._mark, kept))
        self._sent += len(some)
        self._mark = now
        return self._reach("after it sent")

    def _wait(self) -> None:
        if self.work is not None:
            self.units += -(-self._at // self.work.unit)
        self.work = None
        self._at = self._stop = 0
        self._awake = True
        self.wake()

    def _lie(self, truth: Any) -> Any:
        """Something that its master can tell from the truth."""
        self.has_lied = True
        seqs = [
            other.work.seq
            for other in self._world.workers
            if other is not self and other.work is not None and not other.dead
        ]
        seq = self._rng.choice([*seqs, truth.seq + 1000])
        lie: Any = self._rng.choice((Unreadable(seq), Results(seq, 0, [], 0.0, None)))
        if isinstance(truth, Results):
            gap, surplus = truth.offset + 1, [*truth.tasks, *[(NO_OP, Act.FINE)] * LIMIT]
            lie = self._rng.choice((lie, truth._replace(offset=gap), truth._replace(tasks=surplus)))
        self._world.note("%s lies: %s", self.name, lie)
        return lie

    def _say(self, message: Any) -> None:
        self._messages += 1
        if self._messages in self._lies and not isinstance(message, Ready):
            message = self._lie(message)
        self._child.say(message)
        if self._messages in self._repeats and not isinstance(message, Ready | Unknown | Broken):
            self._child.say(message)
