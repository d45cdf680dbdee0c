"""An executor on a loop, background threads and workers that do nothing by themselves."""

from __future__ import annotations

import pickle
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

from fiber._agent.interface import ExitReport
from fiber._engine.activity import Activity
from fiber._engine.ledger import Ledger
from fiber._engine.tasks import Batch
from fiber._runtime.executor import PoolExecutor
from fiber._runtime.options import PoolOptions
from fiber._runtime.work_items import WorkItem
from fiber._runtime.workers import WorkerHandle
from fiber._transport.loop import LoopTimer
from fiber._wire import work
from fiber._wire.memory_files import BytesLike
from fiber._wire.packet import Message
from fiber.process import PoolProcess, Process
from processes import pool_tasks as tasks


class ManualLoop:
    """Time passes, and timers fire, when the test says so; one thing is done at a time.

    What is asked for is done at once, or, while it is ``held``, once it is ``released``.
    """

    def __init__(self) -> None:
        self.held = False
        self._time = 0.0
        self._timers: list[LoopTimer] = []
        self._ready: deque[tuple[Callable[..., object], tuple[Any, ...]]] = deque()
        self._running = False

    def now(self) -> float:
        return self._time

    def on_thread(self) -> bool:
        return self._running

    def depend(self, dependent: object) -> None:
        pass

    def call_soon(self, callback: Callable[..., object], *args: Any) -> None:
        self._ready.append((callback, args))
        if not self.held:
            self._run()

    def release(self) -> None:
        self.held = False
        self._run()

    def call_later(self, seconds: float, callback: Callable[..., object], *args: Any) -> LoopTimer:
        timer = LoopTimer(self._time + seconds, lambda: callback(*args))
        self._timers.append(timer)
        return timer

    @property
    def timers(self) -> list[LoopTimer]:
        """Return the timers that are to fire."""
        return [timer for timer in self._timers if timer.callback is not None]

    def pass_time(self, seconds: float) -> None:
        self._time += seconds
        for timer in [timer for timer in self.timers if timer.due <= self._time]:
            self._timers.remove(timer)
            if timer.callback is not None:
                self.call_soon(timer.callback)

    def _run(self) -> None:
        if self._running:
            return
        self._running = True
        try:
            while self._ready:
                callback, args = self._ready.popleft()
                callback(*args)
        finally:
            self._running = False


class ManualThread:
    """Does what was submitted when the test says so."""

    def __init__(self, name: str) -> None:
        self.submitted: list[tuple[Callable[..., object], tuple[Any, ...]]] = []
        self.stopped = False
        self.refusal: RuntimeError | None = None
        """Error with which the thread fails."""

    def submit(self, action: Callable[..., object], *args: Any) -> bool:
        if self.refusal is not None:
            raise self.refusal
        if not self.stopped:
            self.submitted.append((action, args))
        return not self.stopped

    def runs_here(self) -> bool:
        return False

    def stop(self, then: Callable[[], object] = lambda: None) -> None:
        self.stopped = True
        then()

    def join(self) -> None:
        pass

    def run(self) -> None:
        while self.submitted:
            action, args = self.submitted.pop(0)
            action(*args)


