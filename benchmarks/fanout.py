"""A large blob on its way to many agents: `python -m benchmarks.fanout`.

First come real links: 200 agents in four processes on this machine. They show what the master
sends; on one machine its line is no limit, so the times say little. Then comes the simulation of a
network in which each host has a line of 1 Gbit/s. Each is shown with agents that pass the blob on,
and with a master that sends all copies.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import threading
import time
from typing import NamedTuple

from benchmarks.fake_cluster import FakeCluster, joined_cluster
from benchmarks.fanout_model import Network

from fiber._backends.blobs import BlobSender, Fanout
from fiber._wire.blob_messages import Holding
from fiber._wire.memory_files import Blob

BUDGET = 5
"""Copies that the master may send."""

MB, GIGABIT = 10**6, 125e6
SIZE = 50 * MB
_TIMEOUT = 300.0


class Figures(NamedTuple):
    """Copies that the master sent, and seconds until all agents had one."""

    copies: float
    seconds: float


class _CountingFanout(Fanout):
    """Fanout that notes when all agents have the blob."""

    def __init__(self, agents: int, *, passing_on: bool) -> None:
        super().__init__(port=0)
        self._reachable = passing_on
        self._missing = agents
        self.complete = threading.Event()

    def holding(self, agent: BlobSender, message: Holding) -> None:
        """Count an agent that has the blob."""
        super().holding(agent, message)
        self._missing -= 1
        if not self._missing:
            self.complete.set()


def main(arguments: list[str] | None = None) -> int:
    """Print the figures; return 0 if the budget is kept."""
    parser = argparse.ArgumentParser("benchmarks.fanout", description=__doc__)
    parser.add_argument("--agents", type=int, default=200, help="agents with real links")
    parser.add_argument("--size", type=int, default=5 * MB, help="bytes of their blob")
    parser.add_argument("--simulated", type=int, default=1000, help="simulated agents")
    chosen = parser.parse_args(arguments)
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")
    print(f"real links, {chosen.agents} agents, {chosen.size / MB:g} MB")
    spread = measure(chosen.agents, chosen.size, passing_on=True)
    _show("agents pass it on", spread)
    _show("the master sends all", measure(chosen.agents, chosen.size, passing_on=False))
    worst = spread.copies
    for agents in (chosen.agents, chosen.simulated):
        print(f"simulation, {agents} agents, {SIZE / MB:g} MB, 1 Gbit/s for each host")
        deaths = _deaths(agents)
        for label, outcome in (
            ("agents pass it on", Network(agents, SIZE, GIGABIT).run()),
            (f"{len(deaths)} of them die", Network(agents, SIZE, GIGABIT, deaths=deaths).run()),
        ):
            worst = max(worst, outcome.copies)
            _show(label, Figures(outcome.copies, outcome.seconds))
        alone = Network(agents, SIZE, GIGABIT, passing_on=False).run()
        _show("the master sends all", Figures(alone.copies, alone.seconds))
    print(f"most copies of the master: {worst:.1f} (budget {BUDGET})")
    return int(worst > BUDGET)


def measure(agents: int, size: int, *, passing_on: bool) -> Figures:
    """Bring a blob to so many agents with real links."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    fanout = _CountingFanout(agents, passing_on=passing_on)
    blob = Blob(os.urandom(size))
    with joined_cluster(agents, fanout=fanout) as cluster:
        before = _sent(cluster)
        began = time.perf_counter()
        for agent in cluster.agents:
            agent.loop.call_soon(agent._blobs.send_missing, [blob], lambda: None)
        if not fanout.complete.wait(_TIMEOUT):
            raise TimeoutError(f"{fanout._missing} of {agents} agents did not get the blob")
        seconds = time.perf_counter() - began
        return Figures((_sent(cluster) - before) / size, seconds)


def _sent(cluster: FakeCluster) -> int:
    return sum(agent._link.statistics().bytes_sent for agent in cluster.agents)


def _deaths(agents: int) -> dict[int, float]:
    """Return a tenth of the agents, and the moments at which they die."""
    rng = random.Random(1)
    return {agent: rng.uniform(0, 5) for agent in rng.sample(range(agents), agents // 10)}


def _show(label: str, figures: Figures) -> None:
    print(f"  {label:24}{figures.copies:8.1f} copies {figures.seconds:8.1f} s")


if __name__ == "__main__":
    raise SystemExit(main())
