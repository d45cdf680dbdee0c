"""A template of which no worker was ever Ready is tried out by a few of them."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from fakes import virtual_time
from fakes.store import Body
from fakes.world import NAMESPACE, a_world
from unit.operator_objects import (
    NOW,
    ended,
    make_pool,
    name_of,
    of_template,
    plan_of,
    running,
    unschedulable,
    waiting,
    with_plan,
)

Json = dict[str, Any]


def pulling(numbers: range, *, age: float) -> list[Json]:
    """Workers whose image is on its way."""
    return [waiting(number, "ContainerCreating", age=age) for number in numbers]


def test_three_pods_try_out_a_template_that_never_worked() -> None:
    pool = make_pool(replicas=100)
    assert plan_of(pool).create == 3
    assert plan_of(pool, running(1, age=4), *pulling(range(2, 4), age=4)).create == 97


def test_canaries_on_their_way_are_joined_by_as_many_again_and_again() -> None:
    pool = make_pool(replicas=20)
    three = pulling(range(3), age=29)
    made = plan_of(pool, *three)
    assert (made.create, made.requeue_at) == (0, NOW + 1)
    assert plan_of(pool, *three, now=NOW + 1).create == 3
    six = [*pulling(range(3), age=59), *pulling(range(3, 6), age=29)]
    made = plan_of(pool, *six)
    assert (made.create, made.requeue_at) == (0, NOW + 1)
    assert plan_of(pool, *six, now=NOW + 1).create == 6
    assert plan_of(pool, *pulling(range(12), age=31)).create == 8


@pytest.mark.parametrize(
    ("first", "created"),
    [
        (waiting(1, "ErrImagePull", age=5000), 0),
        (waiting(1, "CreateContainerConfigError", age=5000), 0),
        (ended(1, ran=4990), 1),
    ],
)
def test_canaries_stay_few_while_one_is_in_trouble(first: Json, created: int) -> None:
    pool = make_pool(replicas=100, failurePolicy={"startupTimeoutSeconds": 86_400})
    pods = [first, *pulling(range(2, 4), age=5000)]
    seen = with_plan(pool, plan_of(pool, *pods))
    later = plan_of(seen, *pods, now=NOW + 60)
    assert (later.create, later.delete) == (created, ())


def test_canaries_whose_events_complain_stay_few() -> None:
    pool = make_pool(replicas=100)
    said = {name_of(1): "FailedMount: secret not found"}
    assert plan_of(pool, *pulling(range(1, 4), age=800), warnings=said).create == 0
    assert plan_of(pool, *pulling(range(1, 4), age=800), warnings={name_of(1): ""}).create == 3


def test_an_autoscaler_sees_the_whole_demand_of_a_template_that_never_worked() -> None:
    pool = make_pool(replicas=100)
    there = 3
    for _ in range(6):
        there += plan_of(pool, *map(unschedulable, range(there))).create
    assert there == 100
    # As many as found a node count, and those whose node is not known yet.
    mixed = [*map(unschedulable, range(4)), *pulling(range(10, 13), age=5)]
    assert plan_of(pool, *mixed).create == 1
    stuck = waiting(20, "ErrImagePull", age=50)
    assert plan_of(pool, *map(unschedulable, range(4)), stuck).create == 0


def test_a_warm_pool_gets_few_of_a_template_that_never_worked() -> None:
    pool = make_pool(replicas=80)
    old = [of_template("older", running(number)) for number in range(80)]
    first = plan_of(pool, *old)
    assert (len(first.delete), first.create) == (3, 3)
    assert plan_of(pool, *old[3:], *pulling(range(80, 83), age=40)).delete == ()


async def _pods_while_images_are_pulled(
    seconds: float, *, fails: bool, until: tuple[float, ...]
) -> list[int]:
    """Return how many pods of 300 there are at these times, if each pull takes so long."""
    async with a_world() as world:
        kubelet, loop = world.kubelet, asyncio.get_running_loop()

        def pulled(name: str) -> None:
            if fails:
                kubelet.waiting(NAMESPACE, name, "ErrImagePull", "i/o timeout")
            else:
                kubelet.ready(NAMESPACE, name)

        def created(plural: str, body: Body) -> None:
            if plural == "pods":
                name = body["metadata"]["name"]
                kubelet.waiting(NAMESPACE, name, "ContainerCreating")
                loop.call_later(seconds, pulled, name)

        world.store.created = created
        world.make_pool(replicas=300)
        await world.until(lambda: bool(world.pods()))
        counts, begin = [], loop.time()
        for time in until:
            await asyncio.sleep(begin + time - loop.time())
            counts.append(len(world.pods()))
        return counts


def test_a_registry_that_times_out_sees_three_pods() -> None:
    found = virtual_time.run(_pods_while_images_are_pulled(20, fails=True, until=(10, 60, 600)))
    assert found == [3, 3, 3]


def test_a_large_image_holds_a_healthy_template_up_no_longer_than_its_first_pull() -> None:
    times = (25, 45, 80, 99, 115)
    found = virtual_time.run(_pods_while_images_are_pulled(100, fails=False, until=times))
    assert found == [3, 6, 12, 24, 300]
