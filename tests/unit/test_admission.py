"""Admission of connections that wait."""

from __future__ import annotations

from fiber._transport.acceptor import Admission, AdmissionDecision

IN, OUT = AdmissionDecision(True), AdmissionDecision(False)


def test_a_newcomer_beyond_the_bound_for_its_address_waits_its_turn() -> None:
    door = Admission(total=10, per_address=2)
    assert door.enter("a", "1.1.1.1", 0.0) == IN
    assert door.enter("b", "1.1.1.1", 0.5) == IN
    assert door.enter("c", "1.1.1.1", 0.9) == OUT
    assert door.enter("d", "2.2.2.2", 0.9) == IN, "who comes from elsewhere is not concerned"


def test_a_client_that_had_a_fair_chance_makes_room() -> None:
    door = Admission(total=10, per_address=2)
    door.enter("a", "1.1.1.1", 0.0)
    door.enter("b", "1.1.1.1", 0.5)
    assert door.enter("c", "1.1.1.1", 1.0) == AdmissionDecision(True, "a")
    assert door.enter("d", "1.1.1.1", 1.2) == OUT
    assert len(door) == 2


def test_when_all_is_full_the_address_with_the_most_makes_room() -> None:
    door = Admission(total=3, per_address=3)
    door.enter("honest", "2.2.2.2", 0.0)
    door.enter("a", "1.1.1.1", 0.1)
    door.enter("b", "1.1.1.1", 0.2)
    assert door.enter("c", "3.3.3.3", 5.0) == AdmissionDecision(True, "a")
    assert door.enter("d", "4.4.4.4", 5.0) == AdmissionDecision(True, "honest"), (
        "of equals, the oldest"
    )


def test_a_client_that_leaves_makes_room() -> None:
    door = Admission(total=1, per_address=1)
    door.enter("a", "1.1.1.1", 0.0)
    door.leave("a")
    door.leave("a")
    assert len(door) == 0
    assert door.enter("b", "1.1.1.1", 0.0) == IN


def test_a_flood_from_everywhere_is_bounded() -> None:
    door = Admission(total=64, per_address=32)
    for number in range(10_000):
        door.enter(number, f"10.0.{number % 256}.1", number / 1000)
        assert len(door) <= 64
