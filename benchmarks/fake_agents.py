"""Agents and workers that are not processes, to measure what depends on their number only.

A `FakeAgent` is an `AgentHandle` whose children live in the process of the agent itself. The
master's work for them, and the messages to and from them, are real, but the children cost next to
nothing. They run their tasks by the code of a real worker, one after the other on the loop's
thread. A task that calls `tasks.pretend` keeps its child busy for so long, and the loop free: the
child's answer and its next task wait. Only this module, `agent_host` and `fake_cluster` know
Fiber's inner parts.
"""

from __future__ import annotations

import itertools
import pickle
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from benchmarks import tasks

from fiber._agent import batch_results, worker
from fiber._agent.interface import ChildObserver, ChildSpec, ExitReport
from fiber._transport.loop import Loop
from fiber._wire import work
from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import Message

Answer = tuple[bytes, Sequence[memoryview]]

_READY = pickle.dumps((work.READY,))
_BOARD = 24
_BIRTH = 0.01
"""Seconds until a child is ready, about those of a real one: no process is ready before the call
that starts it has returned, and the master need not be quick about one that is."""


class FakeBackend:
    """`Backend` of one fake agent in this process."""

    name = "fake"
    same_host = True
    same_pids = True
    elastic = False
    sends_program = False
    passes_on = False

    def __init__(self, agent: FakeAgent) -> None:
        self._agent = agent

    def child(self, spec: ChildSpec, observer: ChildObserver) -> Any:
        """Return a child of the one agent."""
        return self._agent.child(spec, observer)

    def close(self) -> None:
        """Do nothing: objects leave nothing behind."""


class FakeAgent:
    """Agent whose children are objects. It calls `on_ready` for each child that is ready."""

    def __init__(
        self,
        loop: Loop,
        host: str,
        runner: TaskRunner,
        on_ready: Callable[[], None] = lambda: None,
    ) -> None:
        self.loop = loop
        self.host = host
        self.runner = runner
        self.on_ready = on_ready
        self._numbers = itertools.count(1)

    def child(self, spec: ChildSpec, observer: ChildObserver) -> FakeChild:
        """Return a child, which is ready soon after it is started."""
        return FakeChild(self, spec.name, next(self._numbers), observer)

    def close(self) -> None:
        """Do nothing: objects leave nothing behind."""


class FakeChild:
    """`ChildHandle` of a pool worker."""

    def __init__(self, agent: FakeAgent, name: str, number: int, observer: ChildObserver) -> None:
        self.name = name
        self.host = agent.host
        self.pid: int | None = None
        self.start_error: Exception | None = None
        self.waiting = False
        self.node = ""
        self._number = number
        self._agent = agent
        self._observer = observer
        self._gone = False
        self._busy = False
        self._unread: deque[tuple[int, Message]] = deque()

    def start(self) -> None:
        """Do nothing: the child will be ready by itself."""
        self._agent.loop.call_later(_BIRTH, self.begin)

    def begin(self) -> None:
        """Report that the child is ready, if it lives. Runs on the loop thread, as all that
        follows."""
        if self._gone:
            return
        self.pid = self._number
        self._observer.started(self._number)
        self.send(_READY)
        self._agent.on_ready()

    def deliver(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Run the batch at the loop's next turn, or end."""
        message = Message(memoryview(work.SEQ.pack(seq) + bytes(payload)), list(buffers), [])
        self._agent.loop.call_soon(self._receive, seq, message)
        return True

    def lease_channel(self) -> None:
        """Do nothing: the loop brings the answers."""

    def reclaim(self) -> None:
        """Return None: this worker is never leased."""

    def recall(self) -> None:
        """Take back the batches that the child has not begun."""
        self._agent.loop.call_soon(self._recall)

    def measure(self) -> None:
        """Do nothing."""

    def signal(self, signum: int) -> None:
        """End the child by the signal."""
        self._agent.loop.call_soon(self._end, ExitReport(-signum, "killed"))

    def send(self, payload: bytes, buffers: Sequence[memoryview] = ()) -> None:
        """Give the worker's packets to its observer: a worker's `Sender`."""
        self._observer.received(Message(memoryview(payload), list(buffers), []))

    def _receive(self, seq: int, message: Message) -> None:
        self._unread.append((seq, message))
        if not self._busy:
            self._run()

    def _run(self) -> None:
        """Run what was delivered, until a task keeps the child busy."""
        while self._unread and not self._gone:
            _, message = self._unread.popleft()
            answers, seconds, goes_on = self._agent.runner.run(message)
            if seconds:
                self._busy = True
                self._agent.loop.call_later(seconds, self._done, answers)
                return
            self._answer(answers)
            if not goes_on:
                self._end(ExitReport(0, "exit status 0"))

    def _done(self, answers: list[Answer]) -> None:
        self._busy = False
        if not self._gone:
            self._answer(answers)
            self._run()

    def _answer(self, answers: list[Answer]) -> None:
        for payload, buffers in answers:
            self.send(payload, buffers)

    def _recall(self) -> None:
        seqs = [seq for seq, _ in self._unread]
        self._unread.clear()
        self._observer.recalled(seqs)

    def _end(self, report: ExitReport) -> None:
        if not self._gone:
            self._gone = True
            self._observer.exited(report._replace(host=self.host))


class TaskRunner:
    """Real worker that runs the tasks of all fake children of a process, one child after the other.

    One serves all, because a worker may start a thread that watches over long batches. Its clock
    includes the seconds that tasks pretend to take: a worker reports how long its tasks took, and
    the pool sends a worker several tasks at once if they are short.
    """

    def __init__(self) -> None:
        self._answers: list[Answer] = []
        self._pretended = 0.0
        self._worker = worker.BatchRunner(self, memoryview(bytearray(_BOARD)).cast("Q"))
        tasks.pretend = self._pretend
        for module in (worker, batch_results):
            module.time = self  # type: ignore[attr-defined]

    def run(self, message: Message) -> tuple[list[Answer], float, bool]:
        """Run a message. Return the answers, the seconds that its tasks would take, and False if it
        asks the worker to stop."""
        before = self._pretended
        self._answers = []
        goes_on = self._worker.handle(message)
        return self._answers, self._pretended - before, goes_on

    def send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Keep an answer of the worker for the child whose turn it is."""
        self._answers.append((bytes(payload), buffers))

    def perf_counter(self) -> float:
        """Return the time of the worker's clock, in seconds."""
        return time.perf_counter() + self._pretended

    def _pretend(self, seconds: float) -> None:
        self._pretended += seconds
