"""The loop of a pool worker: what it runs, notes, answers and gives back."""

from __future__ import annotations

import errno
import pickle
import queue
import random
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fiber._agent import worker as worker_module
from fiber._agent.by_value import FUNCTIONS
from fiber._agent.worker import BatchRunner, Watchdog
from fiber._wire import packet, work
from patience import PATIENCE
from processes import pool_tasks as tasks


class Channel:
    """Channel that records a worker's messages to the executor."""

    def __init__(self) -> None:
        self.said: list[tuple[Any, ...]] = []
        self.buffers: list[list[memoryview]] = []
        self.arrived = threading.Condition()

    def send(self, payload: bytes, buffers: Sequence[memoryview] = ()) -> None:
        with self.arrived:
            self.said.append(pickle.loads(payload))
            self.buffers.append([memoryview(bytes(buffer)) for buffer in buffers])
            self.arrived.notify_all()

    def wait_for(self, count: int) -> None:
        with self.arrived:
            assert self.arrived.wait_for(lambda: len(self.said) >= count, PATIENCE)

    def results(self, seq: int) -> list[Any]:
        """Return the results of a batch's tasks, errors unraised."""
        found: list[Any] = []
        for words, buffers in zip(self.said, self.buffers, strict=True):
            if words[0] != seq:
                continue
            _, offset, _, _, values, odd = words
            assert offset == len(found), "results out of order"
            rest = iter(buffers)
            for position, kind, data, count in odd:
                pickled, beside = work.take_beside(data, [next(rest) for _ in range(count)])
                value = pickle.loads(pickled, buffers=beside)
                values[position] = value if kind == work.VALUE else (kind, value)
            found += values
        return found


class Rig:
    """A worker and what it is given."""

    def __init__(self, retryable: tuple[type[BaseException], ...] = ()) -> None:
        self.channel = Channel()
        self.progress = memoryview(bytearray(24)).cast("Q")
        self.worker = BatchRunner(self.channel, self.progress, retryable)
        self._seq = 0

    def give(
        self,
        function: Callable[..., Any] | None,
        items: Any,
        *,
        stride: int = 0,
        unit: int = 1,
        kind: int = work.MAP,
        identity: int = 1,
    ) -> int:
        """Have a batch run; returns its sequence number."""
        data = b""
        beside: Sequence[memoryview] = ()
        size = 0
        if function is not None:
            data, beside = work.move_beside((pickle.dumps(function), []))
            size = len(data) or work.BESIDE
        head = work.Head(kind, stride, unit, identity, size, len(beside))
        body, buffers = work.move_beside(packet.dumps(items))
        return self._handle(work.pack_batch(head, data, body), [*beside, *buffers])

    def call(self, *calls: tuple[Any, ...]) -> int:
        """Have calls (function, args, kwargs) run."""
        pickles = [work.move_beside(packet.dumps(call)) for call in calls]
        buffers = [buffer for _, beside in pickles for buffer in beside]
        return self._handle(work.pack_calls(pickles), buffers)

    def _handle(self, message: bytes, buffers: list[memoryview]) -> int:
        self._seq += 1
        payload = memoryview(work.SEQ.pack(self._seq) + message)
        assert self.worker.handle(packet.Message(payload, buffers, []))
        return self._seq


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Rig:
    """A worker that takes its time: however slow this machine is, it gives nothing back."""
    monkeypatch.setattr(Watchdog, "begin", lambda self, batch: None)
    monkeypatch.setattr(worker_module, "SPLIT_AFTER", 60.0)
    return Rig()


@pytest.fixture
def impatient() -> Iterator[Rig]:
    rig = Rig()
    yield rig
    rig.worker.close()


class Reluctant:
    """A batch whose first task begins only after a while."""

    seq, eager = 1, True

    def __init__(self) -> None:
        self.looks = 0
        self.taken_apart_at: queue.SimpleQueue[int] = queue.SimpleQueue()

    def started(self) -> int:
        self.looks += 1
        return int(self.looks == 3)

    def return_unstarted(self) -> None:
        self.taken_apart_at.put(self.looks)


