"""Simulated hosts: the lines to them, the kernel's part of a worker's channel, and exit reports.

A ``Child`` is a ``ChildHandle`` that keeps what ``ExitReport`` promises: ``unread`` names every
packet that was delivered and that the worker never read, wherever it was when the worker died.
"""

from __future__ import annotations

import random
import signal
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from fiber._agent.interface import Cause, ChildObserver, ExitReport
from fiber._transport.link import Keepalive
from memory_link import SimulatedLoop
from simulation import schedule
from simulation.workers import Worker

if TYPE_CHECKING:
    from simulation.world import World

LOST_AFTER = Keepalive().lost_after
"""Seconds of silence after which the master gives a host up."""

SAME_HOST = schedule.Agent(1e-5, 5e-5)


class Line:
    """Direction of the way to a host: packets keep their order and may be delayed."""

    def __init__(self, loop: SimulatedLoop, rng: random.Random, plan: schedule.Agent) -> None:
        self._loop = loop
        self._rng = rng
        self._plan = plan if plan.delay else SAME_HOST
        self._under_way: deque[tuple[Callable[..., None], tuple[Any, ...]]] = deque()
        self._held: list[tuple[Callable[..., None], tuple[Any, ...]]] = []
        self._free_at = 0.0
        self.is_cut = False

    def send(self, callback: Callable[..., None], *args: Any) -> None:
        """Call it at the other end."""
        now = self._loop.now()
        arrival = now + self._plan.delay + self._plan.jitter * self._rng.random()
        self._free_at = max(self._free_at, arrival)
        self._under_way.append((callback, args))
        self._loop.call_later(self._free_at - now, self._arrive)

    def _arrive(self) -> None:
        callback, args = self._under_way.popleft()
        if self.is_cut:
            self._held.append((callback, args))
        else:
            callback(*args)

    def mend(self) -> None:
        """Let everything through that waited."""
        self.is_cut = False
        held, self._held = self._held, []
        for callback, args in held:
            callback(*args)

    def forget(self) -> None:
        """Drop the delayed packets."""
        self._held.clear()


class Agent:
    """Host with its workers."""

    def __init__(self, world: World, number: int, plan: schedule.Agent) -> None:
        self.world = world
        self.host = f"host {number}"
        rng = random.Random(f"{world.schedule.seed} {self.host}")
        self.up = Line(world.loop, rng, plan)
        self.down = Line(world.loop, rng, plan)
        self.lost = False
        self._cut_number = 0
        self._children: list[Child] = []

    def start(self, child: Child) -> None:
        """Start a worker."""
        if self.lost:
            child.give_up()
            return
        self._children.append(child)
        self.down.send(child.be_born)

    def cut(self, seconds: float) -> None:
        """Delay all frames for a while."""
        if self.up.is_cut:
            return
        self.world.note("%s is cut off for %g s", self.host, seconds)
        self.up.is_cut = self.down.is_cut = True
        self._cut_number += 1
        self.world.loop.call_later(LOST_AFTER, self._lose, self._cut_number)
        if seconds == schedule.FOREVER:
            self.kill_all()
        else:
            self.world.loop.call_later(seconds, self._mend)

    @property
    def is_cut(self) -> bool:
        """Return whether the way is closed."""
        return self.up.is_cut

    def ended(self, child: Child) -> None:
        """The master knows that ``child`` is gone, or believes so."""
        if not self.lost:
            self._children.remove(child)
        self.world.oracle.lost(child.worker)

    def _lose(self, cut_number: int) -> None:
        if not self.up.is_cut or cut_number != self._cut_number:
            return
        self.world.note("%s is given up", self.host)
        self.lost = True
        for child in self._children:
            child.give_up()

    def _mend(self) -> None:
        self.world.note("%s is back", self.host)
        if self.lost:
            # The session has ended: the agent ends its workers, and packets on their way to them
            # are gone. The workers' last packets come late.
            self.down.forget()
            self.kill_all()
            self._children.clear()
        self.lost = False
        self.down.mend()
        self.up.mend()

    def kill_all(self) -> None:
        """All workers die."""
        for child in self._children:
            child.worker.die(-signal.SIGKILL)


class Channel(Protocol):
    """A worker's channel, in direct use."""

    def hear(self, message: Any) -> None:
        """The worker sent it."""

    def drain(self) -> list[Any]:
        """Return the packets that were not received."""

    def end(self) -> None:
        """The worker is gone."""