class FakeChild:
    """Keeps what is delivered."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.host = "here"
        self.pid: int | None = 1
        self.start_error: Exception | None = None
        self.waiting = False
        self.leaving = ""
        self.node = ""
        self.packets: list[tuple[int, bytes]] = []
        self.recalls = 0
        self.signals: list[int] = []
        self.gone = False

    def start(self) -> None:
        """Do nothing: the test decides what the worker does."""

    def deliver(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        if not self.gone:
            self.packets.append((seq, bytes(payload)))
        return not self.gone

    def recall(self) -> None:
        self.recalls += 1

    def signal(self, signum: int) -> None:
        self.signals.append(signum)

    def measure(self) -> None:
        pass

    def lease_channel(self) -> None:
        """Do nothing: no caller uses it directly."""

    def reclaim(self) -> None:
        """Do nothing: no worker is leased."""

    @property
    def told_to_end(self) -> bool:
        return (0, work.STOP_MESSAGE) in self.packets


class Results:
    """A future that keeps outcomes."""

    def __init__(self) -> None:
        self.outcomes: dict[int, Any] = {}
        self.done = 0
        self.error: BaseException | None = None

    def add_results(self, start: int, outcomes: list[Any], mixed: bool, size: int = 0) -> bool:
        assert not self.outcomes.keys() & range(start, start + len(outcomes)), "twice"
        self.outcomes.update(enumerate(outcomes, start))
        return False

    def has_room(self) -> bool:
        return True

    def lift_bound(self) -> None:
        """Do nothing: there is no bound."""

    def set_done(self) -> None:
        self.done += 1

    def set_exception(self, error: BaseException) -> None:
        assert self.error is None
        self.error = error


class Rig:
    """An executor, with workers that are ready and do what the test says."""

    def __init__(
        self, count: int, *, start: bool = True, ready: bool = True, **options: Any
    ) -> None:
        self.loop = ManualLoop()
        self.children: list[FakeChild] = []
        self.handles: list[WorkerHandle] = []
        self.refusal: BaseException | None = None
        """Error that prevents another worker."""
        host: Any = SimpleNamespace(
            loop=self.loop,
            start=self._start,
            elastic=False,
            backend=SimpleNamespace(passes_on=False),
            activity=Activity(0.0),
            pools=set(),
            look_at_program=lambda: None,
            config=SimpleNamespace(start_timeout=1.0),
        )
        self.threads: dict[str, ManualThread] = {}
        new_process = partial(PoolProcess, like=Process)
        sizes = {"minimum": count, "maximum": count}
        self.executor = PoolExecutor(
            PoolOptions(new_process, **(sizes | options)), host, thread=self._thread
        )
        self.background = self.threads["fiber-pool"]
        if start:
            self.executor.start()
        if ready:
            self.all_ready()

    def _thread(self, name: str) -> Any:
        self.threads[name] = ManualThread(name)
        return self.threads[name]

    def _start(
        self, process: Any, owner: Any, *, tasks: bool, method: str, shared: object
    ) -> FakeChild:
        if self.refusal is not None:
            raise self.refusal
        self.children.append(FakeChild(process.name))
        self.handles.append(owner)
        self.loop.call_soon(owner.begin, self.children[-1])
        return self.children[-1]

    @property
    def ledger(self) -> Ledger:
        return self.executor._scheduler.ledger

    @property
    def maps(self) -> list[Any]:
        """The jobs of the maps that are not done."""
        return [job for job in self.ledger.jobs if job.owner.future is not None]

    @property
    def members(self) -> list[Any]:
        """Workers that are there, or about to be."""
        return list(self.executor._scheduler.workers.members)

    @property
    def busy(self) -> list[WorkerHandle]:
        """Workers that were given something."""
        return [handle for handle in self.handles if handle.worker and handle.worker.queue]

    def close(self) -> None:
        """End it, and find nothing left."""
        self.executor.terminate(RuntimeError("the test is over"))
        for handle in self.members:
            self.lose(handle)
        self.background.run()
        assert self.executor.ended.is_set()
        assert not self.members
        assert not self.ledger.jobs
        assert not self.ledger.batches
        assert not self.loop.timers
        assert all(thread.stopped for thread in self.threads.values())

    # What workers say

    def say(self, handle: WorkerHandle, *words: Any) -> None:
        handle.received(Message(memoryview(pickle.dumps(words)), [], []))

    def all_ready(self) -> None:
        """Have the others say that they are ready."""
        for handle in self.handles:
            if handle.worker is None and handle in self.members:
                self.say(handle, work.READY)

    def answer(
        self, handle: WorkerHandle, seq: int, values: list[Any], odd: Sequence[Any] = ()
    ) -> None:
        self.say(handle, seq, 0, None, 1e-3, values, list(odd))

    def answer_batch(self, batch: Batch) -> None:
        self.answer(batch.worker.key, batch.seq, [None] * len(batch.items))

    def answer_all(self) -> None:
        """Let the workers do all that they are given."""
        self.background.run()
        while batches := list(self.ledger.batches.values()):
            self.answer_batch(batches[0])
            del batches
            self.background.run()

    def lose(self, handle: WorkerHandle, **report: Any) -> None:
        handle.exited(ExitReport(-9, "killed by SIGKILL", host="here", **report))

    # Requests

    def call(self, *args: Any, function: Any = tasks.square, **options: Any) -> Results:
        results = Results()
        self.executor.call(results, function, args or (3,), {}, **options)
        return results

    def item(self, results: Results, *, function: Any = tasks.square, **options: Any) -> WorkItem:
        """A map to come."""
        known = self.executor.function(function)
        return WorkItem(work.MAP, function=known, future=results, **options)

    def map(self, items: Any, **options: Any) -> Results:
        results = Results()
        self.executor.submit(self.item(results, **options), items)
        return results

    # Sent packets

    def child(self, handle: WorkerHandle) -> FakeChild:
        assert isinstance(handle.child, FakeChild)
        return handle.child

    def head(self, handle: WorkerHandle, index: int) -> work.Head:
        """The head of a message that a worker got."""
        return work.Head.unpack_from(self.child(handle).packets[index][1])

    def deliveries(self) -> Iterable[tuple[int, bytes]]:
        """All that all workers were sent."""
        return [packet for child in self.children for packet in child.packets]
