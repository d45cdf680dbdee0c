"""Messages of an agent that the master believes: those about the agent's own children."""

from __future__ import annotations

from typing import Any
from unittest import mock

import pytest

from fiber._agent.interface import ChildSpec
from fiber._backends.remote import RemoteAgent, RemoteChild
from fiber._wire import messages
from memory_link import SimulatedLoop
from unit.agent_children import Recorder


def agent_with_children(host: str, count: int) -> tuple[RemoteAgent, list[Recorder]]:
    nothing: Any = mock.MagicMock()
    agent = RemoteAgent(host, nothing, SimulatedLoop(), nothing, nothing, nothing)
    observers = [Recorder() for _ in range(count)]
    for number, observer in enumerate(observers):
        spec = ChildSpec(f"{host}-{number}", "fork", b"", b"", tasks=True)
        RemoteChild(agent, spec, observer).start()
    return agent, observers


@pytest.mark.parametrize(
    "message",
    [
        messages.Started(2, 1),
        messages.FromChild(2, b"forged"),
        messages.Recalled(2, (1, 2)),
        messages.Output(2, "forged"),
        messages.Exited(2, 0, -9, "forged"),
    ],
    ids=lambda message: type(message).__name__,
)
def test_an_agent_speaks_for_no_child_of_another(message: messages.Message) -> None:
    _, (_, other) = agent_with_children("victim", 2)
    before = dict(vars(other))
    liar, (own,) = agent_with_children("liar", 1)
    unheard = dict(vars(own))
    liar.on_frame(bytearray(message.encode()))
    assert vars(other) == before
    assert vars(own) == unheard


def test_the_end_of_a_child_names_the_host_of_its_link() -> None:
    agent, (observer,) = agent_with_children("far", 1)
    agent.pod, agent.node = "es-1", "node-2"
    said = messages.Exited(1, 0, -9, "killed", (), None, (), "another host")
    agent.on_frame(bytearray(said.encode()))
    report = observer.report
    assert report is not None
    assert (report.host, report.pod, report.node) == ("far", "es-1", "node-2")
