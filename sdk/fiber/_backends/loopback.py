"""Agents as processes of their own on this machine, which dial in over nng exactly as pods do.

The whole remote path, encryption and authentication included, without a cluster.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import threading

from fiber._agent.child import interpreter_arguments
from fiber._backends.output import Output
from fiber._backends.remote import RemoteAgent
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
    """Starts its agents at once and replaces the ones that end."""

    name = "loopback"
    same_host = False

    def __init__(self, loop: Loop, config: Config) -> None:
        self._loop = loop
        self._config = config
        self._output = Output()
        self._lock = threading.Lock()
        self._failures: list[str] = []
        self.closing = False
        self._directory = tempfile.mkdtemp(prefix="fiber-", dir=config.runtime_directory)
        credentials = make_credentials("loopback")
        self._credentials = os.path.join(self._directory, "agent")
        try:
            credentials.agent_half().to_directory(self._credentials)
            self._listener = MasterListener(
                loop,
                f"{config.listen_host}:{config.listen_port}",
                credentials,
                on_agent=self._joined,
                on_refused=self._refused,
                patience=Patience(
                    config.heartbeat_interval, config.suspect_after, config.lost_after
                ),
            )
        except BaseException:
            shutil.rmtree(self._directory, ignore_errors=True)
            raise
        self._slots = [_Slot(self, number) for number in range(config.agents)]

    def place(self) -> RemoteAgent:
        """The agent with the fewest children; StartError if none can take one more."""
        limit = self._config.processes_per_agent
        with self._lock:
            if len(self._failures) >= _ATTEMPTS:
                raise StartError(
                    "the loopback agents",
                    "none of them joined",
                    "\n".join(self._failures),
                    _ATTEMPTS,
                )
            agents = [slot.agent for slot in self._slots]
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
        self.closing = True
        for slot in self._slots:
            slot.agent.close()
        for slot in self._slots:
            slot.wait(_QUIT_TIMEOUT)
        done = threading.Event()
        self._listener.close("the master ended", then=done.set)
        done.wait(_QUIT_TIMEOUT)
        self._output.close()
        shutil.rmtree(self._directory, ignore_errors=True)

    # On the loop's thread

    def _joined(self, link: Link) -> None:
        for slot in self._slots:
            if slot.agent.host == link.peer.name and not slot.agent.joined:
                self._failures.clear()
                slot.agent.join(link)
                return
        link.close(f"the master expects no agent named {link.peer.name}")

    def _refused(self, reason: str) -> None:
        self._output.write("fiber", f"refused an agent: {reason}")

    def ended(self, slot: _Slot, reason: str) -> None:
        """An agent's process ended."""
        joined = slot.agent.joined
        slot.agent.lose(reason)
        if self.closing:
            return
        if not joined:
            self._failures.append(f"{slot.agent.host}: {reason}")
        if len(self._failures) < _ATTEMPTS:
            slot.launch()

    def environment(self, name: str) -> dict[str, str]:
        """What an agent is told."""
        return {
            **os.environ,
            "FIBER_AGENT_ADDRESS": self._listener.address,
            "FIBER_AGENT_CREDENTIALS": self._credentials,
            "FIBER_AGENT_NAME": name,
            "FIBER_AGENT_PARENT": str(os.getpid()),
            "FIBER_START_TIMEOUT": str(self._config.start_timeout),
        }

    @property
    def loop(self) -> Loop:
        """The loop that watches them."""
        return self._loop

    @property
    def output(self) -> Output:
        """Where their children's lines go."""
        return self._output


class _Slot:
    """A place for an agent: its process now, and the next one when that ends."""

    def __init__(self, backend: LoopbackBackend, number: int) -> None:
        self._backend = backend
        self._number = number
        self._life = 0
        self.launch()

    def launch(self) -> None:
        """Start an agent's process."""
        self._life += 1
        # A name is never used again: what comes late from the last holder is not for this one.
        name = f"loopback-{self._number}" + (f"-{self._life}" if self._life > 1 else "")
        self.agent = RemoteAgent(name, self._backend.output, on_lost=self._lost)
        statement = "import runpy; runpy.run_module('fiber.agent', run_name='__main__')"
        self._process = subprocess.Popen(
            interpreter_arguments(sys.executable, statement),
            env=self._backend.environment(name),
            stdin=subprocess.DEVNULL,
            process_group=0,
        )
        self._watched = os.pidfd_open(self._process.pid)
        self._backend.loop.register(self._watched, self._ended)

    def wait(self, timeout: float) -> None:
        """Wait for the process's end, by force after ``timeout`` seconds."""
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _lost(self, agent: RemoteAgent) -> None:
        if self._backend.closing:
            return
        # Out of reach, though its process may run: nothing of it is wanted any more.
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()

    def _ended(self) -> None:
        self._backend.loop.unregister(self._watched)
        os.close(self._watched)
        status = self._process.wait()
        self._backend.ended(self, f"its process ended with status {status}")
