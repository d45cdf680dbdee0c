"""Agents as processes on this machine.  They connect to the program exactly as pods do.

This is the whole remote path, with encryption and authentication, without a cluster.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import math
import os
import queue
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

from fiber._agent.interface import ChildObserver, ChildSpec
from fiber._agent.zygote_process import interpreter_arguments
from fiber._backends.agent_set import AgentSet
from fiber._backends.blobs import Fanout
from fiber._backends.remote import RemoteAgent, RemoteChild
from fiber._engine.placement import Placement
from fiber._engine.start_failures import StartFailure, StartFailures
from fiber._hub.directory import remove_directory
from fiber._hub.hub import Hub
from fiber._logs import OutputWriter
from fiber._transport.authentication import Identity, join_address
from fiber._transport.credentials import Credentials, make_credentials
from fiber._transport.link import Keepalive, Link
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop, ScheduledCall
from fiber.config import Config
from fiber.errors import StartError

_REASONS = 3
"""Number of failed agents that an error lists."""

_EXPECTED_FOR = 5.0
"""Seconds from an agent's start for which the others leave it its share of the children."""

_LOOPBACK = "127.0.0.1"

_LAUNCHING = 3.0
"""Seconds to try to start one process.  Then that counts as a failed start."""

_QUIT_TIMEOUT = 5.0
"""Seconds for all agents together to end by themselves."""


