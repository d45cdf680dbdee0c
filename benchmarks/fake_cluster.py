"""Master's side of many fake agents: a backend whose agents have real links."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from typing import TypeAlias

from benchmarks import processes
from benchmarks.agent_host import Order

from fiber._agent.interface import ChildObserver, ChildSpec
from fiber._backends.agent_set import AgentSet
from fiber._backends.blobs import Fanout
from fiber._backends.remote import RemoteAgent, RemoteChild
from fiber._engine.placement import Placement
from fiber._logs import OutputWriter
from fiber._runtime.state import Runtime, runtime, shutdown
from fiber._transport.credentials import make_credentials
from fiber._transport.link import Link
from fiber._transport.listener import MasterListener

HOSTS = 4
"""Processes that share the agents."""

_PATIENCE = 60.0
_END = 10.0
_LOOK = 0.1

Host: TypeAlias = subprocess.Popen[str]


class FakeCluster:
    """`Backend` whose agents live in `hosts`.

    `joined` is the seconds that all agents took to join, from the order to dial. `joining` is the
    processor time that this process used meanwhile. `master_memory` and `agent_memory` are the
    bytes that a link costs either side, as PSS. `fanout` lets the agents pass on blobs.
    """

    name = "fake"
    same_host = False
    same_pids = True
    elastic = False
    sends_program = False
    passes_on = False

    def __init__(
        self, runtime: Runtime, hosts: Sequence[Host], agents: int, fanout: Fanout | None = None
    ) -> None:
        assert runtime.hub is not None
        self._hosts = hosts
        self._output = OutputWriter()
        self._loop = runtime.loop
        self._names = [f"fake-{number}" for number in range(agents)]
        placement: Placement[RemoteAgent, RemoteChild] = Placement(math.inf, spread=True)
        self._agents = AgentSet(
            runtime.loop,
            runtime.hub,
            self._output,
            placement,
            fanout=fanout,
            on_lost=self._lost,
        )
        self._missing = agents
        self._all_joined = threading.Event()
        self._problem = ""
        self._credentials = make_credentials()
        self._listener = MasterListener(
            runtime.loop,
            "127.0.0.1:0",
            self._credentials,
            on_agent=self._link,
            on_refused=self._fail,
        )
        self.joined = self.joining = self.master_memory = self.agent_memory = 0.0

    def join(self) -> None:
        """Let all agents dial, and wait until the last of them has its link."""
        names = self._names
        before = self._memory()
        begin, used = time.perf_counter(), time.process_time()
        for number, host in enumerate(self._hosts):
            share = [
                asdict(self._credentials.agent(n, "")) for n in names[number :: len(self._hosts)]
            ]
            order = Order(self._listener.address, share, _PATIENCE)
            assert host.stdin is not None
            host.stdin.write(order.to_line())
            host.stdin.flush()
        self._wait_for_all(begin + _PATIENCE)
        self.joined = time.perf_counter() - begin
        self.joining = time.process_time() - used
        self.master_memory, self.agent_memory = (
            (after - was) / len(names) for was, after in zip(before, self._memory(), strict=True)
        )

    def _wait_for_all(self, end: float) -> None:
        while not self._all_joined.wait(_LOOK):
            for host in self._hosts:
                if host.poll() is not None:
                    raise RuntimeError(f"{self._missing} agents did not join: {_last_words(host)}")
            if time.perf_counter() > end:
                raise TimeoutError(f"{self._missing} agents did not join in {_PATIENCE:g} s")
        if self._problem:
            raise RuntimeError(self._problem)

    def child(self, spec: ChildSpec, observer: ChildObserver) -> RemoteChild:
        """Return a child of the agent that has the fewest."""
        return self._agents.child(spec, observer)

    @property
    def agents(self) -> list[RemoteAgent]:
        """Agents that have joined."""
        return list(self._agents.agents.values())

    def close(self) -> None:
        """End the agents, and with them their hosts; hosts that never began do not matter."""
        self._loop.call_soon(self._close_agents)
        for host in self._hosts:
            with suppress(subprocess.TimeoutExpired):
                host.wait(_END if not self._missing else 0)
        done = threading.Event()
        self._listener.close("the master ended", then=done.set)
        done.wait(_END)
        self._output.close()

    def _memory(self) -> tuple[int, int]:
        """Return the memory of this process, and of the hosts together."""
        return processes.pss(os.getpid()), sum(processes.pss(host.pid) for host in self._hosts)

    # Runs on the loop thread.

    def _link(self, link: Link) -> None:
        self._agents.join(link.peer.name, link)
        self._missing -= 1
        if not self._missing:
            self._all_joined.set()

    def _close_agents(self) -> None:
        for agent in self._agents.agents.values():
            agent.close()

    def _lost(self, agent: RemoteAgent, reason: str) -> None:
        if self._missing:
            self._fail(f"{agent.host} was lost: {reason}")

    def _fail(self, reason: str) -> None:
        self._problem = reason
        self._all_joined.set()


@contextmanager
def joined_cluster(
    agents: int, *, hosts: int = HOSTS, fanout: Fanout | None = None
) -> Iterator[FakeCluster]:
    """Make a cluster whose agents have joined Fiber's backend; end Fiber afterwards."""
    with agent_hosts(hosts) as processes_of_agents:
        ours = runtime()
        ours.backend.close()
        try:
            ours.backend = cluster = FakeCluster(ours, processes_of_agents, agents, fanout)
            cluster.join()
            yield cluster
        finally:
            shutdown()


@contextmanager
def agent_hosts(count: int = HOSTS) -> Iterator[list[Host]]:
    """Return processes that have imported all that they need and wait for their orders."""
    with ExitStack() as stack:
        hosts = [stack.enter_context(_host()) for _ in range(count)]
        for host in hosts:
            assert host.stdout is not None
            if not host.stdout.readline():
                raise RuntimeError(f"a host of agents ended with exit status {host.wait()}")
        yield hosts


@contextmanager
def _host() -> Iterator[Host]:
    with subprocess.Popen(
        [sys.executable, "-m", "benchmarks.agent_host"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as host:
        try:
            yield host
        finally:
            host.kill()


def _last_words(host: Host) -> str:
    assert host.stdout is not None
    return host.stdout.read().strip() or f"a host ended with exit status {host.returncode}"
