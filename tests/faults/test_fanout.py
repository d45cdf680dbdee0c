"""Large blobs that agents pass on to each other, and agents that die or lie on the way."""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import signal
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

import fiber
from faults.program import wait_for
from faults.proxy import Proxy
from faults.runtime import running
from faults.test_strangers import GARBAGE, Bomb
from fiber import config
from fiber._agent.blobs import BlobFetch, BlobSource, BlobStore, _Receiver
from fiber._backends import loopback
from fiber._backends.blobs import BlobSender, Fanout
from fiber._backends.loopback import LoopbackBackend
from fiber._transport import link
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop
from fiber._wire import messages
from fiber._wire.blob_messages import RECEIVER, Fetch, Holding, KeepBlob, Want
from fiber_api import identity
from patience import PATIENCE

LARGE = 3 << 20
AGENTS = 7

_kept: tuple[Any, ...] = ()


def keep(*values: Any) -> None:
    global _kept
    _kept = values


def hash_of_kept(_: object = None) -> str:
    return hashlib.sha256(_kept[0]).hexdigest()


def sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def add(theta: bytes, seed: int) -> tuple[str, int]:
    """Return what tells whether the worker has the right arguments."""
    return sha(theta), seed


# Whole programs


@pytest.fixture(scope="module")
def shared_backend() -> Iterator[LoopbackBackend]:
    with running(backend="loopback", agents=AGENTS, pass_on="always") as runtime:
        backend = runtime.backend
        assert isinstance(backend, LoopbackBackend)
        backend._output.write("test", "begins")  # its thread is not the pool's
        yield backend


@pytest.fixture
def backend(shared_backend: LoopbackBackend) -> LoopbackBackend:
    """All agents are there, and are taken to reach each other."""
    wait_for(lambda: len(shared_backend.agents.agents) == AGENTS)
    fanout = shared_backend.agents._fanout
    assert fanout is not None
    fanout._reachable = True
    return shared_backend


def bytes_to_agents(backend: LoopbackBackend) -> int:
    agents = backend.agents.agents.values()
    return sum(agent._link.statistics().bytes_sent for agent in agents)


def run_pool(backend: LoopbackBackend) -> float:
    """Give arguments to a worker of each agent; return how many copies the master sent."""
    data, before = os.urandom(LARGE), bytes_to_agents(backend)
    expected = hashlib.sha256(data).hexdigest()
    with fiber.Pool(AGENTS, keep, (data,)) as pool:
        assert pool.broadcast(hash_of_kept) == [expected] * AGENTS
        return (bytes_to_agents(backend) - before) / LARGE


def test_the_master_sends_a_few_copies_and_agents_the_others(backend: LoopbackBackend) -> None:
    assert 1 <= run_pool(backend) < AGENTS  # COPIES, unless the machine is so busy that some fail


def test_a_function_and_a_broadcast_with_large_arguments_cost_a_few_copies(
    backend: LoopbackBackend,
) -> None:
    theta = os.urandom(LARGE)
    expected = hashlib.sha256(theta).hexdigest()
    with fiber.Pool(AGENTS) as pool:
        pool.broadcast(os.getpid)  # the workers are there
        before = bytes_to_agents(backend)
        seeds = range(20 * AGENTS)
        answers = pool.map(partial(add, theta), seeds, chunksize=1)
        assert answers == [(expected, seed) for seed in seeds]
        between = bytes_to_agents(backend)
        assert pool.broadcast(add, theta + b"!", 0) == [(sha(theta + b"!"), 0)] * AGENTS
        after = bytes_to_agents(backend)
    assert 1 <= (between - before) / LARGE < AGENTS
    assert 1 <= (after - between) / LARGE < AGENTS


@pytest.mark.parametrize("pass_on", ["auto", "never"])
def test_on_one_machine_the_master_sends_all_copies(pass_on: str) -> None:
    loop: Any = mock.MagicMock()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loopback, "MasterListener", mock.MagicMock())
        patch.setattr(loopback, "AgentLauncher", mock.MagicMock())
        patch.setattr(loopback, "AgentProcess", mock.MagicMock())
        settings = config.load({"pass_on": pass_on}, environ={})
        made = LoopbackBackend(loop, mock.MagicMock(), settings)
    assert made.agents._fanout is None


@pytest.mark.parametrize("signum", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "stopped"])
def test_a_source_that_fails_in_the_middle_is_gone_round(
    monkeypatch: pytest.MonkeyPatch, backend: LoopbackBackend, signum: signal.Signals
) -> None:
    victims: list[int] = []
    carry_out = Fanout._carry_out

    def fail_first(fanout: Fanout, digest: bytes, spreading: Any, orders: Any) -> None:
        sources = [order.source for order in orders if order.source is not None]
        if sources and not victims:
            (host,) = (a.host for a in backend.agents.agents.values() if a._blobs is sources[0])
            pid = backend._by_name[host].process.pid
            assert pid is not None
            victims.append(pid)
            os.kill(pid, signum)
        carry_out(fanout, digest, spreading, orders)

    monkeypatch.setattr(Fanout, "_carry_out", fail_first)
    data = os.urandom(LARGE)
    expected = hashlib.sha256(data).hexdigest()
    with fiber.Pool(AGENTS, keep, (data,)) as pool:
        answers = pool.imap_unordered(hash_of_kept, range(20 * AGENTS))
        assert set(answers) == {expected}
        assert victims
    with contextlib.suppress(ProcessLookupError):
        os.kill(victims[0], signal.SIGKILL)


