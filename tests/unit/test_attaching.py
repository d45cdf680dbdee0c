"""A process reports that it has a handle after its hub knows: the grant may end then.

Host ``a`` has the objects; this process is on host ``b``, and the link from there carries nothing
until it is let go.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest

import fiber
from census import wait_until
from fiber import reduction
from fiber._agent.worker import BatchRunner
from fiber._hub.client import HubStream
from fiber._hub.handles import GrantSet, collecting_grants
from fiber._hub.local import LocalChannel
from fiber._hub.protocol import Op
from fiber._hub.queue_delivery import become_reader
from fiber._wire import packet, work
from fiber.connection import Connection
from hosts import Hosts, Wire, background
from patience import PATIENCE


@pytest.fixture
def wire(hosts: Hosts, wires: tuple[Wire, Wire]) -> Iterator[Wire]:
    """From here to host a."""
    with hosts.at("b"):
        yield wires[0]


@pytest.fixture
def is_confirming(monkeypatch: pytest.MonkeyPatch) -> Callable[[], bool]:
    """Return a function that says whether the hub was asked for a confirmation."""
    asked = []
    ask = HubStream.ask

    def noting(self: HubStream, operation: Op, *args: Any, **options: Any) -> Any:
        asked.append(operation)
        return ask(self, operation, *args, **options)

    monkeypatch.setattr(HubStream, "ask", noting)
    return lambda: Op.SYNC in asked


class Results:
    """Receiver of a worker's answers."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def send(self, payload: bytes, buffers: Any = ()) -> None:
        self.sent.append(payload)


KEPT: list[Any] = []


def keep(thing: Any) -> None:
    KEPT.append(thing)


def keep_and_return(thing: Any) -> list[str]:
    """Return a value that no short answer can carry."""
    KEPT.append(thing)
    return ["a list"]


def forget(thing: Any) -> int:
    return 1


def call(function: Callable[[Any], Any], thing: Any) -> tuple[bytes, GrantSet]:
    """Send it as ``apply`` does."""
    payload, buffers, grants = reduction.encode_reusable((function, (thing,), {}))
    assert grants is not None
    return work.pack_calls([(payload, buffers)]), grants


def several_calls(function: Callable[[Any], Any], thing: Any) -> tuple[bytes, GrantSet]:
    """Send them as ``apply_async`` does."""
    payload, buffers, grants = reduction.encode_reusable((function, (thing,), {}))
    assert grants is not None
    return work.pack_calls([packet.dumps((abs, (-1,), {})), (payload, buffers)]), grants


def batch(function: Callable[[Any], Any], thing: Any, stride: int = 0) -> tuple[bytes, GrantSet]:
    """Send it as ``map`` does."""
    data = pickle.dumps(function)
    payload, _, grants = reduction.encode_reusable([thing])
    assert grants is not None
    head = work.Head(work.MAP, stride, 1, 1, len(data), 0)
    return work.pack_batch(head, data, payload), grants


KINDS = [call, several_calls, batch, partial(batch, stride=1), partial(batch, stride=9)]


@pytest.fixture(params=KINDS, ids=["call", "calls", "eager", "single", "stride"])
def lend(
    request: pytest.FixtureRequest, hosts: Hosts, wire: Wire
) -> Iterator[Callable[[Any], tuple[Connection, packet.Message, GrantSet]]]:
    """Call a function with one end of a pipe; return the other end, the message, and its grants."""
    made = []

    def lend(function: Callable[[Any], Any]) -> tuple[Connection, packet.Message, GrantSet]:
        with hosts.at("a"):
            reader, writer = fiber.Pipe()
            message, grants = request.param(function, writer)
        writer.close()
        made.append(reader)
        payload = memoryview(work.SEQ.pack(1) + message)
        return reader, packet.Message(payload, [], []), grants

    yield lend
    for reader in made:
        reader.close()


@pytest.fixture
def worker(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[BatchRunner, Results]]:
    """Make a worker that splits no batch, however slow the machine is."""
    monkeypatch.setattr("fiber._agent.worker.SPLIT_AFTER", PATIENCE)
    monkeypatch.setattr("fiber._agent.worker.Watchdog.begin", lambda self, batch: None)
    results = Results()
    worker = BatchRunner(results, memoryview(bytearray(24)).cast("Q"))
    yield worker, results
    worker.close()


@pytest.mark.parametrize("function", [keep, keep_and_return])
def test_a_result_comes_after_the_kept_objects_are_attached(
    lend: Callable[..., tuple[Connection, packet.Message, GrantSet]],
    worker: tuple[BatchRunner, Results],
    wire: Wire,
    is_confirming: Callable[[], bool],
    function: Callable[[Any], Any],
) -> None:
    reader, message, grants = lend(function)
    runs, results = worker
    wire.hold()
    thread = background(runs.handle, message)
    assert wait_until(lambda: bool(results.sent) or is_confirming(), PATIENCE)
    assert not results.sent
    wire.let_go()
    thread.join(PATIENCE)
    assert len(results.sent) == 1
    grants.release()
    with KEPT.pop() as kept:
        kept.send("still there")
    assert reader.recv() == "still there"


def test_objects_that_a_task_drops_are_not_waited_for(
    lend: Callable[..., tuple[Connection, packet.Message, GrantSet]],
    worker: tuple[BatchRunner, Results],
    wire: Wire,
) -> None:
    _, message, grants = lend(forget)
    runs, results = worker
    wire.hold()
    runs.handle(message)
    assert len(results.sent) == 1
    wire.let_go()
    grants.release()


def use_and_keep(thing: Any) -> None:
    thing.send("used")
    KEPT.append(thing)


def test_used_objects_need_no_confirmation(
    lend: Callable[..., tuple[Connection, packet.Message, GrantSet]],
    worker: tuple[BatchRunner, Results],
    is_confirming: Callable[[], bool],
) -> None:
    reader, message, grants = lend(use_and_keep)
    worker[0].handle(message)
    grants.release()
    assert not is_confirming()
    assert reader.recv() == "used"
    KEPT.pop().close()


def test_a_reader_says_that_it_has_its_channel_after_that_is_attached(
    hosts: Hosts, wire: Wire, is_confirming: Callable[[], bool]
) -> None:
    with hosts.at("a"):
        ours, theirs = LocalChannel.pair()
        with collecting_grants(reusable=False) as grants:
            invitation = pickle.dumps(theirs)
        theirs.close()
    arrivals, door = LocalChannel.pair()
    wire.hold()
    arrived: list[Any] = []
    thread = background(lambda: arrived.append(become_reader(door)))
    answer: Any = packet.loads(arrivals.recv())
    answer.send(invitation)
    assert wait_until(lambda: answer.poll(0) or is_confirming(), PATIENCE)
    assert not answer.poll(0)
    wire.let_go()
    thread.join(PATIENCE)
    answer.recv().release()
    grants.release()
    ours.send(b"an item")
    assert arrived[0].recv().tobytes() == b"an item"
    for channel in (*arrived, answer, arrivals, door, ours):
        channel.close()
