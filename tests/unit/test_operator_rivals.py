"""Two operators of different releases in one namespace: both warn."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

import pytest

from fakes import virtual_time
from fakes.kubernetes_api import Fault
from fakes.world import NAMESPACE, World, a_world
from fiber_operator.process import OperatorProcess


@contextlib.asynccontextmanager
async def another_release(world: World) -> AsyncIterator[OperatorProcess]:
    program = world.another(
        host="127.0.0.1", port=0, identity="other-1", namespace="other-system", lease="other"
    )
    stop = asyncio.Event()
    running = asyncio.ensure_future(program.run(stop))
    await world.until(lambda: hasattr(program, "elector") and program.elector.is_leader)
    try:
        yield program
    finally:
        stop.set()
        await running


def warnings(world: World) -> list[str]:
    events = world.store.list("events", NAMESPACE)
    return [event["message"] for event in events if event["reason"] == "ServedTwice"]


def test_a_pool_that_two_operators_serve_has_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    async def test() -> None:
        async with a_world() as world, another_release(world):
            world.slow("create", "pods", 0.2)
            # One of the two is half a second behind, as no two programs are in step.
            world.api.faults.append(Fault("get", "fiberpools", late=0.5))
            world.make_pool(replicas=20)
            await world.until(lambda: bool(warnings(world)), within=60)
        (said, *_) = warnings(world)
        assert "Uninstall one of the two" in said
        assert said in caplog.messages

    virtual_time.run(test())


def test_the_next_process_of_one_release_gives_no_warning() -> None:
    async def test() -> None:
        async with a_world() as world:
            world.make_pool(replicas=2)
            await world.ready(2)
            for end in (world.stop, world.kill):
                await end()
                world.edit(replicas=world.status()["replicas"] + 1)
                world.start()
                await world.ready(world.status()["replicas"] + 1)
            await world.settled(120)
            assert warnings(world) == []

    virtual_time.run(test())