def test_where_agents_do_not_reach_each_other_the_master_sends_all_copies(
    monkeypatch: pytest.MonkeyPatch, backend: LoopbackBackend
) -> None:
    holding = Fanout.holding
    with socket.create_server(("127.0.0.1", 0)) as closed:
        nowhere = f"127.0.0.1:{closed.getsockname()[1]}"

    def unreachable(fanout: Fanout, agent: BlobSender, message: Holding) -> None:
        holding(fanout, agent, message._replace(address=nowhere))

    monkeypatch.setattr(Fanout, "holding", unreachable)
    assert run_pool(backend) >= AGENTS


@pytest.mark.parametrize("field", ["address", "key", "certificate"])
def test_an_agent_that_gives_a_useless_address_or_key_serves_nobody(
    monkeypatch: pytest.MonkeyPatch, backend: LoopbackBackend, field: str
) -> None:
    holding = Fanout.holding

    def nonsense(fanout: Fanout, agent: BlobSender, message: Holding) -> None:
        changes: dict[str, Any] = {field: "nonsense"}
        holding(fanout, agent, message._replace(**changes))

    monkeypatch.setattr(Fanout, "holding", nonsense)
    agents = set(backend.agents.agents)
    assert run_pool(backend) >= AGENTS
    assert set(backend.agents.agents) == agents, "no link ended"


# One source and one receiver

DATA = os.urandom(LARGE)
DIGEST = hashlib.sha256(DATA).digest()


@dataclass
class Result:
    """Result of a transfer."""

    done: threading.Event = field(default_factory=threading.Event)
    data: bytes = b""
    reason: str = ""

    def on_blob(self, message: KeepBlob) -> None:
        self.data = bytes(message.data)
        self.done.set()

    def on_failed(self, reason: str) -> None:
        self.reason = reason
        self.done.set()


@pytest.fixture
def loop() -> Iterator[Loop]:
    made = Loop()
    made.start_thread("test-loop")
    yield made
    ended = threading.Event()
    made.call_later(2 * link._LAST_WORD, ended.set)  # links close their connections a little later
    assert ended.wait(PATIENCE)
    made.stop()


def on_loop(loop: Loop, call: Callable[[], Any]) -> Any:
    """Call a function on the loop thread and return its result."""
    done, results = threading.Event(), list[Any]()

    def run() -> None:
        results.append(call())
        done.set()

    loop.call_soon(run)
    assert done.wait(PATIENCE)
    return results[0]


@pytest.fixture
def source(loop: Loop, tmp_path: Path) -> Iterator[BlobSource]:
    store = BlobStore(str(tmp_path))
    store.put(KeepBlob(DIGEST, DATA))
    made = on_loop(loop, lambda: BlobSource(loop, store, "127.0.0.1:0"))
    yield made
    on_loop(loop, made.close)
    store.forget(DIGEST)
    closed = threading.Event()
    made._listener.close(linger=0.0, then=closed.set)
    assert closed.wait(PATIENCE)


def fetch(loop: Loop, source: Any, address: str = "", **changes: Any) -> Result:
    """Fetch DATA; ``changes`` are fields of the order."""
    result, credentials = Result(), source.credentials
    key = identity.agent_key(credentials.pool_key, RECEIVER, "uid")
    order = Fetch(
        DIGEST, 1, LARGE, address or source.address, "uid", key, credentials.fingerprint, 0
    )._replace(**changes)
    made = on_loop(
        loop,
        lambda: BlobFetch(loop, order, on_blob=result.on_blob, on_failed=result.on_failed),
    )
    assert result.done.wait(PATIENCE)
    loop.call_soon(made.close)
    return result


def test_a_receiver_gets_the_blob_that_its_master_named(loop: Loop, source: BlobSource) -> None:
    assert fetch(loop, source).data == DATA


def test_a_blob_that_the_source_does_not_have_is_a_failure(loop: Loop, source: BlobSource) -> None:
    result = fetch(loop, source, digest=hashlib.sha256(b"other").digest())
    assert result.reason == "this agent does not have the blob"


@pytest.mark.parametrize(
    "changes",
    [{"key": "ab" * 32}, {"uid": "another"}, {"certificate": "ab" * 32}],
    ids=["wrong key", "another order's key", "another source"],
)
def test_a_receiver_and_a_source_that_the_master_did_not_pair_refuse(
    loop: Loop, source: BlobSource, changes: dict[str, str]
) -> None:
    result = fetch(loop, source, **changes)
    assert not result.data
    assert "do not trust each other" in result.reason
    assert fetch(loop, source).data == DATA