def test_a_batch_is_taken_apart_once_its_first_task_has_begun() -> None:
    batch: Any = Reluctant()
    watchdog = Watchdog()
    watchdog.begin(batch)
    assert batch.taken_apart_at.get(timeout=PATIENCE) == 3
    watchdog.end()
    watchdog.stop()


MODES = pytest.mark.parametrize(
    "mode",
    [{"stride": 0}, {"stride": 1}, {"stride": 7}, {"stride": 1000}, {"stride": 7, "unit": 3}],
)


@MODES
@pytest.mark.parametrize("items", [range(20), list(range(20)), tuple(range(20)), b"abcdefg"])
def test_results_in_order(rig: Rig, mode: dict[str, int], items: Any) -> None:
    seq = rig.give(tasks.square, items, **mode)
    assert rig.channel.results(seq) == [x * x for x in items]


@MODES
def test_errors_in_their_places(rig: Rig, mode: dict[str, int]) -> None:
    found = rig.channel.results(rig.give(tasks.raise_if_odd, range(30), **mode))
    for x, value in enumerate(found):
        if x % 2:
            kind, error = value
            assert (kind, error.args) == (work.ERROR, (x,))
        else:
            assert value == x


@MODES
def test_stop_iteration_does_not_end_a_batch(rig: Rig, mode: dict[str, int]) -> None:
    found = rig.channel.results(rig.give(tasks.stop_iteration, range(10), **mode))
    assert isinstance(found[3][1], StopIteration)
    assert found[:3] + found[4:] == [0, 1, 2, 4, 5, 6, 7, 8, 9]


@MODES
def test_a_worker_unpacks_the_arguments_of_starmap(rig: Rig, mode: dict[str, int]) -> None:
    items = [(x, 10) for x in range(10)]
    seq = rig.give(tasks.add, items, kind=work.STAR, **mode)
    assert rig.channel.results(seq) == [x + 10 for x in range(10)]


@MODES
def test_results_that_do_not_pickle(rig: Rig, mode: dict[str, int]) -> None:
    found = rig.channel.results(rig.give(tasks.unreprable_result, range(3), **mode))
    assert [kind for kind, _ in found] == [work.ERROR] * 3


def test_a_worker_answers_a_batch_of_calls(rig: Rig) -> None:
    seq = rig.call(
        (tasks.add, (1,), {"y": 2}), (tasks.raise_value_error, (5,), {}), (tasks.pid, (), {})
    )
    found = rig.channel.results(seq)
    assert found[0] == 3
    assert found[1][1].args == (5,)
    assert found[2] == tasks.pid()


def test_a_call_that_does_not_unpickle(rig: Rig) -> None:
    good = packet.dumps((tasks.square, (3,), {}))
    message = work.pack_calls([(b"not a pickle", []), good])
    seq = rig._handle(message, [])
    (kind, error), nine = rig.channel.results(seq)
    assert (kind, type(error), nine) == (work.ERROR, pickle.UnpicklingError, 9)


