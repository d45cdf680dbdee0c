"""What an agent is told of the end of its link."""

from __future__ import annotations

from typing import Any
from unittest import mock

import pytest

from fiber._agent.service import AgentService
from fiber._wire import messages
from memory_link import SimulatedLoop


@pytest.fixture
def service() -> tuple[AgentService, list[tuple[str, bool]]]:
    ends: list[tuple[str, bool]] = []
    nothing: Any = mock.MagicMock()

    def on_end(reason: str, lost: bool) -> None:
        ends.append((reason, lost))

    loop: Any = SimulatedLoop()
    return AgentService(loop, nothing, nothing, nothing, on_end), ends


def test_a_master_that_is_lost_is_told_apart_from_one_that_ends(service: Any) -> None:
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
