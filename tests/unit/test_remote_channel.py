"""Direct use of a worker on another host, as ``Leases`` uses it."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from threading import Thread
from typing import Any
from unittest import mock

import pytest

from fiber._agent.interface import ChildSpec
from fiber._backends import remote
from fiber._backends.remote import RemoteAgent, RemoteChild
from fiber._wire import messages
from fiber._wire.packet import Message
from memory_link import SimulatedLoop
from unit.agent_children import ReadLink, Recorder

FOREVER = 60.0


class Far:
    """The master's side of one worker on another host, and what it sends there."""

    def __init__(self) -> None:
        self.loop = SimulatedLoop()
        self.link = ReadLink()
        link: Any = self.link
        nothing: Any = mock.MagicMock()
        self.agent = RemoteAgent("far", link, self.loop, nothing, nothing, nothing)
        self.observer = Recorder()
        spec = ChildSpec("child", "fork", b"", b"", tasks=True)
        self.child = RemoteChild(self.agent, spec, self.observer)
        self.child.start()

    def sent(self) -> list[int]:
        """The packets that the link was given."""
        self.loop.run_for(0)
        sent = self.link.sent
        return [message.seq for message in sent if isinstance(message, messages.Deliver)]

    def says(self, word: object) -> None:
        """The worker sends a packet."""
        self.agent.on_frame(bytearray(messages.FromChild(1, pickle.dumps(word)).encode()))

    def unread(self) -> Sequence[int]:
        """The packets that the report of the worker's end names as unread."""
        assert self.observer.report is not None
        return self.observer.report.unread

    def ends(self, delivered: int) -> None:
        """The worker is gone, after so many packets came in time."""
        self.agent.on_frame(messages.Exited(1, delivered, 0, "exit status 0").encode())


@pytest.fixture
def far() -> Far:
    return Far()


def word(message: Message | None) -> Any:
    assert message is not None
    return pickle.loads(message.payload)


def test_a_leased_worker_answers_its_caller(far: Far) -> None:
    channel = far.child.lease_channel()
    assert channel is not None
    channel.send(7, b"call")
    assert far.sent() == [7]
    far.says("answer")
    assert word(channel.receive(FOREVER)) == "answer"
    assert channel.receive(0) is None
    assert far.observer.words == []


def _says(far: Far) -> None:
    far.says("answer")


def _ends(far: Far) -> None:
    far.ends(delivered=0)


@pytest.mark.parametrize("event", [_says, _ends])
def test_a_waiting_caller_is_woken(far: Far, event: Callable[[Far], None]) -> None:
    channel = far.child.lease_channel()
    assert channel is not None
    heard: list[Any] = []

    def receive() -> None:
        try:
            heard.append(word(channel.receive(FOREVER)))
        except EOFError as error:
            heard.append(error)

    waiting = Thread(target=receive, daemon=True)
    waiting.start()
    while not channel._waiting:
        pass
    event(far)
    waiting.join(FOREVER)
    assert len(heard) == 1


def test_an_answer_that_the_caller_did_not_receive_goes_to_the_observer(far: Far) -> None:
    channel = far.child.lease_channel()
    assert channel is not None
    channel.send(7, b"call")
    far.says("late answer")
    far.child.reclaim()
    far.says("more")
    assert far.observer.words == ["late answer", "more"]


def test_an_answer_comes_before_the_end(far: Far) -> None:
    channel = far.child.lease_channel()
    assert channel is not None
    channel.send(7, b"call")
    assert far.sent() == [7]
    far.says("last words")
    far.ends(delivered=1)
    assert word(channel.receive(FOREVER)) == "last words"
    with pytest.raises(EOFError):
        channel.receive(FOREVER)
    with pytest.raises(BrokenPipeError):
        channel.send(8, b"call")


def test_a_call_that_the_worker_did_not_get_is_reported_as_unread(far: Far) -> None:
    channel = far.child.lease_channel()
    assert channel is not None
    channel.send(7, b"call")
    assert far.sent() == [7]
    far.ends(delivered=0)
    with pytest.raises(EOFError):
        channel.receive(FOREVER)
    assert far.unread() == (7,)


def test_the_remembered_packets_of_a_lost_child_are_named_as_unread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(remote, "_REMEMBERED", 4)
    far = Far()
    for seq in range(6):
        far.child.deliver(seq, b"call")
    far.ends(delivered=0)
    assert far.unread() == (2, 3, 4, 5)


def test_a_call_that_was_not_sent_raises_a_broken_pipe_error(far: Far) -> None:
    channel = far.child.lease_channel()
    assert channel is not None
    channel.send(7, b"call")  # waits for the loop, which gets the end first
    far.ends(delivered=0)
    with pytest.raises(BrokenPipeError):
        channel.receive(FOREVER)
    assert far.sent() == []
    assert far.unread() == ()
