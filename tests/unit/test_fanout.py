"""Plan by which a blob reaches many agents: who serves whom, and what happens when agents fail."""

from __future__ import annotations

import random
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber._engine.fanout import COPIES, TRIES, UNREACHABLE, WIDTH, Spread, Transfer

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.fanout_model import Network

MB, GIGABIT = 10**6, 125e6


class Site:
    """Agents of one plan, with the orders that are in force."""

    def __init__(self, agents: int, **options: Any) -> None:
        self.retired: set[int] = set()
        self.spread = Spread(retired=self.retired, **options)
        self.orders: dict[int, Transfer[int]] = {}
        self.have: set[int] = set()
        self.from_master = 0
        for agent in range(agents):
            self.obey(self.spread.want(agent))

    def obey(self, orders: list[Transfer[int]]) -> None:
        for order in orders:
            assert order.receiver not in self.have
            assert order.source is None or order.source in self.have
            self.orders[order.receiver] = order
            self.from_master += order.source is None

    def arrive(self, agent: int, *, serves: bool = True) -> None:
        number = self.orders.pop(agent).number
        self.have.add(agent)
        self.obey(self.spread.arrived(agent, number, serves=serves))

    def fail(self, agent: int) -> None:
        self.obey(self.spread.failed(agent, self.orders.pop(agent).number))

    def die(self, agent: int) -> None:
        self.have.discard(agent)
        self.orders = {
            receiver: order
            for receiver, order in self.orders.items()
            if agent not in (receiver, order.source)
        }
        self.obey(self.spread.gone(agent))

    def from_peers(self) -> list[int]:
        return [one for one, order in self.orders.items() if order.source is not None]

    def finish(self) -> None:
        """Let everything arrive."""
        while self.orders:
            self.arrive(next(iter(self.orders)))


def test_the_master_serves_a_few_and_they_serve_the_others() -> None:
    site = Site(200)
    assert len(site.orders) == WIDTH
    site.finish()
    assert site.have == set(range(200))
    assert site.from_master == COPIES
    assert site.spread.idle


def test_an_agent_that_comes_late_gets_it_from_another() -> None:
    site = Site(COPIES)
    site.finish()
    before = site.from_master
    site.obey(site.spread.want(99))
    assert site.orders[99].source in range(COPIES)
    assert site.from_master == before


def test_receivers_of_an_agent_that_dies_get_another_source() -> None:
    site = Site(20)
    while not site.from_peers():
        site.arrive(next(iter(site.orders)))
    receiver = site.from_peers()[0]
    dead = site.orders[receiver].source
    assert dead is not None
    site.die(dead)
    assert dead not in [order.source for order in site.orders.values()]
    site.finish()
    assert site.have == set(range(20)) - {dead}


def test_a_receiver_that_enough_agents_failed_is_served_by_the_master() -> None:
    site = Site(20)
    for _ in range(6):
        site.arrive(next(iter(site.orders)))
    site.arrive(site.from_peers()[0])  # agents reach each other
    unlucky = site.from_peers()[0]
    for _ in range(TRIES):
        assert site.orders[unlucky].source is not None
        site.fail(unlucky)
    assert site.orders[unlucky].source is None


def test_a_source_that_fails_two_receivers_serves_no_more() -> None:
    site = Site(40)
    for _ in range(8):
        site.arrive(next(iter(site.orders)))
    sources = [site.orders[one].source for one in site.from_peers()]
    bad = next(one for one in sources if sources.count(one) == WIDTH)
    for receiver in [one for one in site.from_peers() if site.orders[one].source == bad]:
        site.fail(receiver)
    known = {order.number for order in site.orders.values()}
    while site.orders:
        site.arrive(next(iter(site.orders)))
        new = [order for order in site.orders.values() if order.number not in known]
        assert bad not in [order.source for order in new]
    assert site.have == set(range(40))


def test_a_failure_that_was_replaced_changes_nothing() -> None:
    site = Site(3)
    (first, *_) = site.orders
    number = site.orders[first].number
    site.fail(first)
    assert site.spread.failed(first, number) == []


