"""Strangers at the two ports of a relay, and agents that wait, on a loop that goes step by step."""

from __future__ import annotations

import errno
import os
import resource
import socket
import struct
from collections.abc import Iterator

import pytest

from fiber._transport import relay as relay_module
from fiber._transport.acceptor import Admission
from fiber._transport.relay import Relay
from fiber._wire.streams import VERSION, FrameDecoder, Kind, StreamFrame, hello
from patience import PATIENCE
from unit.stepped_loop import SteppedLoop


@pytest.fixture
def stepped(monkeypatch: pytest.MonkeyPatch) -> Iterator[SteppedLoop]:
    loop = SteppedLoop(monkeypatch)
    yield loop
    loop.stop()


class Quiet:
    """A relay on a stepped loop, with what it has logged."""

    def __init__(self, loop: SteppedLoop) -> None:
        self.loop = loop
        self.log: list[str] = []
        self.relay = Relay(loop, 0, 0, self.log.append)
        self._socks: list[socket.socket] = []

    def connect(self, port: int, data: bytes = b"") -> socket.socket:
        sock = socket.create_connection(("127.0.0.1", port), PATIENCE)
        self._socks.append(sock)
        sock.sendall(data)
        return sock

    def agent(self, data: bytes = b"") -> socket.socket:
        """Connect an agent that waits, and wait until the relay knows of it and of its bytes."""
        waiting, spoken = len(self.relay._waiting), len(self.relay._spoken)
        sock = self.connect(self.relay.agents_port, data)
        self.loop.run_until(lambda: len(self.relay._waiting) > waiting)
        self.loop.run_until(lambda: len(self.relay._spoken) == spoken + bool(data))
        return sock

    def master(self, epoch: int = 1) -> Quiet.End:
        sock = self.connect(self.relay.master_port, hello(epoch=epoch, identity="me").encode())
        end = Quiet.End(self, sock)
        assert end.frame(Kind.HELLO).hello == {"version": VERSION}
        return end

    class End:
        """Master that the test plays."""

        def __init__(self, quiet: Quiet, sock: socket.socket) -> None:
            self.sock = sock
            self._quiet = quiet
            self._decoder = FrameDecoder()
            self.frames: list[StreamFrame] = []
            sock.setblocking(False)

        def frame(self, kind: Kind) -> StreamFrame:
            """Wait for the next frame of this kind."""

            def there() -> bool:
                try:
                    self.frames += self._decoder.feed(self.sock.recv(1 << 16))
                except BlockingIOError:
                    pass
                return any(frame.kind is kind for frame in self.frames)

            self._quiet.loop.run_until(there)
            found = next(frame for frame in self.frames if frame.kind is kind)
            self.frames.remove(found)
            return found

    def agent_at(self, master: Quiet.End) -> None:
        """Check that a new agent reaches the master."""
        self.connect(self.relay.agents_port, b"hello")
        master.frame(Kind.OPEN)
        assert master.frame(Kind.DATA).payload == b"hello"

    def is_closed(self, sock: socket.socket) -> bool:
        """Return whether the relay has closed the connection."""
        sock.setblocking(False)
        try:
            return sock.recv(1) == b""
        except BlockingIOError:
            return False
        except ConnectionError:
            return True

    def close(self) -> None:
        for sock in self._socks:
            sock.close()
        self.relay.close()
        assert self.loop.watched() == 0


@pytest.fixture
def quiet(stepped: SteppedLoop) -> Iterator[Quiet]:
    quiet = Quiet(stepped)
    yield quiet
    quiet.close()


