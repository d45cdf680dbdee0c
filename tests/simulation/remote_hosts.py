"""Hosts behind the real remote path: ports, service, links and sessions, over simulated wires.

Only what is outside of the agent's Python is simulated: the connection, which delays, loses and
breaks off, and the workers.
"""

from __future__ import annotations

import random
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from unittest import mock

from fiber._agent import service
from fiber._agent.interface import ChildObserver, ChildSpec, ExitReport
from fiber._agent.usage import Usage
from fiber._backends.remote import RemoteAgent, RemoteChild
from fiber._wire.packet import Message
from memory_link import Cable
from simulation import schedule
from simulation.agents import SAME_HOST, Agent, Child
from simulation.workers import Worker

if TYPE_CHECKING:
    from simulation.world import World


class RemoteHost(Agent):
    """Host with a separate agent. Once lost, it joins again under another name."""

    def __init__(self, world: World, number: int, plan: schedule.Agent) -> None:
        super().__init__(world, number, SAME_HOST)
        self._plan = plan
        self._rng = random.Random(f"{world.schedule.seed} cable {number}")
        self._seen: dict[str, Seen] = {}
        self._generation = 0
        self.is_gone = False
        self._join()

    def _join(self) -> None:
        self._generation += 1
        self._seen = {}
        self.lost = False
        name = f"{self.host}.{self._generation}"
        loop: Any = self.world.loop
        delay = self._plan.delay, self._plan.delay + self._plan.jitter
        self._cable = Cable(
            loop,
            seed=self._rng.getrandbits(32),
            delay=delay,
            drop=self._rng.choice((0.0, 0.0, 0.05)),
        )
        nothing: Any = mock.MagicMock()
        observer = SimpleNamespace(
            lost=self._lose_remote, child_gone=lambda _: None, suspected=lambda *_: None
        )
        link = self._cable.master
        self._remote = RemoteAgent(name, link, loop, nothing, nothing, observer)
        here: Any = LocalPort(self)
        self._service = service.AgentService(loop, self._cable.agent, here, nothing, nothing)
        self._cable.agent.attach(self._service)
        link.attach(self._remote)

    @property
    def is_cut(self) -> bool:
        """Return whether the way is closed."""
        return self._cable.is_cut

    def child_of_master(self, name: str, observer: ChildObserver) -> RemoteChild:
        """A worker as the master has it, to be started."""
        seen = self._seen[name] = Seen(self, name, observer)
        spec = ChildSpec(name, "fork", b"", b"", tasks=True)
        return RemoteChild(self._remote, spec, seen)

    def seen(self, name: str) -> Seen:
        """Return the master's knowledge of a worker."""
        return self._seen[name]

    def cut(self, seconds: float) -> None:
        """Delay all frames for a while."""
        if self.is_cut:
            return
        self.world.note("%s is cut off for %g s", self.host, seconds)
        self._cable.cut()
        if seconds == schedule.FOREVER:
            self.is_gone = True
            self.kill_all()
        else:
            self.world.loop.call_later(seconds, self._mend_cable)

    def _mend_cable(self) -> None:
        self.world.note("%s is back", self.host)
        self._cable.mend()
        if self.lost and not self.is_gone:
            self._join()

    def _lose_remote(self, agent: RemoteAgent, reason: str) -> None:
        self.world.note("%s is given up: %s", self.host, reason)
        self.lost = True
        if not self.is_cut and not self.is_gone:
            # Its own side ends its processes; the backend starts an agent anew.
            self.world.loop.call_later(0.0, self._join)

    def ended(self, child: Child) -> None:
        """Note an end that the agent knows and the master does not yet."""
        self._children.remove(child)

    def close(self) -> None:
        """Let the link go."""
        self._cable.master.close(linger=0)
        self._cable.agent.close(linger=0)


class LocalPort:
    """The agent's own process; in place of ``fiber._agent.agent.Agent``."""

    def __init__(self, host: RemoteHost) -> None:
        self.host = host.host
        self._host = host

    def child(self, spec: ChildSpec, observer: ChildObserver) -> Child:
        """A worker here, to be started."""
        if self._host.is_gone:
            raise RuntimeError("nobody is there")
        child = self._host.world.child(self._host, observer)
        self._host.seen(spec.name).child = child
        return child


class Seen:
    """A remote worker from the master's side: its events for the oracle, and its observer."""

    def __init__(self, agent: RemoteHost, name: str, observer: ChildObserver) -> None:
        self.agent = agent
        self.name = name
        self.child: Child | None = None
        self.gone = False
        self._observer = observer

    @property
    def worker(self) -> Worker:
        """The process."""
        assert self.child is not None
        return self.child.worker

    def started(self, pid: int) -> None:
        """Note that the worker exists."""
        self._observer.started(pid)

    def received(self, message: Message) -> None:
        """Take a message of the worker."""
        self._observer.received(message)

    def recalled(self, seqs: list[int]) -> None:
        """Take back the packets that it did not read."""
        self._observer.recalled(seqs)

    def measured(self, usage: Usage) -> None:
        """Take its memory and processor time."""
        self._observer.measured(usage)

    def showed_stack(self, text: str) -> None:
        """Take its stacks."""
        self._observer.showed_stack(text)

    def draining(self) -> None:
        """Note that its host is about to go."""
        self._observer.draining()

    def exited(self, report: ExitReport) -> None:
        """Note the end of the worker."""
        self.gone = True
        world = self.agent.world
        world.note("the master hears that %s is gone: unread %s", self.name, report.unread)
        if self.child is not None:
            world.oracle.lost(self.child.worker)
        self._observer.exited(report)


class NoCapture(SimpleNamespace):
    """Stand-in for the pipe that reads a child's output."""

    stdio = (1, 2)

    def __init__(self, *args: Any) -> None:
        super().__init__()

    def started(self) -> None:
        """Keep the descriptors, which belong to the pipe."""

    def finish(self) -> tuple[str, ...]:
        """Return no output."""
        return ()
