"""Multiplexer: whole streams, their ends, bounded memory, wrong peers, and a broken carrier."""

from __future__ import annotations

import errno
import socket
import struct
from collections.abc import Iterator

import pytest

from fiber._transport import multiplexer
from fiber._transport.multiplexer import Multiplexer, SocketCarrier
from fiber._wire.streams import FIRST_CREDIT, MOST_DATA, Kind, StreamFrame, credit
from unit.stepped_loop import SteppedLoop
from unit.stream_site import Peer, Program, Tunnel, kept, noise, only

MEGABYTE = 1 << 20
HEAD = 9


@pytest.fixture
def stepped(monkeypatch: pytest.MonkeyPatch) -> Iterator[SteppedLoop]:
    loop = SteppedLoop(monkeypatch)
    yield loop
    loop.stop()


@pytest.fixture
def tunnel(stepped: SteppedLoop) -> Iterator[Tunnel]:
    tunnel = Tunnel(stepped)
    yield tunnel
    tunnel.close()


@pytest.fixture
def peer(tunnel: Tunnel) -> Iterator[Peer]:
    """A relay that the test plays, connected to a master's end."""
    near, far = socket.socketpair()
    peer = Peer(tunnel, tunnel.end(SocketCarrier(near), tunnel.take), far)
    yield peer
    peer.end.close()
    far.close()


def opened(number: int = 1) -> StreamFrame:
    return StreamFrame(Kind.OPEN, number, b"10.0.0.1:1")


def data(payload: bytes, number: int = 1) -> StreamFrame:
    return StreamFrame(Kind.DATA, number, payload)


# -- Bytes


@pytest.mark.parametrize("buffer", [None, 4096])
def test_bytes_arrive_whole_and_in_order_both_ways(tunnel: Tunnel, buffer: int | None) -> None:
    for carrier in tunnel.carriers if buffer else ():
        carrier.sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, buffer or 0)
    streams = [tunnel.stream(f"10.0.0.{number}:1") for number in range(3)]
    for number, (agent, master) in enumerate(streams):
        agent.give(noise(2 * MEGABYTE + number, number))
        master.give(noise(MEGABYTE + number, 100 + number))
    tunnel.pump(*tunnel.programs)
    for number, (agent, master) in enumerate(streams):
        assert master.got == noise(2 * MEGABYTE + number, number)
        assert agent.got == noise(MEGABYTE + number, 100 + number)
    assert tunnel.origins == ["10.0.0.0:1", "10.0.0.1:1", "10.0.0.2:1"]


def test_the_carrier_is_read_once_in_a_turn(tunnel: Tunnel) -> None:
    """Otherwise each turn would read more than the last, and the sockets would wait."""
    agent, master = tunnel.stream()
    agent.give(noise(8 * MEGABYTE))
    while agent.unsent:
        agent.write()
        master.read()
        tunnel.loop.turn()
        assert sum(call.__name__ == "_read_again" for call, _ in tunnel.loop._ready) <= 2
    tunnel.pump(master)
    assert len(master.got) == 8 * MEGABYTE


# -- Ends of streams


def test_an_end_closes_one_direction(tunnel: Tunnel) -> None:
    agent, master = tunnel.stream()
    agent.give(b"question")
    agent.write()
    agent.sock.shutdown(socket.SHUT_WR)
    tunnel.pump(master)
    assert master.got == b"question"
    assert master.at_end
    assert (len(tunnel.relay), len(tunnel.master)) == (1, 1)
    master.give(noise(MEGABYTE))
    tunnel.pump(agent)
    assert agent.got == noise(MEGABYTE)
    master.close()
    tunnel.programs.remove(master)
    tunnel.pump(agent)
    assert agent.at_end
    assert (len(tunnel.relay), len(tunnel.master)) == (0, 0)


@pytest.mark.parametrize("closes", ["agent", "master"])
def test_a_program_that_is_gone_ends_the_stream_of_one_that_stays(
    tunnel: Tunnel, closes: str
) -> None:
    """A stranger that never closes its connection must not keep descriptors here."""
    agent, master = tunnel.stream()
    gone, stays = (agent, master) if closes == "agent" else (master, agent)
    gone.give(b"last words")
    gone.write()
    gone.close()
    tunnel.programs.remove(gone)
    tunnel.loop.settle()
    assert (len(tunnel.relay), len(tunnel.master)) == (0, 0)
    assert stays.is_cut()
    assert stays.got.startswith(b"last words")


