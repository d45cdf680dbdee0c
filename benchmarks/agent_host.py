"""A process with many fake agents, each with a link of its own: `python -m benchmarks.agent_host`.

The links are real, from dialling to the last frame, and so is `AgentService`, which does what the
master's frames say. Only the children are fake. It reads one JSON object from standard input, what
`Order` holds, and ends when all its agents have ended, or when standard input does. Standard output
says "up" before it reads, and why an agent could not join, which ends the process.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.fake_agents import FakeAgent, TaskRunner

from fiber._agent.service import AgentService
from fiber._transport.credentials import Credentials
from fiber._transport.dialer import AgentDialer
from fiber._transport.handshake import Identity
from fiber._transport.link import Link
from fiber._transport.loop import Loop


@dataclass(frozen=True)
class Order:
    """Which agents to be, and for which master."""

    address: str
    credentials: list[dict[str, Any]]
    """The fields of `Credentials`, of each agent."""
    timeout: float

    def to_line(self) -> str:
        """For standard input."""
        return json.dumps(asdict(self)) + "\n"

    @classmethod
    def from_line(cls, line: str) -> Order:
        """What `to_line` made."""
        return cls(**json.loads(line))


class _NoHub:
    """No object is shared here: all that a service asks of a hub, and of its link to another."""

    def link(self, *_: object, **__: object) -> _NoHub:
        """There will be no frames for it."""
        return self

    def flush(self) -> None:
        """No memory is shared, either."""

    def unlink(self, *_: object) -> None:
        """Nor is there anything to end."""


class AgentHost:
    """All agents of the process, on one loop."""

    def __init__(self, loop: Loop, order: Order) -> None:
        self._loop = loop
        self._runner = TaskRunner()
        agents = [Credentials(**fields) for fields in order.credentials]
        self._left = len(agents)
        self._services: list[AgentService] = []
        self._dialers = [
            AgentDialer(
                loop,
                order.address,
                credentials,
                Identity.of_this_process(credentials.name, credentials.uid),
                on_link=self._joined,
                on_failed=_give_up,
                timeout=order.timeout,
            )
            for credentials in agents
        ]

    def _joined(self, link: Link) -> None:
        # The dialer calls back without saying which; the peer is the master, whoever we are.
        agent: Any = FakeAgent(self._loop, "fake", self._runner)
        hub: Any = _NoHub()
        service = AgentService(
            self._loop, link, agent, hub, lambda *_: link.close("it ended", then=self._ended)
        )
        self._services.append(service)
        link.attach(service)

    def _ended(self) -> None:
        self._left -= 1
        if not self._left:
            self._loop.stop()


def _give_up(error: Exception) -> None:
    print(f"{type(error).__name__}: {error}", flush=True)
    os._exit(1)


def _orphaned() -> None:
    if not os.read(0, 1):
        os._exit(1)


def main() -> None:
    """Be the agents that standard input asks for."""
    loop = Loop()
    print("up", flush=True)
    order = Order.from_line(sys.stdin.readline())
    host = AgentHost(loop, order)
    loop.register(0, _orphaned)
    loop.run()
    del host


if __name__ == "__main__":
    main()
