"""Blobs that many children need: they go to each agent once, and end there with their last user."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import census
import fiber
from fiber import reduction
from fiber._agent.blobs import BlobExchange, BlobLacking, BlobStore
from fiber._backends.blobs import BlobSender, Fanout
from fiber._engine.fanout import COPIES, WIDTH, WORTH
from fiber._runtime import state
from fiber._runtime.state import SharedArguments
from fiber._wire import messages
from fiber._wire.blob_messages import Fetch, Forget, Holding, KeepBlob, Lacking, Serve
from fiber._wire.descriptor import contents
from fiber._wire.memory_files import Blob
from memory_link import SimulatedLoop
from patience import PATIENCE
from processes.test_loopback import running

LARGE = 3 << 20


class Sent:
    """Messages to one agent."""

    def __init__(self, fanout: Fanout | None = None) -> None:
        self.loop = SimulatedLoop()
        self.messages: list[Any] = []
        self.leaving: list[Callable[[], None] | None] = []
        self.ready: list[str] = []
        """Callers whose blobs have left."""
        self.parcels = BlobSender(self.loop, self.send, fanout)

    def send(
        self, message: messages.LinkMessage, on_left: Callable[[], None] | None = None
    ) -> None:
        self.messages.append(message)
        self.leaving.append(on_left)

    def need(self, *blobs: Blob, caller: str = "") -> None:
        self.parcels.send_missing(blobs, lambda: self.ready.append(caller))

    def leave(self) -> None:
        """The oldest message is on its way."""
        on_left = self.leaving.pop(0)
        assert on_left is not None
        on_left()

    def kinds(self) -> list[str]:
        """Return the messages since the last call."""
        self.loop.run_for(0)
        sent, self.messages = self.messages, []
        return [f"{type(message).__name__} {message.digest[:2].hex()}" for message in sent]


def name(blob: Blob) -> str:
    return blob.digest[:2].hex()


def test_a_blob_is_sent_once_and_forgotten_with_its_last_holder() -> None:
    sent, one, other = Sent(), Blob(b"one"), Blob(b"other")
    sent.need(one, other)
    sent.need(other, one)
    known, gone = name(one), name(other)
    assert sent.kinds() == [f"KeepBlob {known}", f"KeepBlob {gone}"]
    del other
    assert sent.kinds() == [f"Forget {gone}"]
    sent.need(one, Blob(b"other"))
    assert sent.kinds()[0] == f"KeepBlob {gone}"


def test_the_same_content_made_anew_in_time_is_not_sent_again() -> None:
    sent, first = Sent(), Blob(b"content")
    sent.need(first)
    del first  # the loop has the notice and has not looked yet
    second = Blob(b"content")
    sent.need(second)
    assert sent.kinds() == [f"KeepBlob {name(second)}"]
    del second
    assert len(sent.kinds()) == 1


def test_a_blob_that_an_agent_could_not_keep_is_sent_again() -> None:
    sent, blob = Sent(), Blob(b"content")
    sent.need(blob)
    sent.parcels.on_report(Lacking(blob.digest))
    sent.need(blob)
    assert sent.kinds() == [f"KeepBlob {name(blob)}"] * 2


def test_no_agent_costs_a_copy_of_the_content() -> None:
    content = b"content"
    blob = Blob(content)
    message = KeepBlob(blob.digest, blob.data)
    assert messages.decode(message.encode()) == message
    assert messages.pieces(message)[-1] is content
    assert bytes(contents(blob.fileno())) == content


def test_a_caller_waits_for_the_blobs_that_it_needs_and_for_no_others() -> None:
    sent, one, other = Sent(), Blob(b"one"), Blob(b"other")
    sent.need(one, caller="first")
    sent.need(one, other, caller="second")
    sent.need(other, caller="third")
    assert sent.ready == []
    sent.leave()
    assert sent.ready == ["first"]
    sent.leave()
    assert sent.ready == ["first", "second", "third"]
    sent.need(other, one, caller="fourth")
    assert sent.ready[3:] == ["fourth"]


def test_a_blob_that_is_sent_again_has_left_when_both_have() -> None:
    sent, blob = Sent(), Blob(b"content")
    sent.need(blob)
    sent.parcels.on_report(Lacking(blob.digest))
    sent.need(blob, caller="again")
    sent.leave()
    assert sent.ready == []
    sent.leave()
    assert sent.ready == ["", "again"]


def test_a_blob_is_kept_while_one_of_two_objects_with_its_content_lives() -> None:
    sent, first, second = Sent(), Blob(b"content"), Blob(b"content")
    sent.need(first)
    sent.need(second)
    del second
    assert sent.kinds() == [f"KeepBlob {name(first)}"]
    del first
    assert len(sent.kinds()) == 1


@pytest.mark.parametrize("report", ["left", "holding"])
def test_the_report_of_an_order_before_a_forget_is_not_that_of_the_next(report: str) -> None:
    fanout, data = Fanout(0), bytes(WORTH)
    sent, other = Sent(fanout), Sent(fanout)
    blob, again = Blob(data), Blob(data)
    sent.need(blob, caller="first")
    (left,) = filter(None, sent.leaving)
    assert sent.kinds() == [f"KeepBlob {name(blob)}", f"Serve {name(blob)}"]
    other.need(again)
    del blob
    assert [kind.split()[0] for kind in sent.kinds()] == ["Forget"]
    assert sent.ready == ["first"], "the blob is forgotten, so no caller waits for it"
    sent.need(again, caller="again")
    if report == "left":
        left()
    else:
        sent.parcels.on_report(Holding(again.digest, 1))
    assert "again" not in sent.ready
    (*_, serve) = sent.messages
    sent.parcels.on_report(Holding(again.digest, serve.number))
    assert sent.ready == ["first", "again"]


def test_a_late_report_of_a_receiver_whose_source_is_lost_is_not_counted() -> None:
    fanout, blob = Fanout(0), Blob(bytes(WORTH))
    agents = [Sent(fanout) for _ in range(COPIES + 2 * WIDTH)]
    for agent in agents:
        agent.need(blob)

    def order_of(agent: Sent) -> Any:
        return next((one for one in agent.messages[::-1] if isinstance(one, Serve | Fetch)), None)

    def has_it(agent: Sent) -> None:
        order = order_of(agent)
        key = "0" * 64
        holding = Holding(blob.digest, order.number, "127.0.0.1:1", key, key)
        agent.parcels.on_report(holding)

    source = agents[0]
    has_it(source)
    (receiver, *_) = (agent for agent in agents if isinstance(order_of(agent), Fetch))
    late = Holding(blob.digest, order_of(receiver).number)
    source.parcels.close()  # the agent is lost
    assert order_of(receiver).number == late.number, "it waits for a free source"
    receiver.parcels.on_report(late)
    assert receiver.ready == []
    for agent in agents[1:]:
        while agent.ready == [] and order_of(agent) is not None:
            has_it(agent)
    assert [agent.ready for agent in agents] == [[""]] * len(agents)


@pytest.mark.parametrize("error", [OSError(24, "Too many open files"), RuntimeError("no thread")])
def test_an_agent_that_cannot_serve_says_that_it_has_the_blob(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise error

    monkeypatch.setattr("fiber._agent.blobs.BlobSource", refuse)
    said: list[messages.LinkMessage] = []
    loop: Any = SimulatedLoop()
    digest = Blob(b"content").digest
    exchange = BlobExchange(loop, BlobStore(None), "127.0.0.1", said.append)
    exchange.serve(Serve(digest, 7, 0))
    assert said == [Holding(digest, 7)]


@pytest.mark.parametrize("data", [b"", b"content"])
def test_a_store_keeps_a_blob_until_the_release(data: bytes, tmp_path: Any) -> None:
    store, digest = BlobStore(str(tmp_path)), Blob(data).digest
    store.put(KeepBlob(digest, data))
    held = store.get(digest)
    store.forget(digest)
    with pytest.raises(BlobLacking, match="it was forgotten"):
        store.get(digest)
    assert bytes(contents(held.fileno())) == data, "who has it still has it"
    assert os.listdir(tmp_path) == []


def test_a_store_without_room_says_so_once_and_keeps_the_next(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    store, message = BlobStore(str(tmp_path)), KeepBlob(Blob(b"x").digest, b"x")
    monkeypatch.setattr(Blob, "in_file", full)
    store.put(message)
    with pytest.raises(BlobLacking, match="No space left on device") as caught:
        store.get(message.digest)
    assert caught.value.digest == message.digest
    monkeypatch.undo()
    store.put(message)
    assert store.get(message.digest).digest == message.digest


# Arguments of a pool's workers


class Counted:
    """Counts how often it is pickled."""

    pickled = 0

    def __init__(self) -> None:
        self.content = bytes(LARGE)

    def __reduce__(self) -> tuple[Any, ...]:
        Counted.pickled += 1
        return bytes, (self.content,)


_kept: Any = None


def keep(*values: Any) -> None:
    global _kept
    _kept = values


def size_of_kept(_: object = None) -> int:
    return len(_kept[0])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_large_arguments_are_pickled_once_for_all_workers(method: str) -> None:
    Counted.pickled = 0
    with fiber.get_context(method).Pool(3, keep, (Counted(),)) as pool:
        assert pool.map(size_of_kept, range(6), chunksize=1) == [LARGE] * 6
    assert Counted.pickled == 1


def test_an_object_with_a_handle_is_pickled_for_each() -> None:
    ours, theirs = fiber.Pipe()
    for same_host in (True, False):
        assert reduction.dump_shared((theirs,), same_host=same_host) is None
    assert reduction.dump_shared(("plain",), same_host=True) is not None
    before = len(os.listdir("/proc/self/fd"))
    assert SharedArguments((theirs, bytes(LARGE))).blob(same_host=True) is None
    # Only now may the grants of the earlier ones end.
    assert census.wait_until(lambda: len(os.listdir("/proc/self/fd")) <= before, PATIENCE)
    ours.close()
    theirs.close()


def test_an_object_that_does_not_pickle_is_named() -> None:
    with pytest.raises(fiber.UnpicklableError, match=r"^initargs\[1\] of the pool cannot"):
        fiber.Pool(1, keep, (bytes(LARGE), (i for i in range(3))))


def test_small_arguments_stay_with_their_worker() -> None:
    assert SharedArguments((keep, (1,), ())).blob(same_host=True) is None


@pytest.fixture
def backend() -> Iterator[Any]:
    with running() as made:
        yield made


def blobs_at(backend: Any) -> int:
    """Bytes of what the agent holds open without a name, as its own descriptors say."""
    pid = backend._slots[0].process.pid
    total = 0
    for fd in os.listdir(f"/proc/{pid}/fd"):
        path = f"/proc/{pid}/fd/{fd}"
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            if "(deleted)" in os.readlink(path) and "memfd" not in os.readlink(path):
                total += os.stat(path).st_size
    return total


@pytest.mark.slow
def test_an_agent_is_sent_them_once_and_forgets_them_after_the_pool(backend: Any) -> None:
    with fiber.Pool(4, keep, (os.urandom(LARGE),)) as pool:
        assert pool.map(size_of_kept, range(8)) == [LARGE] * 8
        pool.wait_until_workers_up(PATIENCE)  # the agent sends each of them a duplicate
        sent = backend.agents.agents["loopback-0"]._link.statistics().bytes_sent
        assert LARGE < sent < 1.5 * LARGE
        assert LARGE < blobs_at(backend) < 1.5 * LARGE
        pool.terminate()
        pool.join()
    del pool

    def forgotten() -> bool:
        gc.collect()
        return blobs_at(backend) < LARGE

    assert census.wait_until(forgotten, PATIENCE)


def test_a_worker_whose_arguments_are_lost_is_started_anew_with_them(backend: Any) -> None:
    # As if the agent had found no room for them: it says so, and they are sent again.
    shared = SharedArguments((keep, (bytes(LARGE),), ()))
    blob = shared.blob(same_host=False)
    assert blob is not None
    assert census.wait_until(lambda: "loopback-0" in backend.agents.agents, PATIENCE)
    agent = backend.agents.agents["loopback-0"]
    backend._loop.call_soon(agent._blobs.send_missing, [blob], lambda: None)
    agent.send(Forget(blob.digest))
    with fiber.Pool(1, keep, (bytes(LARGE),)) as pool:
        assert pool.apply(size_of_kept) == LARGE
    assert state.runtime().backend is backend


@pytest.mark.slow
def test_the_agent_that_replaces_a_lost_one_is_sent_them_too(backend: Any) -> None:
    with fiber.Pool(1, keep, (bytes(LARGE),)) as pool:
        assert pool.apply(size_of_kept) == LARGE
        os.kill(backend._slots[0].process.pid, signal.SIGKILL)
        assert pool.apply(size_of_kept) == LARGE
        assert backend._slots[0].name == "loopback-1"
