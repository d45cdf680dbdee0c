"""Many agents: links until all have joined, what each costs, and a map over all of them."""

from __future__ import annotations

import resource
from typing import TYPE_CHECKING, Any

from benchmarks import throughput
from benchmarks.model import BASELINE, Case, Metric, rounds_with
from benchmarks.tasks import no_op

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Many agents"
ABOUT = """\
As many agents as a large pool has pods, over links on the loopback interface.

* Real: the whole master (pool, scheduler, its view of the agents, listener). Each agent's link is
  real from dialling to the last frame, with handshake, encryption and answers to the master.
* Fake: the agents share four processes instead of having a process (and a host) each. Their
  children, one pool worker for each agent, are objects in these processes. They unpickle, run and
  answer their tasks by the code of a real worker, in turn.
* Master and agents share this machine's processors, which a thousand pods would not.

Joined: time from the order to dial, when the four processes have imported everything, until the
master has the last link; and the processor time that the master used meanwhile. Memory: growth of
the PSS of the master and of the agents' processes while all agents join, divided by the links.
Tasks a second: no-ops through `map` on a pool of as many workers, 100,000 in default chunks and
10,000 with chunksize 1, after all workers have done the same once. multiprocessing has as many
forked processes. The soft limit of open files is raised to the hard one."""

JOINED = Metric("joined", "joined", "s")
JOINING = Metric("joining", "processor time to join, master", "s")
MEMORY = Metric("memory", "memory a link, master", "B")
AGENT_MEMORY = Metric("agent memory", "memory a link, agent", "B")
DEFAULT = Metric("default chunks", "tasks a second, default chunks", "1/s")
SINGLE = Metric("chunksize 1", "tasks a second, chunksize 1", "1/s")
AGENTS = (64, 256, 1024)
_MAPS = ((DEFAULT, 100_000, None), (SINGLE, 10_000, 1))
_SMALLEST = 8


def agents(count: int) -> str:
    """Return the name of the case with `count` agents."""
    return f"{count:,} agents"


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, fewer tasks, and agents in the same measure."""
    return [
        Case(
            measure="agents",
            name=agents(n),
            group="agents",
            needs="agents",
            params={"agents": max(_SMALLEST, round(n * min(1.0, 4 * size))), "size": size},
            metrics=(JOINED, JOINING, MEMORY, AGENT_MEMORY, DEFAULT, SINGLE),
            limit=120.0,
            fresh=True,
            rounds=rounds_with(n),
        )
        for n in AGENTS
    ]


def run(bench: Bench, agents: int, size: float) -> dict[str, float]:
    """Measure what the links cost, if the contender has links, and how fast no-ops pass."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    if bench.contender == BASELINE:
        return _rates(bench, agents, size)
    return _with_links(bench, agents, size)


def _with_links(bench: Bench, agents: int, size: float) -> dict[str, float]:
    # Imported here, because only Fiber's process needs it installed.
    from benchmarks.fake_cluster import joined_cluster

    with joined_cluster(agents) as cluster:
        return {
            JOINED.name: cluster.joined,
            JOINING.name: cluster.joining,
            MEMORY.name: cluster.master_memory,
            AGENT_MEMORY.name: cluster.agent_memory,
            **_rates(bench, agents, size),
        }


def _rates(bench: Bench, workers: int, size: float) -> dict[str, float]:
    pool = bench.processes.Pool(workers)
    try:
        if bench.contender != BASELINE:
            pool.broadcast(no_op, 0)  # multiprocessing's workers are there when its pool is
        return {
            metric.name: _rate(pool, max(100, round(tasks * size)), chunksize)
            for metric, tasks, chunksize in _MAPS
        }
    finally:
        pool.terminate()
        pool.join()


def _rate(pool: Any, tasks: int, chunksize: int | None) -> float:
    def batch(count: int) -> list[int]:
        results: list[int] = pool.map(no_op, range(count), chunksize)
        return results

    batch(tasks)
    return throughput.rate(batch, tasks)