class LoopbackBackend:
    """Backend that starts its agents at once, and replaces each as soon as it is lost.

    After failures to join, one agent has to succeed before others are started.  When that takes too
    long, the waiting children are refused, and from then on each new child causes one more attempt.

    Only the loop thread changes the attributes; other threads read them without a lock.
    """

    name = "loopback"
    elastic = False
    same_host = False
    same_pids = True
    elsewhere: str | None = None
    """Directory that agents are started in, for tests of a machine without the program's files."""

    def __init__(self, loop: Loop, hub: Hub, config: Config) -> None:
        self._loop = loop
        self._hub = hub
        self._config = config
        self._output = OutputWriter(config.log_to, config.log_times)
        self._failures = StartFailures()
        self._reasons: deque[tuple[str, str]] = deque(maxlen=_REASONS)
        self._gave_up = False
        self._alone_since = 0.0
        self._retry: ScheduledCall | None = None
        self._closing = False
        self._numbers = itertools.count()
        self._limit = config.processes_per_agent or math.inf
        self._slots: list[_Slot] = []
        self._by_name: dict[str, _Slot] = {}
        self._departing: dict[str, _Slot] = {}
        """Slots whose agents are leaving and were replaced."""
        self._vacant: list[_Slot] = []
        """Slots whose agents are lost and not replaced yet."""
        self.agents = AgentSet(
            loop,
            hub,
            self._output,
            Placement(self._limit, spread=True),
            fanout=Fanout(port=0) if self.passes_on else None,
            on_change=self._changed,
            on_lost=self._lost,
            on_leaving=self._leaving,
        )
        self._credentials = make_credentials()
        self._listener = MasterListener(
            loop,
            join_address(config.listen_host or _LOOPBACK, config.listen_port),
            self._credentials,
            on_agent=self._joined,
            objection=self._objection,
            on_refused=self._refused,
            on_unserved=self._unserved,
            keepalive=Keepalive(config.heartbeat_interval, config.suspect_after, config.lost_after),
        )
        self._launcher = AgentLauncher(
            min(config.start_timeout, _LAUNCHING),
            lambda trouble: self._output.write("fiber", trouble),
        )
        for index in range(config.agents):
            self._launch(index)
        loop.call_soon(self._expect)

    @property
    def passes_on(self) -> bool:
        """True if agents pass large blobs on, which saves nothing on one machine."""
        return self._config.pass_on == "always"

    @property
    def sends_program(self) -> bool:
        """True if the agents need the program's files."""
        return self.elsewhere is not None

    def child(self, spec: ChildSpec, observer: ChildObserver) -> RemoteChild:
        """Return a child, not started yet; StartError if all agents are full."""
        agents = len(self._slots)
        if self.agents.children >= agents * self._limit:
            raise StartError(
                "one more process",
                f"all {agents} agents run {self._limit} processes already (processes_per_agent); "
                "raise FIBER_AGENTS or FIBER_PROCESSES_PER_AGENT",
            )
        return self.agents.child(spec, observer)

    def close(self) -> None:
        """End the agents and wait for them."""
        self._closing = True
        self._launcher.close()
        self._loop.call_soon(self._shut_down)
        deadline = time.monotonic() + _QUIT_TIMEOUT
        for slot in [*self._slots, *self._departing.values()]:
            slot.process.wait(max(deadline - time.monotonic(), 0.0))
        done = threading.Event()
        self._listener.close("the master ended", then=done.set)
        done.wait(_QUIT_TIMEOUT)
        self._output.close()

    def _launch(self, index: int) -> None:
        # A name is never used again, so late messages of an agent never count for the next one.
        name = f"loopback-{next(self._numbers)}"
        files = self._files(name)
        process = AgentProcess(self._loop, partial(self._ended, name), files, self.elsewhere)
        self._by_name[name] = slot = _Slot(
            index, name, process, self._loop.now(), secrets.token_hex(8)
        )
        self._slots[index : index + 1] = [slot]
        credentials = self._credentials.agent(name, slot.uid)
        environment = {**self._environment(name), **files.variables()}
        self._launcher.launch(process, credentials, environment)
        self._loop.call_later(_EXPECTED_FOR, self._expect)

    def _files(self, name: str) -> _Files:
        """Choose the files of an agent, so that they are removed whenever the agent is killed."""
        ours = os.path.dirname(self._hub.address_or_problem.path)
        if not ours:
            return _Files()
        directory = os.path.join(os.path.dirname(ours), f"fiber-{secrets.token_hex(4)}")
        return _Files(directory, os.path.join(ours, f"report-{name}"))

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
            "FIBER_LOG_LEVEL": self._config.log_level,
            "FIBER_START_TIMEOUT": str(self._config.start_timeout),
        }

    # Events, on the loop thread

    def _objection(self, identity: Identity) -> str:
        slot = self._by_name.get(identity.name)
        if slot is None or slot.uid != identity.uid or identity.name in self.agents.agents:
            return f"the master expects no agent named {identity.name}"
        return ""

    def _joined(self, link: Link) -> None:
        name = link.peer.name
        self._failures = StartFailures()
        self._reasons.clear()
        self._gave_up = False
        self.agents.join(name, link)
        self._fill_vacant()

    def _refused(self, reason: str) -> None:
        if not self._closing:  # else it may be an agent that was ended before it joined
            self._output.write("fiber", f"refused an agent: {reason}")

    def _unserved(self, name: str, reason: str) -> None:
        """End an agent that this program cannot serve, for want of memory or descriptors."""
        if name in self._by_name and name not in self.agents.agents and not self._closing:
            self._vacate(name)
            self._failed(name, reason, killed=True, what="this program cannot serve them")

    def _shut_down(self) -> None:
        for slot in [*self._slots, *self._departing.values()]:
            agent = self.agents.agents.get(slot.name)
            if agent is None:
                slot.process.terminate()  # it has not joined yet, or has left
            else:
                agent.close()

    def _ended(self, name: str, reason: str, killed: bool) -> None:
        """Note that the process of an agent has ended, or was never started."""
        agent = self.agents.agents.get(name)
        if agent is not None:
            agent.lose(reason)
        elif name in self._by_name and not self._closing:
            self._vacate(name)
            self._failed(name, reason, killed)
        self._departing.pop(name, None)

    def _lost(self, agent: RemoteAgent, reason: str) -> None:
        if not self.agents.agents:
            self._alone_since = self._loop.now()
        if (departed := self._departing.get(agent.host)) is not None:
            self._loop.call_later(_QUIT_TIMEOUT, departed.process.kill)
        elif not self._closing:
            self._vacate(agent.host)
            self._fill_vacant()

    def _leaving(self, agent: RemoteAgent) -> None:
        """Replace an agent that leaves, and ends by itself."""
        if not self._closing:
            self._departing[agent.host] = slot = self._by_name.pop(agent.host)
            self._vacant.append(slot)
            self._fill_vacant()

    def _vacate(self, name: str) -> None:
        slot = self._by_name.pop(name)
        slot.process.kill()
        self._vacant.append(slot)

    def _failed(self, name: str, reason: str, killed: bool, what: str = "none joined") -> None:
        now = self._loop.now()
        if reason not in [earlier for _, earlier in self._reasons]:
            self._reasons.append((name, reason))
        text = "\n".join(f"{name}: {reason}" for name, reason in self._reasons)
        failure = StartFailure("the loopback agents", what, text, killed)
        at_work = bool(self.agents.agents)
        self._failures.add(failure, now, at_work=at_work)
        if not at_work and self._failures.last(failure, now, self._alone_since):
            self._gave_up = True
            self.agents.refuse_waiting(failure.error(self._failures.count))
        elif self._failures.are_news(now):
            self._output.write(
                "fiber",
                f"no loopback agent has joined for {self._failures.lasted(now):.0f} s, "
                f"{self._failures.count} tries: {name}: {reason}. Trying again",
            )
        self._fill_vacant()

    def _changed(self) -> None:
        if self._gave_up:
            self._fill_vacant()

    def _fill_vacant(self) -> None:
        """Start the agents that are missing; after failures one, once the pause is over."""
        self._start_some()
        self._expect()

    def _expect(self) -> None:
        """Let children wait for agents that may join at any moment."""
        due = self._loop.now() - _EXPECTED_FOR
        late = [slot for slot in self._starting if slot.launched <= due]
        expected = 0 if self._failures.count else len(self._starting) - len(late)
        self.agents.expect(expected)

    def _start_some(self) -> None:
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
        if self._closing or (self._gave_up and not self.agents.placement.waiting):
            return
        if not self._failures.count:
            vacant, self._vacant = self._vacant, []
            for slot in vacant:
                self._launch(slot.position)
        elif self._vacant and not self._starting:
            try_at = self._failures.try_at(at_work=bool(self.agents.agents))
            if (pause := try_at - self._loop.now()) > 0:
                self._retry = self._loop.call_later(pause, self._fill_vacant)
            else:
                self._launch(self._vacant.pop(0).position)

    @property
    def _starting(self) -> list[_Slot]:
        """Slots whose agents have neither joined nor failed."""
        joined = self.agents.agents
        return [slot for slot in self._by_name.values() if slot.name not in joined]