def gone_with_much_to_deliver(tunnel: Tunnel) -> tuple[Program, int]:
    """Return an agent that does not read, whose master has sent what it could and has closed."""
    agent, master = tunnel.stream()
    master.give(noise(8 * MEGABYTE))
    tunnel.pump()
    sent = 8 * MEGABYTE - master.unsent
    while only(tunnel.master).credit == 0:
        tunnel.loop.settle()
        agent.read(1 << 12)
    tunnel.loop.settle()
    master.close()
    tunnel.programs.remove(master)
    return agent, sent


def test_the_last_bytes_of_a_program_that_is_gone_are_delivered(tunnel: Tunnel) -> None:
    agent, sent = gone_with_much_to_deliver(tunnel)
    tunnel.pump(agent)
    assert agent.got == noise(8 * MEGABYTE)[:sent]
    assert agent.is_cut()
    assert (len(tunnel.relay), len(tunnel.master)) == (0, 0)


def test_last_bytes_that_nobody_reads_are_dropped_in_time(peer: Peer, tunnel: Tunnel) -> None:
    peer.send(opened())
    fill_the_socket(peer)
    peer.send(StreamFrame(Kind.END, 1), StreamFrame(Kind.ABORT, 1), StreamFrame(Kind.ABORT, 1))
    assert len(peer.end) == 1
    tunnel.loop.pass_time(multiplexer._LINGER - 1)
    peer.send(StreamFrame(Kind.PONG))
    assert len(peer.end) == 1
    tunnel.loop.pass_time(1)
    assert len(peer.end) == 0
    assert tunnel.masters[0].is_cut()


def fill_the_socket(peer: Peer) -> None:
    """Send data for the stream 1, as its credit allows, until its socket takes no more."""
    budget = FIRST_CREDIT
    while not only(peer.end).incoming:
        size = min(budget, MOST_DATA)
        peer.send(data(bytes(size)))
        budget += sum(f.credit for f in peer.frames() if f.kind is Kind.CREDIT) - size
        assert budget >= 0


def test_an_abort_cuts_the_socket(peer: Peer, tunnel: Tunnel) -> None:
    peer.send(opened(), data(b"some"), StreamFrame(Kind.ABORT, 1))
    assert len(peer.end) == 0
    assert tunnel.masters[0].is_cut()


def test_a_broken_socket_aborts_the_stream(tunnel: Tunnel) -> None:
    agent, master = tunnel.stream()
    master.give(b"never read")
    tunnel.pump()
    agent.close()  # with bytes unread, which is a reset
    tunnel.programs.remove(agent)
    tunnel.loop.settle()
    assert (len(tunnel.relay), len(tunnel.master)) == (0, 0)
    assert master.is_cut()


def test_a_connection_that_is_reset_after_its_end_leaves_nothing(tunnel: Tunnel) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        agent = socket.create_connection(listener.getsockname())
        accepted, _ = listener.accept()
    tunnel.relay.open(accepted, "10.0.0.1:1")
    agent.shutdown(socket.SHUT_WR)
    tunnel.loop.run_until(lambda: only(tunnel.relay).ended)
    assert len(tunnel.relay) == 1
    agent.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    agent.close()
    tunnel.loop.run_until(lambda: not len(tunnel.relay) and not len(tunnel.master))
    assert tunnel.masters[0].is_cut()


# -- Flow control


def test_a_slow_reader_holds_up_no_other_stream_and_takes_little_memory(tunnel: Tunnel) -> None:
    slow, unread = tunnel.stream()
    slow.give(noise(16 * MEGABYTE))
    tunnel.pump()
    assert slow.unsent > 8 * MEGABYTE
    assert kept(tunnel.master) <= only(tunnel.master).window
    assert kept(tunnel.relay) == 0
    agent, master = tunnel.stream()
    agent.give(noise(MEGABYTE, 2))
    master.give(noise(MEGABYTE, 3))
    tunnel.pump(agent, master)
    assert master.got == noise(MEGABYTE, 2)
    assert agent.got == noise(MEGABYTE, 3)
    tunnel.pump(unread)
    assert unread.got == noise(16 * MEGABYTE)