def reset(sock: socket.socket) -> None:
    """Close a connection as a killed host or a scanner does."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    sock.close()


def test_an_agent_that_gives_up_silently_is_forgotten(quiet: Quiet) -> None:
    quiet.agent().close()
    quiet.loop.run_until(lambda: not quiet.relay._waiting)
    reset(quiet.agent())
    quiet.loop.run_until(lambda: not quiet.relay._waiting)


def test_an_agent_that_is_reset_while_it_waits_costs_one_callback(quiet: Quiet) -> None:
    """The kernel reports a reset as long as the descriptor is watched, and keeps the bytes."""
    reset(quiet.agent(b"hello"))
    quiet.loop.run_until(lambda: not quiet.relay._waiting)
    assert quiet.relay._spoken == set()
    quiet.loop.settle()


def test_agents_that_wait_cost_no_callback(quiet: Quiet) -> None:
    for data in (b"", b"hello", bytes(100_000)):
        quiet.agent(data)
    gone = quiet.agent(b"hello")
    gone.shutdown(socket.SHUT_WR)
    quiet.loop.settle()
    assert [quiet.loop.turn() for _ in range(3)] == [0, 0, 0]


def test_an_agent_that_has_given_up_is_not_shown_to_the_master(quiet: Quiet) -> None:
    gone, there = quiet.agent(b"gone"), quiet.agent(b"there")
    gone.close()
    quiet.loop.settle()
    master = quiet.master()
    assert master.frame(Kind.DATA).payload == b"there"
    assert [frame.kind for frame in master.frames] == [Kind.OPEN]
    assert not quiet.is_closed(there)


def test_agents_wait_up_to_a_bound(quiet: Quiet) -> None:
    quiet.relay._admission = Admission(4, 2)
    first, second = quiet.agent(), quiet.agent()
    third = quiet.connect(quiet.relay.agents_port)
    quiet.loop.run_until(lambda: quiet.is_closed(third))  # the others have had no fair chance yet
    quiet.loop.time += 10
    fourth = quiet.connect(quiet.relay.agents_port)
    quiet.loop.run_until(lambda: quiet.is_closed(first))
    assert not quiet.is_closed(second)
    assert not quiet.is_closed(fourth)


@pytest.mark.slow
@pytest.mark.parametrize("data", [b"", b"GET / HTTP/1.1\r\n\r\n"])
def test_a_thousand_strangers_at_the_agents_port(quiet: Quiet, data: bytes) -> None:
    _need_descriptors(2200)
    port = quiet.relay.agents_port
    socks = []
    for _ in range(100):
        socks += [quiet.connect(port, data) for _ in range(10)]
        quiet.loop.turn()
    most = relay_module._MOST_WAITING // 2
    quiet.loop.run_until(lambda: sum(map(quiet.is_closed, socks)) >= len(socks) - most)
    quiet.loop.settle()
    assert len(quiet.relay._waiting) == most
    master = quiet.master()
    for _ in range(most):
        assert master.frame(Kind.OPEN).origin.startswith("127.0.0.1:")
    assert quiet.relay._waiting == {}


def _need_descriptors(count: int) -> None:
    if resource.getrlimit(resource.RLIMIT_NOFILE)[0] < count:
        pytest.skip("this process may not have as many descriptors")


@pytest.mark.slow
def test_a_thousand_strangers_at_the_masters_port(quiet: Quiet) -> None:
    _need_descriptors(2200)
    master = quiet.master()
    socks = []
    for _ in range(100):
        socks += [quiet.connect(quiet.relay.master_port) for _ in range(10)]
        quiet.loop.settle()
    most = relay_module._MOST_NEWCOMERS
    quiet.loop.run_until(lambda: sum(map(quiet.is_closed, socks)) == len(socks) - most)
    quiet.loop.pass_time(relay_module._HELLO_WITHIN)
    quiet.loop.run_until(lambda: all(map(quiet.is_closed, socks)))
    assert quiet.relay._newcomers == {}
    quiet.agent_at(master)


def test_a_refused_newcomer_that_stays_is_closed_in_time(quiet: Quiet) -> None:
    quiet.master(epoch=2)
    old = Quiet.End(quiet, quiet.connect(quiet.relay.master_port))
    old.sock.send(hello(epoch=1, identity="me").encode())
    assert "refused" in old.frame(Kind.HELLO).hello
    quiet.loop.pass_time(relay_module._HELLO_WITHIN)
    quiet.loop.run_until(lambda: quiet.is_closed(old.sock))


@pytest.mark.parametrize("data", [b"GET / HTTP/1.1\r\n\r\n", StreamFrame(Kind.OPEN, 1).encode()])
def test_garbage_at_the_masters_port_is_cut_off(quiet: Quiet, data: bytes) -> None:
    sock = quiet.connect(quiet.relay.master_port, data)
    quiet.loop.run_until(lambda: quiet.is_closed(sock))
    assert quiet.relay._newcomers == {}
    quiet.master()
    assert quiet.log == ["connected to the master me with the epoch 1"]


def test_the_relay_goes_on_after_it_had_no_descriptor(
    quiet: Quiet, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: socket.socket) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    with monkeypatch.context() as short:
        short.setattr(socket.socket, "accept", refuse)
        quiet.connect(quiet.relay.agents_port)
        quiet.loop.run_until(lambda: quiet.log)
        quiet.loop.pass_time(5)
    assert quiet.log == [
        "a connection could not be accepted: Too many open files. The relay tries again all the "
        "time"
    ]
    quiet.loop.time += 1
    quiet.loop.run_until(lambda: quiet.relay._waiting)


def test_a_relay_that_cannot_listen_leaves_nothing(stepped: SteppedLoop) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other, pytest.raises(OSError, match="in use"):
        Relay(stepped, 0, other.getsockname()[1], print)
    assert stepped.watched() == 0
