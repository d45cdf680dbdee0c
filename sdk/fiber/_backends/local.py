"""Interface of a backend, and the default backend: one agent in the program's own process."""

from __future__ import annotations

from typing import Protocol

from fiber._agent.agent import Agent, LocalChild
from fiber._agent.interface import ChildHandle, ChildObserver, ChildSpec
from fiber._hub.hub import Hub
from fiber._transport.loop import Loop


class Backend(Protocol):
    """Owns the agents of one program."""

    name: str
    same_host: bool
    """True if its agents run on the program's host, so that descriptors can be handed over."""

    same_pids: bool
    """True if the pids of its children are those of this host and this PID namespace."""

    elastic: bool
    """True if a host may be made for a child.  Starting a child does not wait for its host."""

    @property
    def sends_program(self) -> bool:
        """True if its agents need the program's files for their children."""

    def child(self, spec: ChildSpec, observer: ChildObserver) -> ChildHandle:
        """A child to be started, at once or when there is room for it; raises what is known to be
        in the way.  From anywhere.
        """

    def close(self) -> None:
        """End every agent and its children.  Not on the loop's thread."""


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
