"""Messages of an agent that the master believes: those about the agent's own children."""

from __future__ import annotations

import gc
import hashlib
import signal
from collections.abc import Callable
from typing import Any
from unittest import mock

import pytest

from fiber._agent.interface import ChildSpec
from fiber._backends.remote import RemoteAgent, RemoteChild
from fiber._transport.link_protocol import Lane
from fiber._wire import messages
from fiber._wire.blob_messages import DIGEST_BYTES, Holding
from fiber._wire.memory_files import BytesLike, share
from memory_link import SimulatedLoop
from unit.agent_children import ReadLink, Recorder


def agent_with_children(host: str, count: int) -> tuple[RemoteAgent, list[Recorder]]:
    nothing: Any = mock.MagicMock()
    link: Any = ReadLink()
    agent = RemoteAgent(host, link, SimulatedLoop(), nothing, nothing, nothing)
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
        messages.ChildOutput(2, "forged"),
        messages.Exited(2, 0, -9, "forged"),
    ],
    ids=lambda message: type(message).__name__,
)
def test_an_agent_speaks_for_no_child_of_another(message: messages.LinkMessage) -> None:
    _, (_, other) = agent_with_children("victim", 2)
    before = dict(vars(other))
    liar, (own,) = agent_with_children("liar", 1)
    unheard = dict(vars(own))
    liar.on_frame(bytearray(message.encode()))
    assert vars(other) == before
    assert vars(own) == unheard


def test_a_child_without_memory_on_a_pod_that_is_deleted_ended_by_its_own_doing() -> None:
    agent, (observer,) = agent_with_children("far", 1)
    agent.ending, agent.disrupted = "Deleted: the pod was deleted", True
    said = messages.Exited(1, 0, -signal.SIGKILL, "OOMKilled: the limit is 1 GiB", (), None, ())
    agent.on_frame(bytearray(said.encode()))
    report = observer.report
    assert report is not None
    assert (report.reason, report.disrupted) == ("OOMKilled: the limit is 1 GiB", False)


def test_the_end_of_a_child_names_the_host_of_its_link() -> None:
    agent, (observer,) = agent_with_children("far", 1)
    agent.pod, agent.node = "es-1", "node-2"
    said = messages.Exited(1, 0, -9, "killed", (), None, (), "another host")
    agent.on_frame(bytearray(said.encode()))
    report = observer.report
    assert report is not None
    assert (report.host, report.pod, report.node) == ("far", "es-1", "node-2")


def test_a_child_whose_end_is_not_reported_ends_with_the_link_of_its_agent() -> None:
    agent, (observer,) = agent_with_children("far", 1)
    agent.on_frame(bytearray(messages.Started(1, 1).encode()))
    assert observer.report is None, "no word of its agent, so join() waits"
    agent.on_lost("the pod was deleted")
    assert observer.report is not None


def shared_packet() -> memoryview:
    buffer = memoryview(bytes(range(256)))
    share(buffer)
    return buffer


def running_child(link: Large) -> tuple[SimulatedLoop, RemoteAgent, RemoteChild, Recorder]:
    nothing: Any = mock.MagicMock()
    loop, observer = SimulatedLoop(), Recorder()
    agent = RemoteAgent("far", link, loop, nothing, nothing, nothing)  # type: ignore[arg-type]
    child = RemoteChild(agent, ChildSpec("child", "fork", b"", b"", tasks=True), observer)
    child.start()
    loop.run_for(0)
    for _ in ("the preparation", "the start"):
        for left in link.take_leaving():
            left()
    link.sent.clear()
    return loop, agent, child, observer


def test_a_packet_waits_for_its_blobs_and_later_packets_for_it() -> None:
    link, large = Large(), shared_packet()
    _, _, child, _ = running_child(link)
    child.deliver(1, b"first")
    child.deliver(2, b"second", [memoryview(b"small"), large])
    child.deliver(3, b"third")
    assert link.kinds() == ["Deliver", "KeepBlob"]
    for left in link.take_leaving():
        left()
    assert link.kinds() == ["Deliver", "KeepBlob", "DeliverShared", "Deliver"]
    shared = link.sent[2]
    assert isinstance(shared, messages.DeliverShared)
    digest = hashlib.sha256(large).digest()
    assert (shared.seq, shared.shared, len(shared.buffers)) == (2, ((1, digest),), 1)


