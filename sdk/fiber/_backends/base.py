"""What a backend is: it turns "I want a child" into an agent that can run it."""

from __future__ import annotations

from typing import Protocol

from fiber._agent.interface import AgentHandle


class Backend(Protocol):
    """Owns the agents of one program."""

    name: str
    same_host: bool
    """Whether its agents run on the program's own host, so that descriptors can be handed over."""

    @property
    def sends_program(self) -> bool:
        """Whether its agents have not the program's files, which their children need."""

    def place(self) -> AgentHandle:
        """The agent for the next child, at once, though it may not have joined yet; StartError if
        none can take one more.
        """

    def close(self) -> None:
        """End every agent and its children.  Not on the loop's thread."""
