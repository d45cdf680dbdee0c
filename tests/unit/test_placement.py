"""Choice of the agent that runs the next child, and the number of agents that this needs."""

from __future__ import annotations

import math
import random

import pytest

from fiber._engine.placement import LINGER, Demand, Placement

IDLE = 60.0


def with_agents(*agents: str, slots: float = 2, spread: bool = False) -> Placement[str, str]:
    placement: Placement[str, str] = Placement(slots, spread=spread)
    for number, agent in enumerate(agents):
        placement.add(agent, now=float(number))
    return placement


def put(placement: Placement[str, str], *children: str) -> list[str]:
    """The agents that these get, one after the other."""
    agents = []
    for child in children:
        placement.wait(child)
        if (placed := placement.place()) is not None:
            assert placed[0] == child
            agents.append(placed[1])
    return agents


def test_children_wait_in_order_until_an_agent_has_room() -> None:
    placement = with_agents(slots=1)
    assert put(placement, "first", "second") == []
    placement.add("a", now=0)
    assert placement.place() == ("first", "a")
    assert placement.place() is None
    placement.ended("a", now=1)
    assert placement.place() == ("second", "a")


def test_a_child_that_left_the_queue_gets_no_agent() -> None:
    placement = with_agents()
    put(placement, "first", "second")
    assert placement.leave("first")
    assert not placement.leave("first")
    placement.add("a", now=0)
    assert placement.place() == ("second", "a")
    assert placement.place() is None


def test_spread_children_go_to_the_agent_with_the_fewest() -> None:
    placement = with_agents("a", "b", slots=math.inf, spread=True)
    assert put(placement, *"12345") == ["a", "b", "a", "b", "a"]
    assert placement.room == math.inf


def take_all(placement: Placement[str, str], *children: str) -> list[tuple[str, str]]:
    """Have these wait; all that are placed."""
    for child in children:
        placement.wait(child)
    return list(iter(placement.place, None))


def test_agents_that_are_expected_are_left_their_share() -> None:
    placement = with_agents("a", slots=math.inf, spread=True)
    placement.expected = 1
    assert take_all(placement, *"1234") == [("1", "a"), ("2", "a")]
    placement.add("b", now=1)
    placement.expected = 0
    assert take_all(placement) == [("3", "b"), ("4", "b")]


def test_children_do_not_wait_for_an_agent_that_is_given_up() -> None:
    placement = with_agents("a", slots=math.inf, spread=True)
    placement.expected = 3
    assert take_all(placement, *"1234") == [("1", "a")]
    placement.expected = 0
    assert take_all(placement) == [("2", "a"), ("3", "a"), ("4", "a")]


def test_packed_children_leave_agents_idle_and_those_that_are_idle_longest_stay_so() -> None:
    placement = with_agents("a", "b", "c")
    assert put(placement, *"123") == ["c", "c", "b"]
    assert list(placement.idle) == ["a"]
    assert placement.room == 3


def test_a_silent_agent_gets_no_child_until_it_answers() -> None:
    placement = with_agents("a", slots=2)
    placement.withhold("a", "silent")
    assert put(placement, "1") == []
    assert placement.room == 0
    placement.restore("a", "silent")
    assert placement.place() == ("1", "a")
    placement.withhold("a", "silent")
    placement.ended("a", now=5)
    assert put(placement, "2") == []
    placement.remove("a")
    assert placement.children == 0


def test_an_agent_that_was_withheld_for_two_reasons_gets_no_child_until_both_end() -> None:
    placement = with_agents("a", slots=2)
    placement.withhold("a", "ending")
    placement.withhold("a", "silent")
    placement.restore("a", "silent")
    assert put(placement, "1") == []
    placement.restore("a", "ending")
    assert placement.place() == ("1", "a")
    placement.restore("a", "ending")  # which it was not
    assert placement.room == 1


def test_counts_are_those_of_a_recount_whatever_happens() -> None:
    rng = random.Random(9)
    placement = with_agents("0", slots=3)
    running: dict[str, list[str]] = {"0": []}
    withheld: set[str] = set()
    for step in range(3000):
        event = rng.choice(("wait", "wait", "place", "ended", "add", "remove", "silent", "heard"))
        agent = rng.choice(list(running)) if running else None
        if event == "wait":
            placement.wait(f"child {step}")
        elif event == "place" and (placed := placement.place()) is not None:
            assert placed[1] not in withheld
            running[placed[1]].append(placed[0])
        elif event == "add":
            placement.add(str(step), now=step)
            running[str(step)] = []
        elif agent is not None and event == "ended" and running[agent]:
            running[agent].pop()
            placement.ended(agent, now=step)
        elif agent is not None and event == "remove":
            del running[agent]
            withheld.discard(agent)
            placement.remove(agent)
        elif agent is not None and event == "silent":
            withheld.add(agent)
            placement.withhold(agent, "silent")
        elif agent is not None and event == "heard":
            withheld.discard(agent)
            placement.restore(agent, "silent")
        assert placement.children == sum(map(len, running.values()))
        assert set(placement.idle) == {agent for agent in running if not running[agent]}
        assert list(placement.idle.values()) == sorted(placement.idle.values())
        assert placement.room == sum(
            3 - len(children) for agent, children in running.items() if agent not in withheld
        )