@pytest.mark.parametrize("how", ["recalled", "ended"])
def test_packets_that_wait_for_a_blob_are_given_back(how: str) -> None:
    link, large = Large(), shared_packet()
    _, agent, child, observer = running_child(link)
    child.deliver(2, b"second", [large])
    child.deliver(3, b"third")
    if how == "recalled":
        agent.on_frame(bytearray(messages.Recalled(1, (1,)).encode()))
        assert observer.unread == [1, 2, 3]
    else:
        agent.on_lost("the pod was deleted")
        assert observer.report is not None
        assert observer.report.unread == (2, 3)
    for left in link.take_leaving():
        left()
    assert "DeliverShared" not in link.kinds()


def test_a_blob_is_kept_until_the_packet_that_names_it_has_left() -> None:
    link, large = Large(), shared_packet()
    loop, _, child, _ = running_child(link)
    child.deliver(2, b"second", [large])
    del large
    (left,) = link.take_leaving()
    left()
    del left
    gc.collect()
    loop.run_for(0)
    assert link.kinds() == ["KeepBlob", "DeliverShared"]
    for left in link.take_leaving():
        left()
    del left
    gc.collect()
    loop.run_for(0)
    assert link.kinds() == ["KeepBlob", "DeliverShared", "Forget"]


class Large(ReadLink):
    """A link on which blobs and starts are large: they leave when the test says so."""

    def __init__(self) -> None:
        super().__init__()
        self.leaving: list[Callable[[], None]] = []

    def send(
        self, *frame: BytesLike, lane: Lane = None, on_left: Callable[[], None] | None = None
    ) -> None:
        super().send(*frame, lane=lane)
        if on_left is not None:
            self.leaving.append(on_left)

    def take_leaving(self) -> list[Callable[[], None]]:
        """Return what is to be called for all messages that have not left."""
        taken, self.leaving = self.leaving, []
        return taken

    def kinds(self) -> list[str]:
        return [type(message).__name__ for message in self.sent]


@pytest.fixture
def large() -> tuple[Large, SimulatedLoop, RemoteAgent, RemoteChild, Recorder]:
    link, loop, observer = Large(), SimulatedLoop(), Recorder()
    nothing: Any = mock.MagicMock()
    agent = RemoteAgent("far", link, loop, nothing, nothing, nothing)  # type: ignore[arg-type]
    child = RemoteChild(agent, ChildSpec("child", "fork", b"", b"", tasks=True), observer)
    child.start()
    child.signal(signal.SIGUSR1)
    child.deliver(5, b"task")
    child.recall()
    loop.run_for(0)
    return link, loop, agent, child, observer


def test_a_start_follows_its_blobs_and_a_signal_its_start(large: Any) -> None:
    link, loop, _, child, _ = large
    assert link.kinds() == ["KeepBlob"]
    link.leaving.pop(0)()
    assert link.kinds() == ["KeepBlob", "Start", "Deliver"]
    link.leaving.pop(0)()
    assert link.kinds() == ["KeepBlob", "Start", "Deliver", "Signal", "Recall"]
    child.signal(signal.SIGKILL)
    loop.run_for(0)
    assert link.kinds()[5:] == ["Signal"]


@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGKILL])
def test_a_child_is_killed_before_its_blobs_have_left(large: Any, signum: signal.Signals) -> None:
    link, loop, agent, child, observer = large
    child.signal(signum)
    loop.run_for(0)
    report = observer.wait_for_exit()
    assert (report.exitcode, report.unread) == (-signum, (5,))
    assert report.reason == f"killed by {signum.name} before it began"
    agent._observer.child_gone.assert_called_once_with(agent)
    link.leaving.pop(0)()
    assert link.kinds() == ["KeepBlob"]


def test_a_lost_agent_is_not_heard(large: Any) -> None:
    _, _, agent, _, _ = large
    blobs = mock.Mock()
    agent.lose("the pod was deleted")
    agent._blobs = blobs
    agent.on_frame(bytearray(Holding(bytes(DIGEST_BYTES), 1).encode()))
    assert not blobs.mock_calls


def test_packets_of_a_child_whose_agent_is_lost_before_its_start_are_unread(large: Any) -> None:
    link, _, agent, _, observer = large
    agent.on_lost("silence")
    assert observer.wait_for_exit().unread == (5,)
    link.leaving.pop(0)()
    assert link.kinds() == ["KeepBlob"]