def test_where_no_agent_reaches_another_the_master_serves_all_at_once() -> None:
    site = Site(30)
    for _ in range(UNREACHABLE):
        while not site.from_peers():
            site.arrive(next(iter(site.orders)))
        site.fail(site.from_peers()[0])
    assert not site.spread.reachable
    for receiver in site.from_peers():  # those that were under way
        site.fail(receiver)
    assert {order.source for order in site.orders.values()} == {None}
    assert len(site.have) + len(site.orders) == 30


def test_where_no_agent_can_serve_the_master_serves_all() -> None:
    site = Site(30)
    for _ in range(UNREACHABLE):
        site.arrive(next(iter(site.orders)), serves=False)
    assert len(site.have) + len(site.orders) == 30


def test_without_passing_on_the_master_serves_all_at_once() -> None:
    assert len(Site(30, reachable=False).orders) == 30


def test_an_agent_that_will_end_serves_no_new_receiver() -> None:
    site = Site(20)
    first = next(iter(site.orders))
    site.arrive(first)
    site.retired.add(first)
    known = {order.number for order in site.orders.values()}
    while site.orders:
        site.arrive(next(reversed(site.orders)))
        new = [order for order in site.orders.values() if order.number not in known]
        assert first not in [order.source for order in new]
    assert site.have == set(range(20))


def test_an_agent_that_will_end_before_it_has_the_blob_serves_no_one() -> None:
    site = Site(20)
    first = next(iter(site.orders))
    site.retired.add(first)
    site.arrive(first)
    while site.orders:
        assert first not in [order.source for order in site.orders.values()]
        site.arrive(next(iter(site.orders)))
    assert site.spread.reachable


def test_a_report_of_an_order_that_was_replaced_changes_nothing() -> None:
    site = Site(3)
    (first, *_) = site.orders
    number = site.orders[first].number
    site.die(first)
    site.obey(site.spread.want(first))
    assert site.spread.arrived(first, number, serves=True) == []
    site.finish()
    assert site.have == set(range(3))


@given(st.integers(1, 40), st.integers(0, 2**32))
def test_every_agent_that_lives_gets_it_whatever_fails(agents: int, seed: int) -> None:
    site, rng, dead = Site(agents), random.Random(seed), set[int]()
    for _ in range(rng.randrange(4 * agents)):
        if not site.orders:
            break
        receiver = rng.choice(list(site.orders))
        kind = rng.random()
        if kind < 0.5:
            site.arrive(receiver, serves=rng.random() < 0.9)
        elif kind < 0.7 and site.orders[receiver].source is not None:
            site.fail(receiver)
        elif kind < 0.8:
            victim = rng.choice([*site.orders, *site.have])
            dead.add(victim)
            site.die(victim)
        else:
            site.retired.add(rng.choice([*site.orders, *site.have]))
        loads = [order.source for order in site.orders.values() if order.source is not None]
        assert all(loads.count(source) <= WIDTH for source in loads)
    site.finish()
    assert site.have == set(range(agents)) - dead
    assert site.spread.idle


def test_a_thousand_agents_cost_the_master_five_copies_at_most() -> None:
    tree = Network(1000, 50 * MB, GIGABIT).run()
    alone = Network(1000, 50 * MB, GIGABIT, passing_on=False).run()
    assert tree.arrived == alone.arrived == set(range(1000))
    assert tree.copies <= 5
    assert alone.copies == pytest.approx(1000)
    assert tree.seconds < alone.seconds / 20, "simulated seconds"


def test_agents_that_die_in_the_middle_are_gone_round() -> None:
    rng = random.Random(1)
    deaths = {agent: rng.uniform(0, 5) for agent in rng.sample(range(1000), 100)}
    outcome = Network(1000, 50 * MB, GIGABIT, deaths=deaths).run()
    assert outcome.arrived == set(range(1000)) - deaths.keys()
    assert outcome.copies <= 5
