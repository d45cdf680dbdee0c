"""The dispatcher against ports, a loop and a pump that do nothing by themselves."""

from __future__ import annotations

import gc
import pickle
import weakref
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import pytest
from fiber._runtime.dispatcher import Dispatcher
from fiber._runtime.staff import Terms
from fiber._runtime.workers import Link

from fiber._agent.port import ExitReport
from fiber._engine.ledger import PATIENCE
from fiber._runtime import exchange, workers
from fiber._runtime.outcome import Encoded, Failure
from fiber._wire import work
from fiber._wire.packet import Message
from fiber.errors import WorkerDied
from fiber.process import Process
from unit import pool_tasks as tasks


class ManualLoop:
    """Time passes, and timers fire, when the test says so."""

    def __init__(self) -> None:
        self.time = 0.0
        self.timers: list[tuple[float, Callable[[], None]]] = []

    def now(self) -> float:
        return self.time

    def on_thread(self) -> bool:
        return True

    def depend(self, dependent: object) -> None:
        pass

    def call_soon(self, callback: Callable[..., object], *args: Any) -> None:
        callback(*args)

    def call_later(self, seconds: float, callback: Callable[..., object], *args: Any) -> Any:
        entry = (self.time + seconds, lambda: callback(*args))
        self.timers.append(entry)
        return SimpleNamespace(cancel=lambda: entry in self.timers and self.timers.remove(entry))

    def pass_time(self, seconds: float) -> None:
        self.time += seconds
        for entry in [entry for entry in self.timers if entry[0] <= self.time]:
            self.timers.remove(entry)
            entry[1]()


class ManualPump:
    """Does what was posted when the test says so."""

    def __init__(self, name: str) -> None:
        self.posted: list[tuple[Callable[..., object], tuple[Any, ...]]] = []

    def post(self, action: Callable[..., object], *args: Any) -> bool:
        self.posted.append((action, args))
        return True

    def stop(self) -> None:
        pass

    def run(self) -> None:
        while self.posted:
            action, args = self.posted.pop(0)
            action(*args)


class Port:
    """Keeps what is delivered."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.host = "here"
        self.pid = 1
        self.packets: list[tuple[int, bytes]] = []
        self.recalls = 0
        self.signals: list[int] = []
        self.gone = False

    def deliver(self, seq: int, payload: bytes, buffers: Sequence[memoryview] = ()) -> bool:
        if not self.gone:
            self.packets.append((seq, payload))
        return not self.gone

    def take_back(self) -> None:
        self.recalls += 1

    def signal(self, signum: int) -> None:
        self.signals.append(signum)

    def attend(self) -> bool:
        return False


class Sink:
    """Keeps outcomes."""

    def __init__(self) -> None:
        self.outcomes: dict[int, Any] = {}
        self.ended = 0
        self.aborted: BaseException | None = None

    def put(self, start: int, outcomes: list[Any], mixed: bool) -> None:
        self.outcomes.update(enumerate(outcomes, start))

    def end(self) -> None:
        self.ended += 1

    def abort(self, error: BaseException) -> None:
        self.aborted = error


class Rig:
    """A dispatcher with workers that are ready and do what the test says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, count: int, **terms: Any) -> None:
        self.loop = ManualLoop()
        self.ports: list[Port] = []
        self.links: list[Link] = []
        runtime = SimpleNamespace(
            loop=self.loop, start=self._start, config=SimpleNamespace(start_timeout=1.0)
        )
        monkeypatch.setattr(exchange, "runtime", lambda: runtime)
        monkeypatch.setattr(workers, "runtime", lambda: runtime)
        monkeypatch.setattr(exchange, "Pump", ManualPump)
        monkeypatch.setattr(exchange, "monotonic", self.loop.now)
        context = SimpleNamespace(Process=Process)
        self.dispatcher = Dispatcher(Terms(context=context, minimum=count, maximum=count, **terms))
        self.pump: Any = self.dispatcher.pump
        self.dispatcher.start()
        for link in list(self.links):
            self.say(link, work.READY)

    def close(self) -> None:
        """End it, and find nothing left."""
        self.dispatcher.terminate(RuntimeError("the test is over"))
        for link in list(self.dispatcher.crew.links):
            self.lose(link)
        assert self.dispatcher.ended.is_set()
        assert not self.loop.timers

    def _start(self, process: Any, observer: Link, *, tasks: bool, method: str) -> Port:
        port = Port(process.name)
        self.ports.append(port)
        self.links.append(observer)
        return port

    def say(self, link: Link, *words: Any) -> None:
        link.said(Message(memoryview(pickle.dumps(words)), [], []))

    def answer(self, link: Link, seq: int, values: list[Any], odd: Sequence[Any] = ()) -> None:
        self.say(link, seq, 0, None, 1e-3, values, list(odd))

    def map(self, items: Any, function: Any = tasks.square, **options: Any) -> Sink:
        sink = Sink()
        function = self.dispatcher.function(function)
        self.dispatcher.map(work.MAP, function, items, sink, **options)
        return sink

    def head(self, link: Link, index: int) -> work.Head:
        """The head of a message that a worker got."""
        assert isinstance(link.port, Port)
        return work.Head._make(work.HEAD.unpack_from(link.port.packets[index][1]))

    def lose(self, link: Link, **report: Any) -> None:
        link.exited(ExitReport(-9, "killed by SIGKILL", host="here", **report))


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    rig = Rig(monkeypatch, 2)
    yield rig
    rig.close()