def test_credit_grows_for_a_fast_reader_and_comes_back(tunnel: Tunnel) -> None:
    agent, master = tunnel.stream()
    stream = only(tunnel.master)
    agent.give(noise(8 * MEGABYTE))
    tunnel.pump(master)
    grown = stream.window
    assert grown == multiplexer._LARGEST_WINDOW
    assert tunnel.master._spare == multiplexer._SPARE - (grown - FIRST_CREDIT)
    agent.give(noise(8 * MEGABYTE, 2))
    while agent.unsent or stream.incoming:  # from now on it is slow
        tunnel.pump()
        master.read(1 << 14)
        if stream.window == FIRST_CREDIT:
            break
    assert stream.window == FIRST_CREDIT
    assert tunnel.master._spare == multiplexer._SPARE
    tunnel.pump(master)
    assert master.got == noise(8 * MEGABYTE) + noise(8 * MEGABYTE, 2)


def test_no_credit_is_lost_or_made(tunnel: Tunnel) -> None:
    agent, master = tunnel.stream()
    sends, takes = only(tunnel.relay), only(tunnel.master)
    agent.give(noise(4 * MEGABYTE))
    while agent.unsent:
        tunnel.pump()
        assert sends.credit + len(takes.incoming) + takes.taken == takes.window
        master.read(len(master.got) % 70_000 + 1)


def test_the_windows_of_all_streams_together_are_bounded(tunnel: Tunnel) -> None:
    tunnel.master._spare = spare = 3 * FIRST_CREDIT
    pairs = [tunnel.stream() for _ in range(4)]
    for agent, _ in pairs:
        agent.give(noise(4 * MEGABYTE))
    tunnel.pump(*tunnel.masters)
    windows = [stream.window for stream in tunnel.master._streams.values()]
    assert sum(windows) == spare + 4 * FIRST_CREDIT
    assert tunnel.master._spare == 0
    for agent, _ in pairs:
        agent.sock.shutdown(socket.SHUT_RDWR)
    tunnel.loop.settle()
    assert tunnel.master._spare == spare


def test_a_full_carrier_stops_the_reading_of_sockets(peer: Peer, tunnel: Tunnel) -> None:
    peer.send(*(opened(number) for number in range(1, 11)))
    peer.send(*(credit(number, MEGABYTE) for number in range(1, 11)))
    for master in tunnel.masters:
        master.give(noise(MEGABYTE))
    tunnel.pump()
    most = multiplexer._FULL + MOST_DATA + HEAD
    assert multiplexer._FULL < kept(peer.end) <= most
    peer.send(*(credit(1, 1) for _ in range(1000)))  # more credit changes nothing
    assert kept(peer.end) <= most
    assert len(peer.end._held) == 10
    got = bytearray()
    while frames := peer.frames():
        got += b"".join(f.payload for f in frames if f.kind is Kind.DATA and f.stream == 1)
        tunnel.pump()
    assert got == noise(MEGABYTE)


