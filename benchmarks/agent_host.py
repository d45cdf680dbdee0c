"""Process with many fake agents, each with its own link: `python -m benchmarks.agent_host`.

The links are real, from dialling to the last frame. So is `AgentService`, which does what the
master's frames say. Only the children are fake. The process reads one JSON object, an `Order`, from
standard input. It ends when all its agents have ended, or when standard input ends. Standard output
has "up" before the process reads, and the reason if an agent could not join, which ends the
process.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict, dataclass
from typing import Any

from benchmarks.fake_agents import FakeAgent, TaskRunner

from fiber._agent.service import AgentService
from fiber._transport.authentication import Identity
from fiber._transport.credentials import Credentials
from fiber._transport.dialer import AgentDialer
from fiber._transport.link import Link
from fiber._transport.loop import Loop


@dataclass(frozen=True)
class Order:
    """Agents to play, and their master."""

    address: str
    credentials: list[dict[str, Any]]
    """Fields of `Credentials`, for each agent."""
    timeout: float

    def to_line(self) -> str:
        """Return the line for standard input."""
        return json.dumps(asdict(self)) + "\n"

    @classmethod
    def from_line(cls, line: str) -> Order:
        """Return the order that `to_line` described."""
        return cls(**json.loads(line))


class _NoHub:
    """Hub without objects: all that a service asks of a hub, and of its link to another."""

    def link(self, *_: object, **__: object) -> _NoHub:
        """Do nothing: no frames will come."""
        return self

    def flush(self) -> None:
        """Return no memory, because none is shared."""

    def unlink(self, *_: object) -> None:
        """Do nothing: there is nothing to end."""


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
        # The dialer calls back without an address, and its peer is always the master.
        agent: Any = FakeAgent(self._loop, "fake", self._runner)
        hub: Any = _NoHub()
        service = AgentService(
            self._loop,
            link,
            agent,
            hub,
            lambda *_: link.close("it ended", then=self._ended),
            reached_at="127.0.0.1",
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
    """Play the agents that standard input describes."""
    loop = Loop()
    print("up", flush=True)
    order = Order.from_line(sys.stdin.readline())
    host = AgentHost(loop, order)
    loop.register(0, _orphaned)
    loop.run()
    del host


if __name__ == "__main__":
    main()