def test_a_map(rig: Rig) -> None:
    sink = rig.map(range(4))
    for link, port in zip(rig.links, rig.ports, strict=True):
        assert [seq for seq, _ in port.packets]
        for seq, _ in list(port.packets):
            rig.answer(link, seq, [seq])
    assert len(sink.outcomes) == 4
    assert sink.ended == 1


def test_a_function_is_sent_once_to_each_worker(rig: Rig) -> None:
    rig.map(range(4))
    for link in rig.links:
        assert rig.head(link, 0).size
        assert not rig.head(link, 1).size


def test_a_function_that_was_not_read_is_sent_again(rig: Rig) -> None:
    rig.map(range(4))
    link, port = rig.links[0], rig.ports[0]
    link.taken_back([seq for seq, _ in port.packets])
    assert rig.head(link, 2).size


def test_a_worker_that_forgot_a_function_is_sent_it_again(rig: Rig) -> None:
    rig.map(range(4))
    link, port = rig.links[0], rig.ports[0]
    rig.say(link, work.UNKNOWN, port.packets[1][0])
    assert rig.head(link, 2).size


def test_the_same_function_has_the_same_identity(rig: Rig) -> None:
    one = rig.dispatcher.function(tasks.square)
    assert rig.dispatcher.function(tasks.square) is one
    assert rig.dispatcher.function(tasks.add).id != one.id


def test_users_picklers_do_not_run_on_the_loop(rig: Rig) -> None:
    pickled: list[int] = []
    tasks.state["pickled"] = pickled
    rig.map([tasks.Tattling(n) for n in range(6)])
    assert len(pickled) == 4  # on the caller's thread
    rig.answer(rig.links[0], rig.ports[0].packets[0][0], [None])
    assert len(pickled) == 4
    rig.pump.run()
    assert len(pickled) == 5


def test_plain_items_are_sent_from_the_loop(rig: Rig) -> None:
    rig.map([(n, str(n)) for n in range(6)])
    rig.answer(rig.links[0], rig.ports[0].packets[0][0], [None])
    assert len(rig.ports[0].packets) == 3
    assert not rig.pump.posted


def test_users_values_are_not_unpickled_on_the_loop(rig: Rig) -> None:
    sink = rig.map(range(1))
    (link,) = [link for link, port in zip(rig.links, rig.ports, strict=True) if port.packets]
    assert isinstance(link.port, Port)
    data = pickle.dumps(tasks.UnreadableInWorker())
    rig.answer(link, link.port.packets[0][0], [None], [(0, work.VALUE, data, 0)])
    outcome = sink.outcomes[0]
    assert type(outcome) is Encoded
    assert outcome.decode() is tasks.identity


