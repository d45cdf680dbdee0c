"""Notices of an agent about the end of its link."""

from __future__ import annotations

from typing import Any
from unittest import mock

import pytest

from fiber._agent.service import AgentService, _Observed
from fiber._wire import messages
from fiber._wire.packet import Message
from memory_link import SimulatedLoop


@pytest.fixture
def service() -> tuple[AgentService, list[tuple[str, bool]]]:
    ends: list[tuple[str, bool]] = []
    nothing: Any = mock.MagicMock()

    def on_end(reason: str, lost: bool) -> None:
        ends.append((reason, lost))

    loop: Any = SimulatedLoop()
    return AgentService(loop, nothing, nothing, nothing, on_end), ends


def test_a_lost_master_is_distinguished_from_one_that_ends(service: Any) -> None:
    served, ends = service
    served.on_lost("silence")
    assert ends == [("lost the master: silence", True)]


@pytest.mark.parametrize("reason", ["lost patience", "told to end by SIGTERM"])
def test_no_word_of_the_reason_decides(service: Any, reason: str) -> None:
    served, ends = service
    served.stop(reason, 0)
    assert ends == [(reason, False)]


def test_a_link_that_is_lost_after_the_master_ended_is_not_the_reason(service: Any) -> None:
    served, ends = service
    served.on_frame(messages.Shutdown(0).encode())
    served.on_lost("it closed the link")
    assert ends == [("the master ended", False)]


def test_a_child_with_a_large_result_is_paused_until_the_result_has_left() -> None:
    link, child, nothing = mock.Mock(), mock.Mock(), mock.MagicMock()
    loop: Any = SimulatedLoop()
    service = AgentService(loop, link, nothing, nothing, nothing)
    observed = _Observed(service, 1)
    observed._child = child
    observed.received(Message(memoryview(b"small"), [], []))
    assert not child.mock_calls
    observed.received(Message(memoryview(b"large"), [memoryview(bytes(8 << 20))], []))
    assert child.mock_calls == [mock.call.pause()]
    link.send.call_args.kwargs["on_left"]()
    assert child.mock_calls == [mock.call.pause(), mock.call.resume()]


def test_output_waits_for_output_of_the_same_child_and_not_for_large_messages() -> None:
    link, nothing = mock.Mock(), mock.MagicMock()
    loop: Any = SimulatedLoop()
    service = AgentService(loop, link, nothing, nothing, nothing)
    child, other = _Observed(service, 1), _Observed(service, 2)
    service.send(messages.FromChild(1, b"", [bytes(8 << 20)]))
    assert not child.busy()
    child.wrote("x" * (8 << 20))
    assert child.busy()
    assert not other.busy()
    link.send.call_args.kwargs["on_left"]()
    assert not child.busy()
