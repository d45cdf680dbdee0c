"""Points in time in the API's words."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fiber_api.times import EARLIEST, LATEST, format_time, parse_time

MOMENT = 1795272973.0


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("2026-11-21T14:56:13Z", MOMENT),
        ("2026-11-21T15:56:13+01:00", MOMENT),
        ("2026-11-21T14:56:13.250000Z", MOMENT + 0.25),
        ("1970-01-01T00:00:00Z", 0.0),
    ],
)
def test_times_of_kubernetes_can_be_read(text: str, seconds: float) -> None:
    assert parse_time(text) == seconds


@pytest.mark.parametrize(
    "text",
    [
        *("", "yesterday", "2026-11-21T14:56:13", "2026-11-21", "0", "\ud800"),
        "9999-12-31T23:59:59-01:00",
        "0001-01-01T00:00:00+01:00",
    ],
)
def test_a_text_that_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is no time such as"):
        parse_time(text)


@settings(deadline=None)
@given(st.text())
def test_any_other_text_is_refused_in_the_same_way(text: str) -> None:
    with pytest.raises(ValueError, match="is no time such as"):
        parse_time(text)


def test_fractions_are_cut_off() -> None:
    assert format_time(MOMENT + 0.99) == "2026-11-21T14:56:13Z"
    assert format_time(-0.5) == "1969-12-31T23:59:59Z"


def test_a_time_beyond_the_calendar_is_written_as_its_end() -> None:
    assert format_time(1e308) == format_time(LATEST) == "9999-12-31T23:59:59Z"
    assert format_time(-1e308) == format_time(EARLIEST) == "0001-01-01T00:00:00Z"


@settings(deadline=None)
@given(st.integers(min_value=int(EARLIEST), max_value=int(LATEST)))
def test_whole_seconds_come_back(seconds: int) -> None:
    assert parse_time(format_time(seconds)) == seconds
