"""Pods that follow the work: placement and demand under bursts, losses and late pods."""

from __future__ import annotations

import heapq
import itertools
import math
import random
from typing import Any

import pytest

from fiber._engine.placement import Demand, Placement

RELEASES = 1000
"""Number of scale-downs in each run, while other agents are at work."""

IDLE = 1.0


class Cluster:
    """An operator that keeps as many pods as wanted, and children that come in bursts."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.slots = self.rng.choice((1, 1, 2, 8))
        self.maximum = self.rng.choice((5, 50))
        self.placement: Placement[str, int] = Placement(self.slots, spread=False)
        self.demand = Demand(self.placement, maximum=self.maximum, idle_timeout=IDLE)
        self.now = 0.0
        self.running: dict[str, set[int]] = {}
        self.released: set[str] = set()
        self.coming = 0
        """Pods that were made and have not joined."""
        self.done: set[int] = set()
        self._asked: set[int] = set()
        self._events: list[tuple[float, int, str, Any]] = []
        self._order = itertools.count()
        self._pods = itertools.count()
        self._children = itertools.count()

    def later(self, seconds: float, what: str, of: Any = None) -> None:
        heapq.heappush(self._events, (self.now + seconds, next(self._order), what, of))

    def run(self) -> None:
        self.later(0.0, "burst")
        while self._events:
            self.now, _, what, of = heapq.heappop(self._events)
            getattr(self, what)(of)
            self._settle()
        assert self.done == self._asked, "children that never ran"
        assert (self.running, self.coming) == ({}, 0), "agents that were never let go"

    def burst(self, _: object) -> None:
        for _ in range(self.rng.randint(1, 3 * self.maximum)):
            child = next(self._children)
            self._asked.add(child)
            self.placement.wait(child)
        if len(self.released) < RELEASES:
            self.later(self.rng.expovariate(1 / 3), "burst")
            self.later(self.rng.expovariate(1 / 5), "crash")
            self.later(self.rng.expovariate(1 / 5), "silence")

    def join(self, _: object) -> None:
        if self.coming:  # otherwise the operator gave one up that had not begun
            self.coming -= 1
            pod = f"pod-{next(self._pods)}"
            self.running[pod] = set()
            self.placement.add(pod, self.now)

    def end(self, of: tuple[str, int]) -> None:
        pod, child = of
        if child in self.running.get(pod, ()):
            self.running[pod].remove(child)
            self.done.add(child)
            self.placement.ended(pod, self.now)

    def crash(self, _: object) -> None:
        pods = sorted(self.running.keys() - self.released)
        if pods:
            pod = self.rng.choice(pods)
            self.placement.remove(pod)
            for child in sorted(self.running.pop(pod)):
                self.placement.wait(child)  # its pool starts it again

    def silence(self, _: object) -> None:
        pods = sorted(self.running.keys() - self.released)
        if pods:
            pod = self.rng.choice(pods)
            self.placement.withhold(pod, "silent")
            self.later(self.rng.random(), "sound", pod)

    def sound(self, pod: str) -> None:
        if pod in self.running and pod not in self.released:
            self.placement.restore(pod, "silent")

    def wake(self, _: object) -> None:
        pass

    def _settle(self) -> None:
        while (placed := self.placement.place()) is not None:
            child, pod = placed
            assert pod not in self.released, "a child for an agent that was let go"
            self.running[pod].add(child)
            assert len(self.running[pod]) <= self.slots
            self.later(self.rng.expovariate(2.0), "end", (pod, child))
        wish = self.demand.decide(self.now)
        for pod in wish.release:
            assert not self.running[pod], "a busy agent was let go"
            self.released.add(pod)
            del self.running[pod]
        live = len(self.running) + self.coming
        assert wish.agents <= self.maximum
        if wish.agents > live:
            for _ in range(wish.agents - live):
                self.coming += 1
                self.later(self.rng.expovariate(1.0), "join")
        else:
            self.coming = max(0, wish.agents - len(self.running))
        if wish.wake_at < math.inf:
            self.later(max(wish.wake_at - self.now, 0.0) + 1e-6, "wake")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_thousand_scale_downs_lose_no_child_and_end_no_busy_agent(seed: int) -> None:
    cluster = Cluster(seed)
    cluster.run()
    assert len(cluster.released) >= RELEASES
