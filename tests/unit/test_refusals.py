"""Which refusals are told, and how often."""

from __future__ import annotations

from fiber._transport import refusals
from fiber._transport.refusals import Refusals


def test_the_same_is_told_once_and_again_after_some_minutes() -> None:
    told = Refusals()
    assert told.is_news("here", "late", 0.0)
    assert not told.is_news("here", "late", refusals._FORGET - 1)
    assert told.is_news("there", "late", 1.0)
    assert told.is_news("here", "late", refusals._FORGET)
    assert not told.is_news("here", "late", refusals._FORGET + 1)


def test_who_varies_his_fault_is_not_told_for_ever_and_keeps_nobody_else_out_for_ever() -> None:
    told = Refusals()
    heard = [told.is_news("here", f"fault {number}", 0.0) for number in range(1000)]
    assert sum(heard) == refusals._MOST
    assert not told.is_news("there", "late", 1.0)
    assert told.is_news("there", "late", refusals._FORGET)