def test_results_that_find_no_room_are_errors(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    send = rig.channel.send

    def refuse(payload: bytes, buffers: Sequence[memoryview] = ()) -> None:
        if len(payload) > 10_000:
            raise OSError(errno.ENOSPC, "no space left")
        send(payload, buffers)

    monkeypatch.setattr(rig.channel, "send", refuse)
    found = rig.channel.results(rig.give(bytes, [3, 20_000]))
    assert [(kind, error.errno) for kind, error in found] == [(work.ERROR, errno.ENOSPC)] * 2
    assert rig.channel.results(rig.give(bytes, [3])) == [bytes(3)]


# Snapshots


def test_a_reused_object_is_sent_as_it_was(rig: Rig) -> None:
    assert rig.channel.results(rig.give(tasks.grow, range(50))) == [[x] for x in range(50)]


def test_a_reused_buffer_is_sent_before_it_is_used_again(rig: Rig) -> None:
    seq = rig.give(tasks.fill, range(5))
    assert [array[0] for array in rig.channel.results(seq)] == [0, 1, 2, 3, 4]
    assert len(rig.channel.said) == 5


# Functions


def test_functions_are_remembered(rig: Rig) -> None:
    rig.give(tasks.square, [1], identity=7)
    assert rig.channel.results(rig.give(None, [3], identity=7)) == [9]


def test_an_unknown_function_is_asked_for(rig: Rig) -> None:
    seq = rig.give(None, [3], identity=9)
    assert rig.channel.said == [(work.UNKNOWN, seq)]


def test_the_oldest_functions_are_forgotten(rig: Rig) -> None:
    for identity in range(FUNCTIONS + 1):
        rig.give(tasks.square, [1], identity=identity)
    assert rig.channel.results(rig.give(None, [3], identity=1)) == [9]
    seq = rig.give(None, [3], identity=0)
    assert rig.channel.said[-1] == (work.UNKNOWN, seq)


def test_a_batch_that_does_not_unpickle_is_reported(rig: Rig) -> None:
    rig._handle(work.pack_batch(work.Head(work.MAP, 0, 1, 1, 4, 0), b"junk", b""), [])
    kind, seq, error = rig.channel.said[-1]
    assert (kind, seq) == (work.BROKEN, 1)
    assert isinstance(pickle.loads(error), pickle.UnpicklingError)
    rig.give(tasks.square, [1], identity=2)
    rig._handle(work.pack_batch(work.Head(work.MAP, 0, 1, 2, 0, 0), b"", b"junk"), [])
    kind, seq, error = rig.channel.said[-1]
    assert (kind, seq) == (work.UNREADABLE, 3)


def test_a_stop_message_ends_the_worker(rig: Rig) -> None:
    payload = memoryview(work.SEQ.pack(0) + work.STOP_MESSAGE)
    assert not rig.worker.handle(packet.Message(payload, [], []))


# Notes


def test_each_task_is_noted_before_it_runs(rig: Rig) -> None:
    seen: list[tuple[int, int]] = []
    tasks.state["note"] = lambda: seen.append((rig.progress[0], rig.progress[1]))
    try:
        seq = rig.give(note, range(4))
    finally:
        del tasks.state["note"]
    assert seen == [(seq, 0), (seq, 1), (seq, 2), (seq, 3)]


def test_the_position_among_short_tasks_is_noted_once_a_stride(rig: Rig) -> None:
    seen: list[int] = []
    tasks.state["note"] = lambda: seen.append(rig.progress[1])
    try:
        rig.give(note, range(7), stride=3)
    finally:
        del tasks.state["note"]
    assert seen == [0, 0, 0, 3, 3, 3, 6]


def note(_: object) -> None:
    tasks.state["note"]()


# The end of the process


@MODES
def test_results_before_a_sys_exit_are_sent(
    rig: Rig, mode: dict[str, int], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        rig.give(exit_at_three, range(10), **mode)
    *done, last = rig.channel.results(1)
    assert done == [0, 1, 2]
    assert isinstance(last[1], SystemExit)
    assert [words[2] for words in rig.channel.said if words[2] is not None] == [4]
    assert_that_the_task_is_named(capsys)


def test_a_call_that_exits_is_answered_first(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        rig.call((exit_at_three, (3,), {}))
    ((_, error),) = rig.channel.results(1)
    assert isinstance(error, SystemExit)
    assert_that_the_task_is_named(capsys)


def assert_that_the_task_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    (line,) = capsys.readouterr().err.splitlines()
    assert "the task exit_at_three() (" in line
    assert "test_worker.py" in line
    assert "called sys.exit(5)" in line


def test_a_task_that_the_pool_ends_by_a_handler_is_not_named(
    rig: Rig, capsys: pytest.CaptureFixture[str]
) -> None:
    previous = signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    try:
        with pytest.raises(SystemExit):
            rig.call((signal.raise_signal, (signal.SIGTERM,), {}))
    finally:
        signal.signal(signal.SIGTERM, previous)
    assert capsys.readouterr().err == ""


def exit_at_three(x: int) -> int:
    if x == 3:
        raise SystemExit(5)
    return x


def test_other_exceptions_are_the_tasks_own(rig: Rig) -> None:
    ((_, error),) = rig.channel.results(rig.give(tasks.raise_exotic, [1]))
    assert isinstance(error, tasks.Exotic)


@MODES
def test_an_interrupt_is_the_error_of_the_task_that_runs(rig: Rig, mode: dict[str, int]) -> None:
    found = rig.channel.results(rig.give(interrupt_at_three, range(10), **mode))
    assert [type(value) for value in found] == [int] * 3 + [tuple] + [int] * 6
    assert isinstance(found[3][1], KeyboardInterrupt)


@MODES
@pytest.mark.parametrize("seed", range(5))
def test_sigint_at_any_moment_costs_no_result(rig: Rig, mode: dict[str, int], seed: int) -> None:
    items, moments = range(2000), random.Random(seed)
    previous = signal.signal(signal.SIGINT, rig.worker.interrupt)
    striker = threading.Thread(target=strike_main_thread, args=(stop := threading.Event(), moments))
    striker.start()
    try:
        for _ in range(5):
            found = rig.channel.results(rig.give(count_a_little, items, **mode))
            assert len(found) == len(items)
            assert all(
                value == item or isinstance(value[1], KeyboardInterrupt)
                for item, value in zip(items, found, strict=True)
            )
    finally:
        stop.set()
        striker.join()
        signal.signal(signal.SIGINT, previous)


def strike_main_thread(stop: threading.Event, moments: random.Random) -> None:
    while not stop.wait(moments.uniform(0, 1e-3)):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)


def count_a_little(x: int) -> int:
    for _ in range(3):
        pass
    return x


def test_sigint_between_tasks_has_no_effect(rig: Rig) -> None:
    rig.give(abs, range(3))
    rig.worker.interrupt(signal.SIGINT, None)


def interrupt_at_three(x: int) -> int:
    if x == 3:
        raise KeyboardInterrupt
    return x


class Rude:
    """Raises what is no Exception, however it travels."""

    def __init__(self, when: str) -> None:
        self.when = when

    def __reduce__(self) -> Any:
        if self.when == "pickled":
            raise KeyboardInterrupt
        return interrupt_at_three, (3,)


@MODES
def test_an_interrupt_raised_in_pickling_a_result_is_an_error(
    rig: Rig, mode: dict[str, int]
) -> None:
    ((_, error),) = rig.channel.results(rig.give(Rude, ["pickled"], **mode))
    assert "KeyboardInterrupt" in str(error)


def test_an_interrupt_raised_in_unpickling_is_an_error(rig: Rig) -> None:
    rig.give(abs, [Rude("unpickled")])
    rig.give(abs, [1], identity=2)
    assert [words[0] for words in rig.channel.said] == [work.UNREADABLE, 2]


def test_errors_worth_a_retry_are_marked() -> None:
    rig = Rig((LookupError,))
    found = rig.channel.results(rig.give(raise_either, range(2), stride=1, unit=2))
    assert [kind for kind, _ in found] == [work.AGAIN, work.ERROR]


def raise_either(x: int) -> None:
    if x:
        raise ValueError
    raise KeyError


# Giving back


@pytest.mark.parametrize("stride", [0, 1, 50])
def test_a_batch_that_blocks_is_taken_apart(
    impatient: Rig, stride: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, begun = threading.Event(), threading.Event()
    tasks.state.update(gate=gate, begun=begun)

    def sleep(seconds: float) -> None:
        begun.wait(PATIENCE)  # a stall before the task that blocks is not the task's
        time.sleep(seconds)

    timing = SimpleNamespace(sleep=sleep, perf_counter=lambda: 0.0)
    monkeypatch.setattr(worker_module, "time", timing)
    helper = threading.Thread(target=open_when_given_back, args=(impatient, gate))
    helper.start()
    impatient.give(block_at_two, list(range(100)), stride=stride)
    helper.join()
    first = impatient.channel.said[0]
    assert first[2] == 3, "what has not begun was not given back"
    assert first[4] == ([] if stride else [0, 1])
    assert impatient.channel.results(1) == [0, 1, 2]


def open_when_given_back(rig: Rig, gate: threading.Event) -> None:
    rig.channel.wait_for(1)
    gate.set()


def block_at_two(x: int) -> int:
    if x == 2:
        tasks.state["begun"].set()
        assert tasks.state["gate"].wait(PATIENCE)
    return x


def test_a_batch_that_takes_too_long_gives_back_its_remaining_tasks(impatient: Rig) -> None:
    impatient.give(slow, list(range(1000)), stride=5)
    kept = [words[2] for words in impatient.channel.said if words[2] is not None]
    assert kept
    assert impatient.channel.results(1) == list(range(kept[0]))
    assert kept[0] < 1000


def test_chunks_are_not_taken_apart(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_module, "SPLIT_AFTER", 0.0)
    rig.give(tasks.square, list(range(100)), stride=4, unit=10)
    (kept,) = [words[2] for words in rig.channel.said if words[2] is not None]
    assert kept == 10
    assert rig.channel.results(1) == [x * x for x in range(10)]


def slow(x: int) -> int:
    time.sleep(0.002)
    return x


def test_a_short_batch_is_answered_once(rig: Rig) -> None:
    for _ in range(20):
        rig.give(tasks.square, range(50))
    assert [words[0] for words in rig.channel.said] == list(range(1, 21))


# The form of messages


def test_a_function_and_calls_may_be_larger_than_4_gib() -> None:
    head = work.Head(work.MAP, 0, 1, 1, 5 << 30, 0)
    assert work.Head.unpack_from(head.pack()) == head
    assert work.CALL.unpack(work.CALL.pack(5 << 30, 3)) == (5 << 30, 3)


LARGE = packet.INLINE_LIMIT + 1


@pytest.mark.parametrize("size", [1, LARGE, 4 * LARGE])
def test_large_calls_functions_items_and_results(rig: Rig, size: int) -> None:
    text, array = "x" * size, np.ones(size, np.uint8)
    seq = rig.call((tasks.identity, (text,), {}), (tasks.twice, (array,), {}))
    found, twice = rig.channel.results(seq)
    assert found == text
    assert all(np.array_equal(each, array) for each in twice)
    assert rig.channel.results(rig.call((tasks.identity, (text,), {}))) == [text]
    for stride in (0, 1, 7):
        seq = rig.give(partial(tasks.join, text), [text, b"", "y"], stride=stride)
        assert rig.channel.results(seq) == [(text, text), (text, b""), (text, "y")]


def test_large_values_of_an_answer_travel_beside_its_pickle(rig: Rig) -> None:
    for value in ("x" * LARGE, b"x" * LARGE, ("row", b"x" * LARGE), ["x" * LARGE]):
        rig.channel.said.clear()
        rig.channel.buffers.clear()
        seq = rig.call((tasks.identity, (value,), {}))
        assert len(pickle.dumps(rig.channel.said)) < 1000
        assert rig.channel.results(seq) == [value]


def test_more_large_results_than_a_packet_has_buffers(rig: Rig) -> None:
    count = packet.MAX_BUFFERS + 10
    seq = rig.give(tasks.large, range(count), stride=count)
    assert rig.channel.results(seq) == [tasks.large(0)] * count
    assert all(len(buffers) <= packet.MAX_BUFFERS for buffers in rig.channel.buffers)