class DyingHost(Proxy):
    """Proxy that is never reached again after its connections have broken."""

    def _hang_up(self) -> None:
        self._severed = True
        super()._hang_up()


def test_a_source_that_dies_in_the_middle_of_a_transfer_is_a_failure(
    loop: Loop, source: BlobSource
) -> None:
    with DyingHost(source.address) as proxy:
        proxy.break_after = LARGE // 2
        result = fetch(loop, source, proxy.address)
    assert not result.data
    assert result.reason == "it is silent"


def test_a_source_that_falls_silent_in_the_middle_of_a_transfer_is_a_failure(
    loop: Loop, source: BlobSource
) -> None:
    with Proxy(source.address) as proxy:
        proxy.silent_after = LARGE // 2
        result = fetch(loop, source, proxy.address)
    assert not result.data
    assert result.reason == "it is silent"


class Liar:
    """Source that answers each request with a message of the test."""

    def __init__(self, loop: Loop, answer: messages.LinkMessage) -> None:
        from fiber._transport.credentials import make_credentials

        self.credentials = make_credentials()
        self._answer = answer
        self._listener = MasterListener(
            loop, "127.0.0.1:0", self.credentials, on_agent=self._joined, on_refused=print
        )
        self.address = self._listener.address

    def _joined(self, joined: Any) -> None:
        self._link = joined
        joined.attach(self)

    def on_frame(self, frame: Any) -> None:
        assert isinstance(messages.decode(frame), Want)
        self._link.send(*messages.pieces(self._answer))

    def on_suspect(self) -> None: ...

    def on_trusted(self) -> None: ...

    def on_lost(self, reason: str) -> None: ...

    def close(self) -> None:
        closed = threading.Event()
        self._listener.close(linger=0.0, then=closed.set)
        assert closed.wait(PATIENCE)


def test_bytes_with_another_digest_are_refused_and_not_unpickled(
    loop: Loop, tmp_path: Path
) -> None:
    trace = tmp_path / "trace"
    liar = Liar(loop, KeepBlob(DIGEST, pickle.dumps(Bomb(trace))))
    result = fetch(loop, liar)
    assert result.reason == "what it sent is not the blob that the master named"
    assert not trace.exists()
    liar.close()


def test_a_source_that_announces_more_than_the_master_named_is_left(loop: Loop) -> None:
    liar = Liar(loop, KeepBlob(DIGEST, bytes(2 * LARGE)))
    result = fetch(loop, liar)
    size = KeepBlob.frame_size(LARGE)
    assert f"{size + LARGE} bytes are announced, and {size} may come" in result.reason
    liar.close()


def test_a_receiver_with_a_large_request_is_cut_off(
    loop: Loop, source: BlobSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    reasons: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(_Receiver, "on_lost", lambda self, reason: reasons.append(reason))
        patch.setattr(Want, "encode", lambda self: KeepBlob(DIGEST, bytes(LARGE)).encode())
        assert not fetch(loop, source).data
    assert "bytes are announced, and 0 may come" in reasons[0]
    assert fetch(loop, source).data == DATA


def test_an_answer_that_is_no_blob_is_refused(loop: Loop) -> None:
    liar = Liar(loop, messages.Shutdown(0))
    assert fetch(loop, liar).reason == "it sent a Shutdown instead of a blob"
    liar.close()


def test_a_receiver_that_sends_something_else_is_cut_off(
    loop: Loop, source: BlobSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Want, "encode", lambda self: messages.Shutdown(0).encode())
    assert not fetch(loop, source).data


@pytest.mark.parametrize("garbage", GARBAGE, ids=range(len(GARBAGE)))
def test_strangers_at_the_port_of_an_agent_get_nothing(
    loop: Loop, source: BlobSource, garbage: bytes
) -> None:
    host, _, port = source.address.rpartition(":")
    with socket.create_connection((host, int(port)), PATIENCE) as stranger:
        stranger.sendall(garbage)
        stranger.shutdown(socket.SHUT_WR)
        assert DATA[:100] not in stranger.recv(1 << 16)
    assert fetch(loop, source).data == DATA


def test_a_stranger_without_a_proof_gets_no_blob(loop: Loop, source: BlobSource) -> None:
    host, _, port = source.address.rpartition(":")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with (
        socket.create_connection((host, int(port)), PATIENCE) as bare,
        context.wrap_socket(bare) as stranger,
    ):
        stranger.sendall(bytes(32) + Want(DIGEST).encode())
        stranger.sendall(bytes(1 << 12))
        stranger.settimeout(PATIENCE)
        received = b""
        try:
            while more := stranger.recv(1 << 16):
                received += more
        except OSError:
            pass
        assert len(received) < 1 << 12
    assert fetch(loop, source).data == DATA
