"""Agents as processes of their own on this machine, which dial in over nng exactly as pods do.

The whole remote path, encryption and authentication included, without a cluster.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading

from fiber._agent.zygote_process import interpreter_arguments
from fiber._backends.output import Output
from fiber._backends.remote import RemoteAgent
from fiber._hub.hub import Hub
from fiber._transport.credentials import make_credentials
from fiber._transport.link import Link, Patience
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop
from fiber.config import Config
from fiber.errors import StartError

_ATTEMPTS = 3
"""Agents in a row that may fail to join before nothing more is started."""

_QUIT_TIMEOUT = 5.0


class LoopbackBackend:
    """Starts its agents at once and replaces each at the moment it is lost."""

    name = "loopback"
    same_host = False

    def __init__(self, loop: Loop, hub: Hub, config: Config) -> None:
        self._loop = loop
        self._hub = hub
        self._config = config
        self._output = Output()
        self._lock = threading.Lock()
        self._failures: list[str] = []
        self._closing = False
        credentials = make_credentials("loopback")
        self._credentials = credentials.agent_half().to_environment()
        self._listener = MasterListener(
            loop,
            f"{config.listen_host}:{config.listen_port}",
            credentials,
            on_agent=self._joined,
            on_refused=self._refused,
            patience=Patience(config.heartbeat_interval, config.suspect_after, config.lost_after),
        )
        self._launched = 0
        self._processes = [self._launch() for _ in range(config.agents)]

    def place(self) -> RemoteAgent:
        """The agent with the fewest children; StartError if none can take one more."""
        limit = self._config.processes_per_agent
        with self._lock:
            if len(self._failures) >= _ATTEMPTS:
                reasons = "\n".join(self._failures)
                raise StartError("the loopback agents", "none joined", reasons, _ATTEMPTS)
            agents = [process.agent for process in self._processes]
        free = [agent for agent in agents if not limit or agent.children < limit]
        if not free:
            raise StartError(
                "one more process",
                f"all {len(agents)} agents run {limit} processes already (processes_per_agent); "
                "raise FIBER_AGENTS or FIBER_PROCESSES_PER_AGENT",
            )
        return min(free, key=lambda agent: (agent.suspect, agent.children))

    def close(self) -> None:
        """End the agents and wait for them."""
        self._closing = True
        for process in self._processes:
            process.agent.close()
        for process in self._processes:
            process.wait(_QUIT_TIMEOUT)
        done = threading.Event()
        self._listener.close("the master ended", then=done.set)
        done.wait(_QUIT_TIMEOUT)
        self._output.close()

    def _launch(self) -> _AgentProcess:
        # A name is never used again: what comes late from its last holder is not for the next.
        name = f"loopback-{self._launched}"
        self._launched += 1
        agent = RemoteAgent(name, self._hub, self._output, on_lost=self._lost)
        return _AgentProcess(self._loop, agent, self._environment(name))

    def _environment(self, name: str) -> dict[str, str]:
        return {
            **os.environ,
            "FIBER_AGENT_ADDRESS": self._listener.address,
            "FIBER_AGENT_CREDENTIALS": self._credentials,
            "FIBER_AGENT_NAME": name,
            "FIBER_AGENT_PARENT": str(os.getpid()),
            "FIBER_AGENT_INHERITS": os.path.dirname(self._hub.access.address),
            "FIBER_START_TIMEOUT": str(self._config.start_timeout),
        }

    # On the loop's thread

    def _joined(self, link: Link) -> None:
        for process in self._processes:
            if process.agent.host == link.peer.name and not process.agent.joined:
                self._failures.clear()
                process.agent.join(link)
                return
        link.close(f"the master expects no agent named {link.peer.name}")

    def _refused(self, reason: str) -> None:
        self._output.write("fiber", f"refused an agent: {reason}")

    def _lost(self, agent: RemoteAgent, reason: str) -> None:
        """Replace it before its children's ends make anybody ask for new ones."""
        if self._closing:
            return
        with self._lock:
            if not agent.joined:
                self._failures.append(f"{agent.host}: {reason}")
            for index, process in enumerate(self._processes):
                if process.agent is agent:
                    process.kill()
                    if len(self._failures) < _ATTEMPTS:
                        self._processes[index] = self._launch()


class _AgentProcess:
    """The process of one agent."""

    def __init__(self, loop: Loop, agent: RemoteAgent, environment: dict[str, str]) -> None:
        self.agent = agent
        self._loop = loop
        statement = "import runpy; runpy.run_module('fiber.agent', run_name='__main__')"
        self._process = subprocess.Popen(
            interpreter_arguments(sys.executable, statement),
            env=environment,
            stdin=subprocess.DEVNULL,
            process_group=0,
        )
        self._watched = os.pidfd_open(self._process.pid)
        loop.register(self._watched, self._ended)

    def kill(self) -> None:
        """It is out of reach, though it may run: nothing of it is wanted any more."""
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()

    def wait(self, timeout: float) -> None:
        """Wait for its end, by force after ``timeout`` seconds."""
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _ended(self) -> None:
        status = self._process.poll()
        if status is None:
            return
        self._loop.unregister(self._watched)
        os.close(self._watched)
        self.agent.lose(f"its process ended with status {status}")