def test_idle_workers_get_what_busy_ones_have_not_read(rig: Rig) -> None:
    sink = rig.map(range(4))
    idle, busy = rig.links
    for seq, _ in list(rig.ports[0].packets):
        rig.answer(idle, seq, [seq])
    assert rig.ports[1].recalls == 0
    rig.loop.pass_time(PATIENCE)
    assert rig.ports[1].recalls == 1
    unread = rig.ports[1].packets[1][0]
    busy.taken_back([unread])
    rig.answer(idle, rig.ports[0].packets[-1][0], [7])
    rig.answer(busy, unread, ["late"])
    rig.answer(busy, rig.ports[1].packets[0][0], [8])
    assert sink.ended == 1
    assert "late" not in sink.outcomes.values()


def test_what_was_assigned_and_not_sent_is_not_held_against_its_tasks(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rig.dispatcher, "_send", lambda batches: None)
    rig.map(range(2))
    (job,) = rig.dispatcher._ledger.jobs - {rig.dispatcher._calls.job}
    rig.lose(rig.links[0])
    assert job.attempts == {}
    assert rig.dispatcher._ledger.demand() == 2


def test_a_packet_that_nobody_took_is_not_held_against_its_tasks(rig: Rig) -> None:
    rig.ports[0].gone = rig.ports[1].gone = True
    rig.map(range(2))
    (job,) = rig.dispatcher._ledger.jobs - {rig.dispatcher._calls.job}
    rig.lose(rig.links[0])
    rig.lose(rig.links[1])
    assert job.attempts == {}


def test_a_cancelled_batch_is_not_sent(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    held: list[Any] = []
    send = rig.dispatcher._send
    monkeypatch.setattr(rig.dispatcher, "_send", held.extend)
    sink = Sink()
    function = rig.dispatcher.function(tasks.square)
    request = rig.dispatcher.map(work.MAP, function, range(2), sink)
    rig.dispatcher.cancel(request)
    send(held)
    assert not rig.ports[0].packets
    assert not rig.ports[1].packets
    assert len(rig.dispatcher._ledger.idle()) == 2


def test_a_task_that_kills_its_workers(rig: Rig) -> None:
    sink = Sink()
    rig.dispatcher.call(sink, tasks.square, (3,), {})
    for _ in range(4):
        (link,) = [link for link in rig.dispatcher.crew.links if link.worker and link.worker.queue]
        assert isinstance(link.port, Port)
        rig.lose(link, running=(link.port.packets[-1][0], 0))
        rig.pump.run()
        for other in rig.links:
            if other.worker is None:
                rig.say(other, work.READY)
    outcome = sink.outcomes[0]
    assert type(outcome) is Failure
    assert isinstance(outcome.error, WorkerDied)
    assert "square" in outcome.error.task
    assert sink.ended == 1


def test_lost_workers_are_replaced_elsewhere_than_on_the_loop(rig: Rig) -> None:
    rig.lose(rig.links[0])
    assert len(rig.links) == 2
    rig.pump.run()
    assert len(rig.links) == 3


def test_a_finished_request_keeps_nothing(rig: Rig) -> None:
    # Whoever waits for the collector waits long where large arrays count as one object each.
    gc.disable()
    try:
        sinks = [rig.map(range(2)), rig.map([])]
        call = Sink()
        rig.dispatcher.call(call, tasks.square, (3,), {}, timeout=60.0)
        cancelled = Sink()
        request = rig.dispatcher.map(
            work.MAP, rig.dispatcher.function(tasks.square), range(9), cancelled
        )
        rig.dispatcher.cancel(request)
        del request
        while any(link.worker and link.worker.queue for link in rig.links):
            for link in rig.links:
                assert link.worker is not None
                for batch in list(link.worker.queue):
                    rig.answer(link, batch.seq, [None] * len(batch.items))
                    del batch
        dead = [weakref.ref(sink) for sink in (*sinks, call, cancelled)]
        del sinks, call, cancelled
        assert [ref() for ref in dead] == [None] * 4
    finally:
        gc.enable()


def test_a_task_on_the_board_was_read_whoever_sent_it(rig: Rig) -> None:
    sink = rig.map(range(1), timeout=60.0)
    (link,) = [link for link in rig.links if link.worker and link.worker.queue]
    (batch,) = link.worker.queue  # type: ignore[union-attr]
    rig.dispatcher._unsent.add(batch.seq)  # its sender has not come to say that it is sent
    job = batch.job
    assert job is not None
    rig.lose(link, running=(batch.seq, 0))
    assert job.attempts == {0: 1}
    assert not sink.ended