class _Slot(NamedTuple):
    """Place for an agent, with the agent's name, process and start time."""

    position: int
    name: str
    process: AgentProcess
    launched: float
    uid: str


class _Files(NamedTuple):
    """Files of an agent; None if they are not known beforehand."""

    directory: str | None = None
    """Directory of its hub."""
    report: str | None = None
    """File in which it says why it failed."""

    def variables(self) -> dict[str, str]:
        """Return the environment variables by which the agent gets the names."""
        values = {"FIBER_AGENT_DIRECTORY": self.directory, "FIBER_AGENT_REPORT": self.report}
        return {name: value for name, value in values.items() if value is not None}

    def reason(self) -> str:
        """Return why the agent failed, and remove the file; empty if it did not say."""
        if self.report is None:
            return ""
        try:
            with open(self.report, errors="replace") as file:
                text = file.read()
            os.unlink(self.report)
        except OSError:
            return ""
        return text.strip()

    def remove(self) -> None:
        """Remove what an agent that was killed has left."""
        if self.directory is not None:
            remove_directory(self.directory)


_PAUSE_MIN, _PAUSE_MAX = 0.1, 5.0
"""Seconds from one attempt to start a process to the next, growing."""

_MAY_PASS = (errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE)
"""Errors that pass when other processes have ended."""

_STATEMENT = "import runpy; runpy.run_module('fiber.agent', run_name='__main__')"


