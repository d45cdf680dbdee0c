"""The default backend: one agent, in this very process."""

from __future__ import annotations

from fiber._agent.agent import Agent
from fiber._agent.interface import ChildObserver, ChildSpec
from fiber._agent.local_child import LocalChild
from fiber._hub.hub import Hub
from fiber._transport.loop import Loop


class LocalBackend:
    """Children are subprocesses of this program."""

    name = "local"
    elastic = False
    same_host = True
    same_pids = True
    sends_program = False

    def __init__(self, loop: Loop, host: str, hub: Hub | None) -> None:
        self._agent = Agent(loop, host, hub)

    def child(self, spec: ChildSpec, observer: ChildObserver) -> LocalChild:
        """A child of this very process."""
        return self._agent.child(spec, observer)

    def close(self) -> None:
        """Kill the children that are left."""
        self._agent.close()
