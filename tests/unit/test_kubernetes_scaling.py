"""Demands on their way into a pool: paced, coalesced, tried again."""

from __future__ import annotations

import math
from typing import Any

import pytest

from fiber._backends.kubernetes.fiber_pool import PATCH_INTERVAL, REFUSED, Scaling
from fiber.errors import FiberPoolError
from fiber_api import names
from fiber_api.rest import (
    ApiError,
    Conflict,
    Forbidden,
    Invalid,
    ServerError,
    ServerUnreachable,
    TooManyRequests,
    Unauthorized,
)


class Pool:
    """Takes what is written, unless something is to go wrong."""

    def __init__(self) -> None:
        self.written: list[tuple[int, list[str]]] = []
        self.failures: list[ApiError] = []
        self.lost: FiberPoolError | None = None

    def apply(self, replicas: int, release: list[str], timeout: float) -> None:
        assert timeout <= PATCH_INTERVAL
        if self.failures:
            raise self.failures.pop(0)
        self.written.append((replicas, release))

    def check(self) -> None:
        if self.lost:
            raise self.lost


class Case:
    def __init__(self) -> None:
        self.now = 100.0
        self.pool: Any = Pool()
        self.troubles: list[ApiError] = []
        self.scaling = Scaling(self.troubles.append, lambda: self.now)

    def want(self, replicas: int, *release: str) -> None:
        self.scaling.want(replicas, release)

    def step(self, after: float = 0.0) -> float:
        self.now += after
        return self.scaling.step(self.pool)


@pytest.fixture
def case() -> Case:
    return Case()


def test_without_a_demand_no_patch_is_written(case: Case) -> None:
    assert case.step() == math.inf
    assert case.pool.written == []


def test_the_first_is_written_at_once_and_the_next_a_second_later(case: Case) -> None:
    case.want(1)
    assert case.step() == PATCH_INTERVAL
    case.want(2)
    case.want(3)
    assert case.step(0.25) == pytest.approx(PATCH_INTERVAL - 0.25)
    case.step(PATCH_INTERVAL)
    assert case.pool.written == [(1, []), (3, [])]
    assert case.step(PATCH_INTERVAL) == math.inf


def test_names_are_kept_until_their_pods_are_gone(case: Case) -> None:
    case.want(2, "a", "b")
    case.step()
    assert not case.scaling.gone("a")
    case.want(1, "c")
    case.step(PATCH_INTERVAL)
    assert case.pool.written == [(2, ["a", "b"]), (1, ["b", "c"])]


def test_a_pod_that_is_gone_already_is_not_released(case: Case) -> None:
    case.scaling.gone("a")
    case.want(1, "a")
    case.step()
    assert case.pool.written == [(1, [])]


def test_more_names_than_one_patch_may_have_wait_for_room(case: Case) -> None:
    everyone = [f"pod-{number}" for number in range(names.MAX_RELEASE + 1)]
    case.want(0, *everyone)
    case.step()
    assert case.pool.written[-1] == (0, everyone[:-1])
    assert case.scaling.gone(everyone[0])
    case.step(PATCH_INTERVAL)
    assert case.pool.written[-1] == (0, everyone[1:])


def test_a_failed_patch_is_tried_again_with_growing_pauses_and_the_newest_demand(
    case: Case,
) -> None:
    case.pool.failures = [ServerUnreachable("down") for _ in range(8)]
    case.want(1)
    pauses = [case.step()]
    case.want(5)
    while case.pool.failures:
        pauses.append(case.step(pauses[-1]))
    assert pauses == sorted(pauses)
    assert pauses[-1] <= 5
    case.step(pauses[-1])
    assert case.pool.written == [(5, [])]
    assert len(case.troubles) == 8


@pytest.mark.parametrize("kind", [Forbidden, Unauthorized])
def test_refusals_are_retried_for_a_limited_time(case: Case, kind: type[ApiError]) -> None:
    case.pool.failures = [kind("no") for _ in range(99)]
    case.want(1)
    started = case.now

    def try_for_ever() -> None:
        pause = 0.0
        while True:
            pause = case.step(pause)

    with pytest.raises(kind):
        try_for_ever()
    assert REFUSED <= case.now - started <= REFUSED + 5


def test_an_api_that_is_gone_is_waited_for(case: Case) -> None:
    case.pool.failures = [ServerUnreachable("down") for _ in range(50)]
    case.want(1)
    pause = case.step()
    while not case.pool.written:
        pause = case.step(pause)
    assert case.now - 100 > 2 * REFUSED


def test_a_permanently_refused_demand_is_raised(case: Case) -> None:
    case.pool.failures = [Invalid("too many")]
    case.want(1)
    with pytest.raises(Invalid):
        case.step()


@pytest.mark.parametrize("failure", [Invalid("epoch"), Conflict("uid")])
def test_a_pool_that_was_lost_is_why(case: Case, failure: ApiError) -> None:
    case.pool.failures = [failure]
    case.pool.lost = FiberPoolError("lost", pool="es-1", namespace="lab", reason="Replaced")
    case.want(1)
    with pytest.raises(FiberPoolError, match="lost"):
        case.step()


def test_a_retry_after_is_respected(case: Case) -> None:
    case.pool.failures = [TooManyRequests("busy", retry_after=12.0), ServerError("no leader")]
    case.want(1)
    assert case.step() == 12
    assert case.step(12) < 12