@pytest.mark.parametrize("size", [MOST_DATA, 1, 100])
def test_a_peer_that_overdraws_its_credit_is_cut_off(peer: Peer, tunnel: Tunnel, size: int) -> None:
    peer.send(opened())
    fill_the_socket(peer)
    stream = only(peer.end)
    for _ in range(multiplexer._LARGEST_WINDOW // size + 1):
        assert len(stream.incoming) <= stream.window
        peer.send(data(bytes(size)) if size > 1 else data(b"x" * 1).encode() * 1000)
        if peer.end.is_over():
            break
    assert tunnel.ends == ["a stream has sent more than its credit"]
    assert tunnel.masters[0].is_cut()


def test_frames_without_bytes_take_no_memory(peer: Peer) -> None:
    peer.send(opened())
    fill_the_socket(peer)
    before = len(only(peer.end).incoming)
    peer.send(data(b"").encode() * 10_000)
    assert len(only(peer.end).incoming) == before


# -- No busy loop: ``settle`` fails if the loop does not come to rest


def test_a_socket_that_was_closed_while_its_stream_waits_for_credit(
    peer: Peer, tunnel: Tunnel
) -> None:
    peer.send(opened())
    (master,) = tunnel.masters
    master.give(noise(FIRST_CREDIT + 1000))
    tunnel.pump()
    master.close()
    tunnel.programs.remove(master)
    tunnel.loop.settle()
    first = peer.frames()
    assert b"".join(f.payload for f in first) == noise(FIRST_CREDIT + 1000)[:FIRST_CREDIT]
    peer.send(credit(1, 2000))
    rest = peer.frames()
    assert [f.kind for f in rest] == [Kind.DATA, Kind.END, Kind.ABORT]
    assert rest[0].payload == noise(FIRST_CREDIT + 1000)[FIRST_CREDIT:]
    assert len(peer.end) == 0


def test_a_socket_that_was_closed_while_the_carrier_is_full(peer: Peer, tunnel: Tunnel) -> None:
    peer.send(opened(1), credit(1, 8 * MEGABYTE))
    (master,) = tunnel.masters
    master.give(noise(4 * MEGABYTE))
    tunnel.pump()
    sent = 4 * MEGABYTE - master.unsent
    master.close()
    tunnel.programs.remove(master)
    tunnel.loop.settle()
    frames: list[StreamFrame] = []
    while more := peer.frames():
        frames += more
    assert b"".join(f.payload for f in frames) == noise(4 * MEGABYTE)[:sent]
    assert [f.kind for f in frames[-2:]] == [Kind.END, Kind.ABORT]


def test_a_stream_that_is_half_closed_costs_no_callback(tunnel: Tunnel) -> None:
    agent, _ = tunnel.stream()
    agent.sock.shutdown(socket.SHUT_WR)
    tunnel.loop.settle()
    assert [tunnel.loop.turn() for _ in range(3)] == [0, 0, 0]
    assert len(tunnel.relay) == 1


# -- Wrong peers


@pytest.mark.parametrize(
    ("frames", "reason"),
    [
        ([struct.pack(">BII", 255, 0, 0)], "unknown kind 255"),
        ([struct.pack(">BII", Kind.DATA, 1, MOST_DATA + 1)], "a frame has"),
        ([opened(), opened()], "the stream 1 cannot be opened"),
        ([StreamFrame(Kind.OPEN, 1, b"\x1b[31m")], "no address"),
        ([opened(), StreamFrame(Kind.CREDIT, 1)], "no number"),
        ([opened(), StreamFrame(Kind.END, 1), data(b"x")], "after its end"),
    ],
)
def test_a_peer_that_breaks_the_protocol_is_cut_off(
    peer: Peer, tunnel: Tunnel, frames: list[StreamFrame | bytes], reason: str
) -> None:
    peer.send(*frames)
    (told,) = tunnel.ends
    assert reason in told
    assert peer.end.is_over()
    assert peer.sock.fileno() >= 0
    assert all(master.is_cut() for master in tunnel.masters)


def test_a_master_cannot_open_streams(tunnel: Tunnel) -> None:
    tunnel.master.send(opened())
    tunnel.loop.settle()
    assert tunnel.ends == [
        "the stream 1 cannot be opened",
        "it was closed by the other side",
    ]


def test_frames_for_streams_that_are_unknown_are_ignored(peer: Peer, tunnel: Tunnel) -> None:
    kinds = (Kind.DATA, Kind.CREDIT, Kind.END, Kind.ABORT)
    peer.send(*(StreamFrame(kind, 5) for kind in kinds), StreamFrame(Kind.PONG))
    peer.send(StreamFrame(Kind.PING))
    assert [frame.kind for frame in peer.frames()] == [Kind.PONG]
    assert tunnel.ends == []


@pytest.mark.parametrize("frame", [StreamFrame(Kind.PING), opened()])
def test_a_peer_that_reads_no_answers_is_cut_off(
    peer: Peer, tunnel: Tunnel, frame: StreamFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(origin: str) -> socket.socket:
        raise OSError(errno.EMFILE, "too many open files")

    monkeypatch.setattr(peer.end, "_on_open", refuse)
    most = 0
    while not peer.end.is_over():
        peer.send(frame.encode() * 5000)
        most = max(most, kept(peer.end))
    assert most < 2 * multiplexer._UNREAD
    assert tunnel.ends == ["the other side does not read what it is sent"]


def test_a_stream_for_which_there_is_no_descriptor_is_aborted(peer: Peer, tunnel: Tunnel) -> None:
    peer.send(opened(1))

    def refuse(origin: str) -> socket.socket:
        raise OSError(errno.EMFILE, "too many open files")

    peer.end._on_open = refuse
    peer.send(opened(2))
    peer.end._on_open = tunnel.take
    peer.send(data(b"goes on"))
    assert peer.frames() == [StreamFrame(Kind.ABORT, 2)]
    tunnel.pump(tunnel.masters[0])
    assert tunnel.masters[0].got == b"goes on"


def test_a_number_that_is_used_again_is_another_stream(peer: Peer, tunnel: Tunnel) -> None:
    peer.send(opened())
    first = only(peer.end)
    fill_the_socket(peer)
    peer.send(StreamFrame(Kind.END, 1), StreamFrame(Kind.ABORT, 1))
    first.incoming.clear()
    peer.send(StreamFrame(Kind.ABORT, 1), opened())
    peer.end._resume(first)
    peer.end._abort(first)
    tunnel.loop.pass_time(multiplexer._LINGER)
    peer.send(data(b"for the second"))
    tunnel.pump(tunnel.masters[1])
    assert tunnel.masters[1].got == b"for the second"


# -- Silence


def test_silence_brings_a_ping_and_then_the_end(peer: Peer, tunnel: Tunnel) -> None:
    tunnel.loop.pass_time(multiplexer._PING_AFTER - 1)
    assert peer.frames() == []
    tunnel.loop.pass_time(1)
    assert peer.frames() == [StreamFrame(Kind.PING)]
    tunnel.loop.pass_time(multiplexer._DEAD_AFTER)
    assert f"it was silent for {multiplexer._DEAD_AFTER:.0f} s" in tunnel.ends
    assert peer.end.is_over()


def test_two_idle_ends_keep_each_other_alive(tunnel: Tunnel) -> None:
    agent, master = tunnel.stream()
    tunnel.loop.pass_time(10 * multiplexer._DEAD_AFTER)
    agent.give(b"still there")
    tunnel.pump(master)
    assert master.got == b"still there"


def test_an_end_of_the_carrier_is_told_once(peer: Peer, tunnel: Tunnel) -> None:
    peer.send(opened())
    peer.sock.close()
    tunnel.loop.settle()
    assert tunnel.ends == ["it was closed by the other side"]
    assert tunnel.masters[0].is_cut()
    peer.end.send(StreamFrame(Kind.PING))
    peer.end.close()
    tunnel.loop.pass_time(2 * multiplexer._DEAD_AFTER)
    assert tunnel.ends == ["it was closed by the other side"]


def test_a_closed_end_takes_no_stream(tunnel: Tunnel) -> None:
    tunnel.relay.close()
    end, agent = socket.socketpair()
    with agent:
        tunnel.relay.open(end, "10.0.0.1:1")
        assert end.fileno() < 0
    assert len(tunnel.relay) == 0


# -- A carrier that breaks at each of its steps


class Breaking(SocketCarrier):
    """Carrier whose step number ``at`` fails."""

    def __init__(self, sock: socket.socket, at: int) -> None:
        super().__init__(sock)
        self.left = at

    def _step(self) -> None:
        self.left -= 1
        if self.left < 0:
            raise ConnectionResetError(errno.ECONNRESET, "Connection reset by peer")

    def receive(self) -> bytes | None:
        self._step()
        return super().receive()

    def write(self, data: bytes) -> None:
        self._step()
        super().write(data)

    def flush(self) -> None:
        self._step()
        super().flush()

    def close(self) -> None:
        super().close()
        self._step()


@pytest.mark.parametrize("side", ["relay", "master"])
def test_a_carrier_that_breaks_at_any_step_closes_everything(
    stepped: SteppedLoop, side: str
) -> None:
    whole = False
    step = 0
    while not whole:
        tunnel = Tunnel(stepped)
        end = getattr(tunnel, side)
        end._carrier = broken = Breaking(end._carrier.sock, step)
        for agent in [_open(tunnel) for _ in range(3)]:
            agent.give(noise(FIRST_CREDIT + 1))
        tunnel.pump()
        whole = broken.left >= 0
        if not whole:
            assert "connection reset by peer" in tunnel.ends
            assert len(tunnel.ends) == 2
            assert (len(tunnel.relay), len(tunnel.master)) == (0, 0)
            assert stepped.watched() == 0
            assert all(program.is_cut() for program in tunnel.programs)
        tunnel.close()
        step += 1
    assert step > 5


def _open(tunnel: Tunnel) -> Program:
    end, agent = socket.socketpair()
    tunnel.relay.open(end, "10.0.0.1:1")
    program = Program(agent)
    tunnel.programs.append(program)
    return program


def test_a_multiplexer_that_is_closed_by_what_it_calls_back_stops_there(
    stepped: SteppedLoop,
) -> None:
    near, far = socket.socketpair()
    hellos: list[StreamFrame] = []

    def close(frame: StreamFrame) -> None:
        hellos.append(frame)
        end.close()

    ends: list[str] = []
    end = Multiplexer(stepped, SocketCarrier(near), on_hello=close, on_end=ends.append)
    with far:
        far.send(StreamFrame(Kind.HELLO).encode() * 3)
        stepped.settle()
    assert len(hellos) == 1
    assert ends == []
    assert near.fileno() < 0
