"""Size of the work in one message."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber._engine.chunks import (
    FLOOR,
    GROWTH,
    LIMIT,
    PROMPT,
    RESUMED,
    SLOW,
    STRIDE_LIMIT,
    TARGET,
    TaskPace,
    default_chunksize,
)

MANY = 10**9


def pace(seconds: float, tasks: int = LIMIT) -> TaskPace:
    """A pace that was measured on one message of ``tasks``."""
    known = TaskPace()
    known.observe(tasks, seconds * tasks)
    return known


def test_first_message_carries_one_task() -> None:
    assert TaskPace().batch_size(MANY, 1) == 1


@pytest.mark.parametrize("target", [PROMPT, TARGET])
def test_message_carries_the_target(target: float) -> None:
    assert pace(10e-6).batch_size(MANY, 4, target=target) == int(target / 10e-6)


def test_slow_tasks_travel_alone_and_do_not_queue() -> None:
    slow = pace(1.0)
    assert slow.batch_size(1000, 4) == 1
    assert not slow.may_queue(1000)
    assert pace(SLOW / 2).may_queue(1)
    assert TaskPace().may_queue(1)


def test_less_than_a_message_is_worth_does_not_queue() -> None:
    short = pace(FLOOR / 100)
    assert not short.may_queue(99)
    assert short.may_queue(101)


def test_growth_is_bounded_by_the_measured_time() -> None:
    known = pace(1e-7, tasks=3)
    assert known.batch_size(MANY, 1) == 3 * GROWTH


def test_a_message_is_half_of_a_fair_share_at_most() -> None:
    assert pace(1e-3).batch_size(60, 3) == 10


def test_tiny_tasks_are_not_spread_thinner_than_the_floor() -> None:
    assert pace(1e-6).batch_size(1000, 100) == int(FLOOR / 1e-6)


def test_a_long_task_among_short_ones_lowers_the_batch_size_briefly() -> None:
    known = pace(1e-7)
    known.observe(1, 100.0)
    assert known.batch_size(MANY, 1) == 1
    for _ in range(20):
        known.observe(1, 1e-7)
    assert known.batch_size(MANY, 1) > 1000


def test_a_known_function_starts_with_a_little_trust() -> None:
    again = TaskPace(pace(1e-7))
    assert again.batch_size(MANY, 1) == RESUMED * GROWTH
    assert TaskPace(TaskPace()).batch_size(MANY, 1) == 1


def test_no_time_at_all_is_a_time() -> None:
    assert pace(0.0).batch_size(MANY, 1) == LIMIT
    assert pace(0.0).stride() == STRIDE_LIMIT


def test_without_a_measurement_the_size_stays() -> None:
    known = pace(1e-3)
    known.observe(0, 5.0)
    assert known.seconds == pytest.approx(1e-3)


def test_the_stride_is_one_unless_tasks_are_very_short() -> None:
    assert TaskPace().stride() == 1
    assert pace(1e-3).stride() == 1
    assert 1 < pace(2e-6).stride() <= STRIDE_LIMIT


@given(
    seconds=st.floats(0, 10),
    measured=st.integers(1, 10**5),
    waiting=st.integers(1, 10**6),
    workers=st.integers(1, 2000),
    unit=st.integers(1, 5000),
)
def test_size_is_whole_units_or_all_that_is_left(
    seconds: float, measured: int, waiting: int, workers: int, unit: int
) -> None:
    size = pace(seconds, measured).batch_size(waiting, workers, unit)
    assert 1 <= size <= waiting
    assert size == waiting or size % unit == 0
    assert size <= max(LIMIT, unit)


@given(tasks=st.integers(0, 10**6), workers=st.integers(1, 2000))
def test_the_default_chunksize_is_that_of_multiprocessing(tasks: int, workers: int) -> None:
    size, extra = divmod(tasks, workers * 4)
    assert default_chunksize(tasks, workers) == max(1, size + bool(extra))
