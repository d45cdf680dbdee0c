"""Interface of a backend, which makes children wherever they run."""

from __future__ import annotations

from typing import Protocol

from fiber._agent.interface import ChildHandle, ChildObserver, ChildSpec


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