class AgentProcess:
    """Process of an agent, from before its start to after its end.

    ``on_end`` is called once, on the loop thread.  It gets the reason why the process ended or
    never began, and whether a signal or a lack of resources caused that.
    """

    def __init__(
        self,
        loop: Loop,
        on_end: Callable[[str, bool], None],
        files: _Files | None = None,
        directory: str | None = None,
    ) -> None:
        """``directory``: the one to start it in, if that is not this program's."""
        self._loop = loop
        self._files = files or _Files()
        self._directory = directory
        self._on_end = on_end
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._unwanted = False

    @property
    def pid(self) -> int | None:
        """Id of the process; None before its start."""
        return None if self._process is None else self._process.pid

    def start(self, environment: Mapping[str, str], credentials: Credentials) -> None:
        """Start the process, which alone inherits the descriptor of the credentials; OSError."""
        with self._lock:
            if self._unwanted:
                return
            descriptor = credentials.to_descriptor()
            try:
                process = subprocess.Popen(
                    interpreter_arguments(sys.executable, _STATEMENT),
                    env={**environment, "FIBER_AGENT_CREDENTIALS": f"fd:{descriptor}"},
                    stdin=subprocess.DEVNULL,
                    pass_fds=(descriptor,),
                    cwd=self._directory,
                    process_group=0,
                )
            finally:
                os.close(descriptor)
            try:
                self._watched = os.pidfd_open(process.pid)
            except OSError:  # its end would stay unseen, and the next attempt has its name
                process.kill()
                process.wait()
                raise
            self._process = process
        self._loop.register(self._watched, self._ended)

    def fail(self, reason: str, *, may_pass: bool) -> None:
        """Note that the process will not be started."""
        self._loop.call_soon(self._on_end, reason, may_pass)

    def kill(self) -> None:
        """Kill the process, which is out of reach though it may run."""
        self._end(signal.SIGKILL)

    def terminate(self) -> None:
        """Send SIGTERM to the agent, which removes its directory before it ends."""
        self._end(signal.SIGTERM)

    def _end(self, signum: int) -> None:
        with self._lock:
            self._unwanted = True
            if self._process is not None:
                with contextlib.suppress(ProcessLookupError):
                    self._process.send_signal(signum)

    def wait(self, timeout: float) -> None:
        """Wait for the end; kill the process after ``timeout`` seconds."""
        process = self._process
        if process is None:
            return
        try:
            process.wait(timeout)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        self._files.remove()

    def _ended(self) -> None:
        assert self._process is not None
        status = self._process.poll()
        if status is None:
            return
        self._loop.unregister(self._watched)
        os.close(self._watched)
        self._files.remove()
        how = f"its process ended with status {status}"
        reason = self._files.reason()
        self._on_end(f"{how}: {reason}" if reason else how, status < 0)


class AgentLauncher:
    """Thread that starts agents, one after the other.

    Starting a process takes milliseconds and may fail, so the loop does not do it.  A thread for
    each agent could be refused when the system is short of threads.
    """

    def __init__(self, timeout: float, on_trouble: Callable[[str], None]) -> None:
        """Start the thread.

        A start that fails is repeated for ``timeout`` seconds.  ``on_trouble`` gets the reason of
        each failure, on the thread.
        """
        self._timeout = timeout
        self._on_trouble = on_trouble
        self._wanted: queue.SimpleQueue[tuple[AgentProcess, Credentials, Mapping[str, str]] | None]
        self._wanted = queue.SimpleQueue()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fiber-launch", daemon=True)
        self._thread.start()

    def launch(
        self, process: AgentProcess, credentials: Credentials, environment: Mapping[str, str]
    ) -> None:
        """Start a process as soon as possible; return at once.  Any thread."""
        self._wanted.put((process, credentials, environment))

    def close(self) -> None:
        """Start no more processes."""
        self._closing.set()
        self._wanted.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (wanted := self._wanted.get()) is not None and not self._closing.is_set():
            self._start(*wanted)

    def _start(
        self, process: AgentProcess, credentials: Credentials, environment: Mapping[str, str]
    ) -> None:
        deadline = time.monotonic() + self._timeout
        pause = _PAUSE_MIN
        while True:
            try:
                process.start(environment, credentials)
                return
            except OSError as error:
                reason = f"its process cannot be started: {error}"
                may_pass = error.errno in _MAY_PASS
                if not may_pass or time.monotonic() + pause > deadline:
                    process.fail(reason, may_pass=may_pass)
                    return
            self._on_trouble(
                f"agent {credentials.name} has to wait, {reason}; next attempt in {pause:g} s"
            )
            if self._closing.wait(pause):
                return
            pause = min(2 * pause, _PAUSE_MAX)
