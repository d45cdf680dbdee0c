"""Refusals that are reported, and how often."""

from __future__ import annotations

import pytest

from fiber._transport import acceptor
from fiber._transport.acceptor import Refusals


@pytest.mark.parametrize("own", [False, True])
def test_a_repeated_refusal_is_reported_once_and_again_after_some_minutes(own: bool) -> None:
    told = Refusals()
    assert "late" in told.news("here", "here:1", "late", 0.0, own=own)
    assert not told.news("here", "here:2", "late", acceptor._FORGET - 1, own=own)
    assert told.news("there", "there:1", "late", 1.0, own=own)
    assert told.news("here", "here:3", "late", acceptor._FORGET, own=own)
    assert not told.news("here", "here:3", "late", acceptor._FORGET + 1, own=own)


def many_strangers(told: Refusals, now: float, count: int) -> list[str]:
    heard = [
        told.news(f"host {number}", f"host {number}:1", "late", now) for number in range(count)
    ]
    return [news for news in heard if news]


def test_strangers_from_many_addresses_are_summed_up() -> None:
    told = Refusals()
    assert len(many_strangers(told, 0.0, 1000)) == acceptor._REMEMBERED + 1
    assert not told.news("there", "there:1", "late", 1.0)
    (summary,) = [
        news
        for number in range(acceptor._REMEMBERED + 10)
        if "more turned away" in (news := told.news(str(number), "x:1", "new", acceptor._FORGET))
    ]
    assert f"{1000 - acceptor._REMEMBERED - 1 + 2} more turned away" in summary
    assert "x:1 (new)" in summary


def test_refusals_of_own_agents_are_reported_in_spite_of_strangers() -> None:
    told = Refusals()
    many_strangers(told, 0.0, 1000)
    news = told.news("node", "node:1", "'agent-1' has another version", 1.0, own=True)
    assert news == "'agent-1' has another version (node:1)"


def test_no_number_of_own_agents_keeps_one_out_or_takes_memory_without_end() -> None:
    told = Refusals()
    assert all(told.news("node", "node:1", f"agent {n}", 0.0, own=True) for n in range(1000))
    assert len(told._own) == acceptor._REMEMBERED
