"""An operator that cannot watch says so, and which right it lacks."""

from __future__ import annotations

import asyncio
import logging

import aiohttp
import pytest

from fakes.kubernetes_api import Fault
from fakes.world import World, a_world, configuration
from fiber_api.rest import Forbidden, ServerUnreachable
from fiber_operator.cluster import Configuration
from fiber_operator.health import WatchStatus
from fiber_operator.process import OperatorProcess
from fiber_operator.settings import OperatorSettings
from patience import PATIENCE

SAID = 'pods is forbidden: User "operator" cannot watch resource "pods" at the cluster scope'
REFUSED = Forbidden(SAID, what="watch pods", status=403, reason="Forbidden")


def all_well(*namespaces: str) -> WatchStatus:
    watches = WatchStatus(namespaces)
    watches.started(True)
    for where in [f" in {namespace}" for namespace in namespaces] or [""]:
        for plural in ("fiberpools", "pods", "leases"):
            watches.answered(f"list {plural}{where}", None)
            watches.answered(f"watch {plural}{where}", None)
    return watches


def test_watches_that_are_open_are_well() -> None:
    assert all_well().problems() == all_well("one", "two").problems() == []


def test_each_watch_must_have_begun() -> None:
    watches = WatchStatus(["one"])
    assert watches.problems() == ["kopf does not run: changes are seen late"]
    watches.started(True)
    watches.answered("list pods in one", None)
    watches.answered("watch pods in one", None)
    watches.answered("watch leases in one", None)
    (said,) = watches.problems()
    assert said == "changes are seen late: watch fiberpools in one has not begun yet"


def test_a_restart_of_kopf_reopens_its_watches_but_not_the_informers() -> None:
    watches = all_well()
    watches.started(False)
    watches.started(True)
    assert watches.problems() == [
        "changes are seen late: watch fiberpools has not begun yet",
        "changes are seen late: watch leases has not begun yet",
    ]


def test_a_missing_right_is_named_until_it_is_there(caplog: pytest.LogCaptureFixture) -> None:
    watches = all_well()
    with caplog.at_level(logging.INFO):
        for _ in range(5):
            watches.answered("watch pods", REFUSED)
        (said,) = watches.problems()
        assert said == (
            f"changes are not seen: watch pods: {SAID}. Give the operator's account this right: "
            "the chart's roles have it"
        )
        watches.answered("watch pods", None)
    assert watches.problems() == []
    assert caplog.messages == [said, "watch pods works again"]


def test_other_failures_are_reported_too() -> None:
    watches = all_well()
    watches.answered("list pods", ServerUnreachable("too busy", what="list pods", status=500))
    assert watches.problems() == ["changes are not seen: list pods: too busy"]


@pytest.mark.parametrize("verb", ["list", "watch"])
def test_an_operator_that_must_not_watch_pods_is_not_ready(verb: str) -> None:
    """The whole program with kopf in its thread, in real time."""

    async def main() -> None:
        async with a_world(operator=False) as world:
            message = f'pods is forbidden: User "operator" cannot {verb} resource "pods"'
            denied = Fault(verb, "pods", status=403, message=message, times=10**6)
            world.api.faults.append(denied)
            stop = asyncio.Event()

            async def configure() -> Configuration:
                return configuration(world.api)

            settings = OperatorSettings(host="127.0.0.1", port=0, identity="operator-1")
            program = OperatorProcess(settings, configure=configure, now=world.store.unix_now)
            task = asyncio.ensure_future(program.run(stop))
            said = f"changes are not seen: {verb} pods: {message}. Give the operator's account"
            await until(world, program, said)
            assert (await ask(program))[0] == 503
            denied.times = 0
            await until(world, program, "ok")
            assert (await ask(program))[0] == 200
            stop.set()
            await task

    asyncio.run(main())


async def ask(program: OperatorProcess) -> tuple[int, str]:
    url = f"http://127.0.0.1:{program.port}/readyz"
    async with aiohttp.ClientSession() as session, session.get(url) as response:
        return response.status, await response.text()


async def until(world: World, program: OperatorProcess, said: str) -> None:
    """Wait until /readyz says so."""
    await world.until(lambda: bool(program.port), within=PATIENCE)
    async with asyncio.timeout(PATIENCE):
        while said not in (await ask(program))[1]:
            await asyncio.sleep(0.05)