# How many agents are wanted


def demand(
    placement: Placement[str, str], maximum: int = 1000, idle_timeout: float = IDLE
) -> Demand:
    return Demand(placement, maximum=maximum, idle_timeout=idle_timeout)


def test_the_demand_has_room_for_all_waiting_children() -> None:
    placement = with_agents(slots=8)
    wanted = demand(placement)
    assert wanted.decide(now=0).agents == 0
    put(placement, *(f"{number}" for number in range(17)))
    assert wanted.decide(now=0).agents == 3


def test_never_more_than_the_maximum() -> None:
    placement = with_agents(slots=1)
    put(placement, *"12345")
    assert demand(placement, maximum=3).decide(now=0).agents == 3


def test_an_idle_agent_is_released_by_name_after_the_timeout_and_gets_no_child() -> None:
    placement = with_agents("a", "b", slots=1)  # idle since 0 and 1
    wanted = demand(placement)
    wish = wanted.decide(now=2)
    assert (wish.agents, wish.release, wish.wake_at) == (2, [], IDLE)
    wish = wanted.decide(now=IDLE)
    assert (wish.agents, wish.release, wish.wake_at) == (1, ["a"], IDLE + 1)
    assert put(placement, "child", "another") == ["b"]
    assert wanted.decide(now=IDLE).agents == 2


def test_an_agent_with_a_child_is_not_released() -> None:
    placement = with_agents("a", slots=1)
    put(placement, "child")
    wish = demand(placement).decide(now=1e9)
    assert (wish.agents, wish.release, wish.wake_at) == (1, [], math.inf)


def test_a_worker_that_is_started_again_does_not_change_the_demand() -> None:
    placement = with_agents("a", "b", slots=1)
    wanted = demand(placement)
    put(placement, "1", "2")
    assert wanted.decide(now=0).agents == 2
    placement.remove("a")  # its pod is gone
    wish = wanted.decide(now=1)
    assert (wish.agents, wish.wake_at) == (2, 1 + LINGER)
    placement.wait("1 again")
    assert wanted.decide(now=1.1).agents == 2


@pytest.mark.parametrize(("idle_timeout", "linger"), [(IDLE, LINGER), (LINGER / 2, LINGER / 2)])
def test_agents_that_have_not_joined_are_given_up_after_a_time_without_waiting_children(
    idle_timeout: float, linger: float
) -> None:
    placement = with_agents(slots=1)
    wanted = demand(placement, idle_timeout=idle_timeout)
    put(placement, *"123")
    assert wanted.decide(now=0).agents == 3
    for child in "123":
        placement.leave(child)
    assert wanted.decide(now=1).agents == 3
    assert wanted.decide(now=1 + linger).agents == 0


def test_agents_of_the_floor_stay_and_are_not_part_of_the_demand() -> None:
    placement = with_agents("a", "b", slots=1)
    wanted = Demand(placement, floor=1, maximum=9, idle_timeout=IDLE)
    wish = wanted.decide(now=1e9)
    assert (wish.agents, wish.release, wish.wake_at) == (0, ["a"], math.inf)
    assert put(placement, "child") == ["b"]
    assert wanted.decide(now=2e9).agents == 1
    placement.ended("b", now=3e9)
    wanted.floor = 0
    assert wanted.decide(now=4e9).release == ["b"]


def test_a_retired_agent_is_released_when_its_child_has_ended() -> None:
    placement = with_agents("a", slots=2)
    wanted = Demand(placement, floor=1, maximum=9, idle_timeout=IDLE)
    assert put(placement, "child") == ["a"]
    wanted.retire("a")
    assert put(placement, "another") == []
    wish = wanted.decide(now=0)
    assert (wish.agents, wish.release) == (2, [])
    placement.ended("a", now=1)
    assert wanted.decide(now=1).release == ["a"]
    assert wanted.decide(now=1 + LINGER).agents == 1  # for the one that waits


@pytest.mark.slow
def test_the_cost_of_a_child_does_not_grow_with_their_number() -> None:
    many = 150_000
    placement = with_agents(*map(str, range(many)), slots=1)
    for child in range(many):
        placement.wait(str(child))
    placed = [placement.place() for _ in range(many)]
    for agent in map(str, range(many)):
        placement.ended(agent, now=1.0)
    for _ in range(many):
        placement.remove(next(iter(placement.idle)))
    assert len({pair[1] for pair in placed if pair is not None}) == many
    assert not placement.loads
