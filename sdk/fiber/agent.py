"""``python -m fiber.agent``: the process that runs children on another host for a master.

It takes everything from its environment, nothing from its command line:

``FIBER_AGENT_ADDRESS``      ``host:port`` of the master
``FIBER_AGENT_CREDENTIALS``  the agent's half of the credentials, or the directory that holds it
``FIBER_AGENT_NAME``         what the master calls it
``FIBER_AGENT_PARENT``       optional: the pid of a process on this host to end with
``FIBER_AGENT_INHERITS``     optional: a directory of that process, to be removed if it is killed
``FIBER_START_TIMEOUT``      seconds to find the master, as for every Fiber process

Exit status 0: the master ended it.  1: it could not join, or lost the master; stderr says why.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
from typing import NoReturn

from fiber import config
from fiber._agent.agent import Agent
from fiber._agent.service import AgentService
from fiber._hub.hub import Hub
from fiber._transport.credentials import Credentials
from fiber._transport.dialer import AgentDialer
from fiber._transport.handshake import Identity
from fiber._transport.link import Link
from fiber._transport.loop import Loop
from fiber.errors import AuthenticationError, ConfigError, FiberError

_ADDRESS = "FIBER_AGENT_ADDRESS"
_CREDENTIALS = "FIBER_AGENT_CREDENTIALS"
_NAME = "FIBER_AGENT_NAME"
_PARENT = "FIBER_AGENT_PARENT"
_INHERITS = "FIBER_AGENT_INHERITS"

_DRAIN_GRACE = 10.0
"""Seconds that children have to end when this process is told to (SIGTERM)."""


class Main:
    """The life of an agent: dial, serve, end."""

    def __init__(self) -> None:
        self._name = os.environ.get(_NAME) or f"agent-{os.getpid()}"
        self._loop = Loop()
        self._hub = Hub(self._loop, self._name, config.current().runtime_directory)
        self._agent = Agent(self._loop, self._name, self._hub)
        self._service: AgentService | None = None
        self._status = 0

    def run(self) -> int:
        """Serve until the end; the exit status."""
        try:
            dialer = self._dial()
        except (FiberError, AuthenticationError) as error:
            self._complain(error)
            return 1
        signal.pthread_sigmask(signal.SIG_SETMASK, ())  # the program may have blocked some
        signal.signal(signal.SIGTERM, self._on_sigterm)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        self._end_with_parent()
        self._loop.run()
        dialer.close()
        self._agent.close()
        self._hub.close()
        return self._status

    def _dial(self) -> AgentDialer:
        return AgentDialer(
            self._loop,
            _required(_ADDRESS),
            _read(_required(_CREDENTIALS)),
            Identity.of_this_process(self._name, pid=str(os.getpid())),
            on_link=self._joined,
            on_failed=self._failed,
            timeout=config.current().start_timeout,
        )

    def _complain(self, what: object) -> None:
        print(f"fiber agent {self._name}: {what}", file=sys.stderr, flush=True)

    def _joined(self, link: Link) -> None:
        self._service = AgentService(self._loop, link, self._agent, self._hub, self._ended)
        self._link = link
        link.attach(self._service)

    def _failed(self, error: Exception) -> None:
        self._complain(error)
        self._status = 1
        self._loop.stop()

    def _ended(self, reason: str) -> None:
        if reason.startswith("lost"):
            self._complain(reason)
            self._status = 1
        self._link.close("the agent ended", then=self._loop.stop)

    def _on_sigterm(self, *_: object) -> None:
        self._loop.interrupt(self._drain)

    def _drain(self) -> None:
        if self._service is None:
            self._loop.stop()
        else:
            self._service.stop("told to end by SIGTERM", _DRAIN_GRACE)

    def _end_with_parent(self) -> None:
        parent = os.environ.get(_PARENT)
        if parent is None:
            return
        try:
            watched = os.pidfd_open(int(parent))
        except ProcessLookupError:
            self._parent_died()
        self._loop.register(watched, self._parent_died)

    def _parent_died(self) -> NoReturn:
        # At once and by force: nobody is left to tell or to wait for.
        directory = os.environ.get(_INHERITS)
        if directory:
            shutil.rmtree(directory, ignore_errors=True)
        os._exit(0)


def _read(credentials: str) -> Credentials:
    if os.path.isabs(credentials):
        return Credentials.from_directory(credentials)
    return Credentials.from_environment(credentials)


def _required(variable: str) -> str:
    # The children, who run anybody's code, shall not have it.
    value = os.environ.pop(variable, "")
    if not value:
        raise ConfigError(
            f"{variable} is not set. An agent is started by a Fiber backend, which hands it the "
            "master's address and its credentials."
        )
    return value


if __name__ == "__main__":
    sys.exit(Main().run())
