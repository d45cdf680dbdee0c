"""Reading no faster than is granted, with nobody but the test to grant it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest

from fiber._engine.chunks import TARGET, TaskPace
from fiber._runtime.work_items import AHEAD, InputClosed, InputStream
from unit.ledger_steps import known

SLOW_TASKS = known(1.0, 1)
"""Tasks of which one is a message."""


class Reading:
    """A stream, what it was told to notify, and a thread that reads it."""

    def __init__(self, unit: int = 1, limit: int | None = None) -> None:
        self.notified = 0
        self.read: list[Any] = []
        self.error: BaseException | None = None
        self.consumed = 0
        self.stream = InputStream(unit, self._notify, limit, lambda: self.consumed)
        self._thread: threading.Thread | None = None

    def _notify(self) -> None:
        self.notified += 1

    def consume(self) -> None:
        """The user takes a result."""
        self.consumed += 1
        self.stream.ask()

    def grant(self, waiting: int = 0, workers: int = 1, pace: TaskPace = SLOW_TASKS) -> None:
        self.stream.grant(waiting, workers, pace, TARGET)

    def items(self, iterable: Any) -> Iterator[Any]:
        for item in iterable:
            self.read.append(item)
            yield item

    def here(self, iterable: Any) -> None:
        """Read on this thread: there is credit enough."""
        self.stream.read(self.items(iterable))

    def begin(self, iterable: Any) -> None:
        """Read on a separate thread."""

        def read() -> None:
            try:
                self.here(iterable)
            except KeyError as error:
                self.error = error

        self._thread = threading.Thread(target=read)
        self._thread.start()

    def end(self) -> None:
        """No more; all that was granted is read by then."""
        self.stream.end()
        assert self._thread is not None
        self._thread.join()


def test_all_is_read_and_taken_in_order() -> None:
    reading = Reading()
    reading.grant(pace=known(1e-6))
    reading.here(range(10))
    assert reading.stream.take() == list(range(10))
    assert reading.stream.take() == []


def test_no_more_is_read_than_was_granted() -> None:
    reading = Reading()
    reading.grant(workers=2)
    finished = threading.Event()

    def items() -> Iterator[int]:
        yield from range(2 * AHEAD - 1)
        finished.set()
        yield from range(1000)

    reading.begin(items())
    finished.wait()
    reading.end()
    assert len(reading.read) <= 2 * AHEAD


def test_each_grant_brings_it_to_the_bound_and_none_comes_before_half_is_gone() -> None:
    reading = Reading()
    reading.grant(workers=2)
    reading.grant(workers=2)
    reading.here(range(2 * AHEAD - 1))
    assert len(reading.stream.take()) == 2 * AHEAD - 1
    assert reading.stream._granted == 2 * AHEAD
    reading.grant(waiting=AHEAD, workers=2)
    assert reading.stream._granted == 2 * AHEAD, "more than half is left"
    reading.grant(waiting=AHEAD - 1, workers=2)
    assert reading.stream._granted == 3 * AHEAD


def test_a_closed_stream_with_a_limit_reads_up_to_the_limit() -> None:
    reading = Reading(limit=5)
    reading.grant()
    reading.consume()
    reading.stream.close()
    reading.stream.close()
    reading.stream.lift_limit()
    reading.grant(workers=100)
    with pytest.raises(InputClosed):
        reading.here(range(1000))
    assert reading.stream.take() == list(range(6))


def test_a_closed_stream_without_a_limit_reads_on() -> None:
    reading = Reading()
    reading.stream.close()
    reading.grant()
    reading.here(range(AHEAD - 1))
    assert reading.stream.take() == list(range(AHEAD - 1))


def test_an_input_stream_reads_further_ahead_for_quick_tasks() -> None:
    slow, quick = Reading(), Reading()
    slow.grant()
    quick.grant(pace=known(1e-5))
    assert quick.stream._granted > 10 * slow.stream._granted


def test_only_the_last_unit_may_be_incomplete() -> None:
    reading = Reading(unit=4)
    reading.grant(workers=4)
    taken: list[list[int]] = []

    def items() -> Iterator[int]:
        for n in range(10):
            taken.append(reading.stream.take())
            yield n

    reading.here(items())
    assert [block for block in taken if block] == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert reading.stream.take() == [8, 9]


def test_grants_are_whole_units() -> None:
    reading = Reading(unit=4, limit=7)
    reading.grant(workers=4)
    assert reading.stream._granted == 4


def test_a_reader_that_waits_for_input_is_notified_once() -> None:
    reading = Reading()
    reading.grant(workers=10)

    def items() -> Iterator[int]:
        yield from range(5)
        assert reading.notified == 1
        assert reading.stream.take() == list(range(5))
        reading.stream.await_input()
        yield from range(5)

    reading.here(items())
    assert reading.notified == 2


def test_input_that_comes_before_it_is_awaited_is_taken() -> None:
    reading = Reading()
    reading.grant()
    assert reading.stream.take() == []
    reading.stream._awaited = False
    reading.here([1])  # now, between both
    reading.stream.await_input()
    assert reading.stream.take() == [1]


def test_an_exception_of_the_iterable_comes_after_the_earlier_items() -> None:
    reading = Reading()
    reading.grant()

    def items() -> Iterator[int]:
        yield 1
        raise KeyError("input")

    with pytest.raises(KeyError):
        reading.here(items())
    assert reading.stream.take() == [1]


def test_a_value_that_is_not_iterable_is_refused_at_once() -> None:
    with pytest.raises(TypeError):
        Reading().stream.read(3)  # type: ignore[arg-type]


# The end


def test_a_reader_that_waits_ends_with_the_stream() -> None:
    reading = Reading()
    reading.begin(range(10))
    reading.end()
    assert reading.read == []


def test_a_reader_ends_with_the_stream_before_it_has_used_its_credit() -> None:
    reading = Reading()
    reading.grant(workers=100)

    def items() -> Iterator[int]:
        yield 1
        reading.stream.end()
        yield 2
        raise AssertionError("it reads on")

    reading.here(items())
    assert reading.read == [1, 2]


def test_an_ended_input_stream_gets_no_grant() -> None:
    reading = Reading()
    reading.stream.end()
    reading.grant()
    assert reading.stream._granted == 0


# The limit


def test_no_more_is_read_than_the_limit_allows_until_it_is_consumed() -> None:
    reading = Reading(limit=2)
    reading.grant(workers=100)
    assert reading.stream._granted == 2
    reading.here(range(1))
    reading.stream.take()
    reading.grant(workers=100)
    assert reading.stream._granted == 2
    assert reading.notified == 1
    reading.consume()
    assert reading.notified == 2, "there is room"
    reading.consume()
    assert reading.notified == 2, "as was said already"
    reading.grant(workers=100)
    assert reading.stream._granted == 4


def test_consumption_is_reported_only_to_a_waiting_reader() -> None:
    reading = Reading(limit=2)
    reading.consume()
    reading.grant()
    reading.consume()
    assert reading.notified == 0


@pytest.mark.parametrize("counted", [True, False])
def test_consumption_during_the_count_is_counted_or_reported(
    counted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    reading = Reading(limit=1)
    reading.grant()
    reading.here([])
    room = InputStream._room

    def consumed_meanwhile(stream: InputStream, limit: int) -> int:
        if counted:
            reading.consume()
            return room(stream, limit)
        found = room(stream, limit)
        reading.consume()
        return found

    monkeypatch.setattr(InputStream, "_room", consumed_meanwhile)
    reading.stream._taken = 1
    reading.grant()
    monkeypatch.undo()
    assert reading.notified == 1, "in vain where it was counted as well"
    reading.grant()
    assert reading.stream._granted == 2


def test_a_limit_below_a_unit_lets_one_through() -> None:
    reading = Reading(unit=4, limit=1)
    reading.grant()
    assert reading.stream._granted == 4


def test_a_wait_for_the_end_lifts_the_limit() -> None:
    reading = Reading(limit=1)
    reading.grant(workers=2)
    reading.stream.lift_limit()
    reading.grant(workers=2)
    assert reading.stream._granted == 2 * AHEAD