class Child:
    """Worker, as its master (a ``ChildHandle``) and as its agent hold it."""

    def __init__(self, agent: Agent, number: int, observer: ChildObserver) -> None:
        self.name = f"worker {number}"
        self.pid: int | None = None
        self.start_error: Exception | None = None
        self.waiting = False
        self.node = ""
        self.host = agent.host
        self.agent = agent
        self.worker = Worker(agent.world, number, self)
        self.inbox: deque[tuple[int, Any, Sequence[memoryview]]] = deque()
        self.gone = False
        """The master knows, or believes."""
        self._channel: Channel | None = None
        self._observer = observer
        self._unread: dict[int, None] = {}

    def start(self) -> None:
        """Start it."""
        self.agent.start(self)

    def deliver(self, seq: int, payload: Any, buffers: Sequence[memoryview] = ()) -> bool:
        """Send a packet to it; False if it is known to be gone."""
        if self.gone:
            return False
        self._unread[seq] = None
        self.agent.down.send(self._put, seq, payload, buffers)
        return True

    def lease_channel(self) -> Any:
        """Return its channel, for direct use."""
        if self.gone:
            return None
        self._channel = self.agent.world.make_channel(self)
        return self._channel

    def reclaim(self) -> None:
        """Deliver the messages of the agent again."""
        channel, self._channel = self._channel, None
        if channel is not None:
            for message in channel.drain():
                self.agent.world.loop.call_soon(self._said, message)

    def recall(self) -> None:
        """Recall the packets that it has not read."""
        self.agent.world.note("%s is asked for its unread batches", self.name)
        self.agent.down.send(self._recall)

    def measure(self) -> None:
        """Do nothing: simulated children use nothing."""

    def signal(self, signum: int) -> None:
        """Send it a signal; each one is deadly here."""
        self.agent.down.send(self.worker.die, -signum)

    # At the agent

    def be_born(self) -> None:
        """Start it."""
        self.agent.up.send(self._started)
        self.worker.be_born()

    def _put(self, seq: int, payload: Any, buffers: Sequence[memoryview]) -> None:
        self.inbox.append((seq, payload, buffers))
        self.worker.wake()

    def _recall(self) -> None:
        if self.worker.dead:
            return
        seqs = [seq for seq, _, _ in self.inbox]
        self.inbox.clear()
        self.agent.up.send(self._taken_back, seqs)

    def read(self) -> tuple[int, Any, Sequence[memoryview]]:
        """The worker takes its next packet."""
        packet = self.inbox.popleft()
        del self._unread[packet[0]]
        return packet

    def say(self, message: Any) -> None:
        """The worker sends a packet."""
        self.agent.up.send(self._said, message)

    def died(self, exitcode: int, running: tuple[int, int] | None) -> None:
        """The worker is gone."""
        self.agent.up.send(self._exited, exitcode, running)

    # At the master

    def give_up(self) -> None:
        """Lose its agent, and with it all knowledge of the worker."""
        reason, cause = f"agent {self.host} lost", Cause.AGENT_LOST
        report = ExitReport(-signal.SIGKILL, reason, host=self.host, cause=cause)
        self._end(report)

    def _started(self) -> None:
        if not self.gone:
            self._observer.started(self.worker.number)

    def _said(self, message: Any) -> None:
        if self.gone:
            self.agent.world.heard_late(self, message)
        elif self._channel is not None:
            self._channel.hear(message)
        else:
            self._tell(message)

    def _tell(self, message: Any) -> None:
        self.agent.world.note("%s says %s", self.name, message)
        self._observer.received(self.agent.world.language.message(message))

    def _taken_back(self, seqs: list[int]) -> None:
        for seq in seqs:
            self._unread.pop(seq, None)
        if not self.gone:
            self.agent.world.note("%s gives back %s", self.name, seqs)
            self._observer.recalled(seqs)

    def _exited(self, exitcode: int, running: tuple[int, int] | None) -> None:
        if not self.gone:
            unread = tuple(self._unread)
            self._end(ExitReport(exitcode, f"exit {exitcode}", unread, running, host=self.host))

    def _end(self, report: ExitReport) -> None:
        if self._channel is not None:
            for message in self._channel.drain():  # its last words
                self._tell(message)
            self._channel.end()
        self.gone = True
        world = self.agent.world
        world.note("%s is gone: unread %s, in %s", self.name, report.unread, report.running)
        self.agent.ended(self)
        self._observer.exited(report)
