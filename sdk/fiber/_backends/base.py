"""What a backend is: it turns "I want a child" into one, wherever that runs."""

from __future__ import annotations

from typing import Protocol

from fiber._agent.interface import ChildHandle, ChildObserver, ChildSpec


class Backend(Protocol):
    """Owns the agents of one program."""

    name: str
    same_host: bool
    """Whether its agents run on the program's own host, so that descriptors can be handed over."""

    same_pids: bool
    """Whether the pids of its children are those of this host and this PID namespace."""

    elastic: bool
    """Whether a host may be made for a child: starting one does not wait for that."""

    @property
    def sends_program(self) -> bool:
        """Whether its agents have not the program's files, which their children need."""

    def child(self, spec: ChildSpec, observer: ChildObserver) -> ChildHandle:
        """A child to be started, at once or when there is room for it; raises what is known to be
        in the way.  From anywhere.
        """

    def close(self) -> None:
        """End every agent and its children.  Not on the loop's thread."""
