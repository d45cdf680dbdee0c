"""A cluster in this process, in real time: the API, the operator, nodes that run real agents."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import pytest

from fakes.agent_kubelet import AgentKubelet
from fakes.store import Body
from fakes.world import World, a_world
from patience import PATIENCE

T = TypeVar("T")


class FakeCluster:
    """``world`` and ``nodes``, which only ``do`` may touch."""

    def __init__(self, world: World, nodes: AgentKubelet, loop: asyncio.AbstractEventLoop) -> None:
        self.world = world
        self.nodes = nodes
        self._loop = loop

    @property
    def url(self) -> str:
        return self.world.api.url

    def do(self, function: Callable[..., T], *arguments: object) -> T:
        """Call it on the cluster's thread."""

        async def call() -> T:
            return function(*arguments)

        return asyncio.run_coroutine_threadsafe(call(), self._loop).result(PATIENCE)

    def take_forced(self) -> list[str]:
        """Return the pods whose agents had to be killed since the last call."""

        def take() -> list[str]:
            forced, self.nodes.forced = self.nodes.forced, []
            return forced

        return self.do(take)

    def objects(self, plural: str) -> list[Body]:
        """Return the existing ones in all namespaces."""
        return self.do(self.world.store.list, plural)

    def wait(self, condition: Callable[[], object]) -> None:
        """Wait until it holds on the cluster's thread."""
        until = self.world.until(lambda: bool(condition()), PATIENCE)
        asyncio.run_coroutine_threadsafe(until, self._loop).result(2 * PATIENCE)


IMAGE = "registry.example/worker:1"
"""Image of workers, which nothing pulls."""


@contextlib.contextmanager
def fake_cluster(**settings: Any) -> Iterator[FakeCluster]:
    """Make a new cluster with only an operator, which has these settings.

    Programs name an image for their workers, as those of a development build must.
    """
    started: concurrent.futures.Future[FakeCluster] = concurrent.futures.Future()
    end = asyncio.Event()

    async def serve() -> None:
        async with a_world(**settings) as world:
            world.store.follow_the_machine()
            nodes = AgentKubelet(world.store)
            started.set_result(FakeCluster(world, nodes, asyncio.get_running_loop()))
            await end.wait()
            await nodes.close()

    thread = threading.Thread(target=asyncio.run, args=(serve(),), name="fake cluster")
    thread.start()
    try:
        cluster = started.result(PATIENCE)
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("FIBER_IMAGE", IMAGE)
            yield cluster
    finally:
        cluster.do(end.set)
        thread.join()
