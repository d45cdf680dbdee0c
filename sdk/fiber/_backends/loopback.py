"""Agents as processes of their own on this machine, which dial in exactly as pods do.

The whole remote path, encryption and authentication included, without a cluster.
"""

from __future__ import annotations

import itertools
import math
import os
import threading
import time
from functools import partial
from typing import NamedTuple

from fiber._agent.interface import ChildObserver, ChildSpec
from fiber._backends.agent_process import AgentLauncher, AgentProcess
from fiber._backends.agent_set import AgentSet
from fiber._backends.output import Output
from fiber._backends.remote import RemoteAgent, RemoteChild
from fiber._engine.placement import Placement
from fiber._hub.hub import Hub
from fiber._transport.credentials import make_credentials
from fiber._transport.link import Keepalive, Link
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop
from fiber.config import Config
from fiber.errors import StartError

_ATTEMPTS = 3
"""Agents in a row that may fail to join, and none be there, before nothing more is started."""

_PAUSE_MIN, _PAUSE_MAX = 0.1, 30.0
"""Seconds before another one is started after those, if there are others to work with."""

_LOOPBACK = "127.0.0.1"

_QUIT_TIMEOUT = 5.0
"""Seconds for all agents together to end by themselves."""


class LoopbackBackend:
    """Starts its agents at once and replaces each at the moment it is lost.

    Only the loop's thread changes what it holds; others read it, without a lock.
    """

    name = "loopback"
    elastic = False
    same_host = False
    elsewhere: str | None = None
    """For tests: a directory that agents are started in as if this machine were another one, which
    has not the program's files.
    """

    def __init__(self, loop: Loop, hub: Hub, config: Config) -> None:
        self._loop = loop
        self._hub = hub
        self._config = config
        self._output = Output()
        self._failures: tuple[str, ...] = ()
        self._closing = False
        self._numbers = itertools.count()
        self._limit = config.processes_per_agent or math.inf
        self._slots: list[_Slot] = []
        self._by_name: dict[str, _Slot] = {}
        self._vacant: list[_Slot] = []
        """Those whose agents are lost and not yet replaced."""
        self.agents = AgentSet(
            loop, hub, self._output, Placement(self._limit, spread=True), on_lost=self._lost
        )
        credentials = make_credentials("loopback")
        self._listener = MasterListener(
            loop,
            f"{config.listen_host or _LOOPBACK}:{config.listen_port}",
            credentials,
            on_agent=self._joined,
            on_refused=self._refused,
            keepalive=Keepalive(config.heartbeat_interval, config.suspect_after, config.lost_after),
        )
        self._launcher = AgentLauncher(
            credentials.agent_half(),
            config.start_timeout,
            lambda trouble: self._output.write("fiber", trouble),
        )
        for index in range(config.agents):
            self._launch(index)

    @property
    def sends_program(self) -> bool:
        """Whether its agents have not the program's files."""
        return self.elsewhere is not None

    def child(self, spec: ChildSpec, observer: ChildObserver) -> RemoteChild:
        """A child for the agent with the fewest; StartError if none can take one more."""
        there = len(self._slots) - len(self._vacant)
        if there and self.agents.children >= there * self._limit:
            raise StartError(
                "one more process",
                f"all {there} agents run {self._limit} processes already (processes_per_agent); "
                "raise FIBER_AGENTS or FIBER_PROCESSES_PER_AGENT",
            )
        return self.agents.child(spec, observer)

    def close(self) -> None:
        """End the agents and wait for them."""
        self._closing = True
        self._launcher.close()
        self._loop.call_soon(self._shut_down)
        deadline = time.monotonic() + _QUIT_TIMEOUT
        for slot in self._slots:
            slot.process.wait(max(deadline - time.monotonic(), 0.0))
        done = threading.Event()
        self._listener.close("the master ended", then=done.set)
        done.wait(_QUIT_TIMEOUT)
        self._output.close()

    def _launch(self, index: int, pause: float = 0.0) -> None:
        # A name is never used again: what comes late from its last holder is not for the next.
        name = f"loopback-{next(self._numbers)}"
        process = AgentProcess(self._loop, partial(self._ended, name), self.elsewhere)
        self._by_name[name] = slot = _Slot(index, name, process)
        self._slots[index : index + 1] = [slot]
        launch = self._launcher.launch, process, name, self._environment(name)
        if pause:
            self._loop.call_later(pause, *launch)
        else:
            launch[0](*launch[1:])

    def _environment(self, name: str) -> dict[str, str]:
        environment = dict(os.environ)
        if self.sends_program:
            environment.pop("PYTHONPATH", None)
        return {
            **environment,
            "FIBER_AGENT_ADDRESS": self._listener.address,
            "FIBER_AGENT_NAME": name,
            "FIBER_AGENT_PARENT": str(os.getpid()),
            "FIBER_AGENT_INHERITS": os.path.dirname(self._hub.address_or_problem.path),
            "FIBER_START_TIMEOUT": str(self._config.start_timeout),
        }

    # On the loop's thread

    def _joined(self, link: Link) -> str | None:
        name = link.peer.name
        if name not in self._by_name or name in self.agents.agents:
            return f"the master expects no agent named {name}"
        self._failures = ()
        self.agents.join(name, link)
        self._fill_vacant()  # those that were given up: it can be done after all
        return None

    def _refused(self, reason: str) -> None:
        if not self._closing:  # else it may be one of ours, ended before it was in
            self._output.write("fiber", f"refused an agent: {reason}")

    def _shut_down(self) -> None:
        for slot in self._slots:
            agent = self.agents.agents.get(slot.name)
            if agent is None:
                slot.process.kill()  # it has not joined
            else:
                agent.close()

    def _ended(self, name: str, reason: str) -> None:
        """Its process is gone, or was never there."""
        agent = self.agents.agents.get(name)
        if agent is not None:
            agent.lose(reason)
        elif name in self._by_name:
            self._failures += (f"{name}: {reason}",)
            self._replace(name, reason)

    def _lost(self, agent: RemoteAgent, reason: str) -> None:
        self._replace(agent.host, reason)

    def _replace(self, name: str, reason: str) -> None:
        if self._closing:
            return
        slot = self._by_name.pop(name)
        slot.process.kill()
        self._vacant.append(slot)
        in_a_row = len(self._failures)
        if in_a_row < _ATTEMPTS:
            self._fill_vacant()
        elif self.agents.agents:
            pause = min(_PAUSE_MIN * 2 ** (in_a_row - _ATTEMPTS), _PAUSE_MAX)
            self._output.write(
                "fiber",
                f"agent {name} was lost before it joined, as {in_a_row - 1} before it: "
                f"{reason}. The others go on; the next attempt is in {pause:g} s",
            )
            self._fill_vacant(pause)
        else:
            reasons = "\n".join(self._failures)
            error = StartError("the loopback agents", "none joined", reasons, _ATTEMPTS)
            self.agents.fail(error)

    def _fill_vacant(self, pause: float = 0.0) -> None:
        vacant, self._vacant = self._vacant, []
        for slot in vacant:
            self._launch(slot.position, pause)


class _Slot(NamedTuple):
    """The place of an agent among the others, the agent's name, and the process that it is."""

    position: int
    name: str
    process: AgentProcess
