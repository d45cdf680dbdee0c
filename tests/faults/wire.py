"""A loopback runtime whose agents reach it through a proxy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

import fiber
from faults import targets
from faults.program import wait_for
from faults.proxy import Proxy
from faults.runtime import running
from fiber._backends.loopback import LoopbackBackend


class Wire:
    """A loopback runtime whose agents reach it through a proxy."""

    def __init__(self, proxy: Proxy, backend: LoopbackBackend) -> None:
        self.proxy = proxy
        self.backend = backend

    def agents(self) -> list[str]:
        return [slot.name for slot in self.backend._slots]

    def agent_pid(self) -> int:
        """Return the id of the agent's process, once it has joined."""
        wait_for(lambda: list(self.backend.agents.agents) == self.agents())
        pid = self.backend._slots[0].process.pid
        assert pid is not None
        return pid

    def cut(self) -> None:
        """Break the connection, and return once there is another one."""
        before = self.proxy.connections
        self.proxy.sever()
        self.proxy.heal()
        wait_for(lambda: self.proxy.connections > before)

    def start(self, target: Any = targets.block, *args: Any) -> Any:
        child = fiber.Process(target=target, args=args)
        child.start()
        return child


@contextmanager
def wired(monkeypatch: pytest.MonkeyPatch, lost_after: float) -> Iterator[Wire]:
    """Run one agent, which is lost after so many seconds of silence."""
    original = LoopbackBackend._environment
    proxies: list[Proxy] = []

    def through_the_proxy(backend: LoopbackBackend, name: str) -> dict[str, str]:
        environment = original(backend, name)
        if not proxies:
            proxies.append(Proxy(environment["FIBER_AGENT_ADDRESS"]).__enter__())
        return {**environment, "FIBER_AGENT_ADDRESS": proxies[0].address}

    monkeypatch.setattr(LoopbackBackend, "_environment", through_the_proxy)
    settings = {"heartbeat_interval": 0.2, "suspect_after": 0.7, "lost_after": lost_after}
    try:
        with running(backend="loopback", agents=1, **settings) as runtime:
            assert isinstance(runtime.backend, LoopbackBackend)
            yield Wire(proxies[0], runtime.backend)
    finally:
        for proxy in proxies:
            proxy.__exit__(None, None, None)
