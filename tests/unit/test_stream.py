"""The stream: every frame once and in order, through all faults of its connections."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fiber._transport.link_protocol import (
    ACK_DELAY,
    BUDGET,
    FIRST,
    HEARTBEAT,
    LARGE,
    LAST,
    SIZE,
    SLOT_SHIFT,
    WINDOW,
    WINDOW_BYTES,
    Gap,
    LinkProtocol,
)
from fiber._wire.messages import ProtocolError
from unit.datagrams import joined, outgoing

BUDGET_SMALL = 64


class Network:
    """Two ends of a stream, and a connection between them that does what ``rng`` says."""

    def __init__(self, rng: random.Random, *, drop: float = 0, repeat: float = 0, swap: float = 0):
        self.rng = rng
        self.drop, self.repeat, self.swap = drop, repeat, swap
        self.now = 100.0
        self.ends = [LinkProtocol(self.now, budget=BUDGET_SMALL) for _ in range(2)]
        self.flying: list[list[bytes]] = [[], []]
        self.got: list[list[bytes]] = [[], []]
        self.sent: list[list[bytes]] = [[], []]
        self.connect()

    def connect(self) -> None:
        one, other = self.ends
        one.connected(other.arrived)
        other.connected(one.arrived)

    def reconnect(self) -> None:
        """Break the connection: what was under way is lost, or still arrives at first."""
        for side, flying in enumerate(self.flying):
            arriving = flying[: self.rng.randrange(len(flying) + 1)]
            flying.clear()
            for datagram in arriving:
                try:
                    self.got[1 - side] += map(
                        bytes, self.ends[1 - side].received(datagram, self.now)
                    )
                except Gap:
                    break
        for end in self.ends:
            end.disconnected()
        self.connect()

    def send(self, side: int, frame: bytes) -> None:
        self.sent[side].append(frame)
        self.ends[side].send(frame)

    def speak(self, side: int) -> None:
        wanted = self.ends[side].wants_to_speak(self.now)
        datagrams = outgoing(self.ends[side], self.now)
        assert wanted == bool(datagrams)
        for datagram in datagrams:
            if self.rng.random() < self.drop:
                continue
            self.flying[side].append(datagram)
            if self.rng.random() < self.repeat:
                self.flying[side].append(datagram)

    def arrive(self, side: int) -> None:
        """Hand the oldest datagram under way (or the one after it) to the other side."""
        flying = self.flying[side]
        if flying:
            late = len(flying) > 1 and self.rng.random() < self.swap
            datagram = flying.pop(1 if late else 0)
            try:
                frames = self.ends[1 - side].received(datagram, self.now)
            except Gap:
                self.reconnect()
            else:
                self.got[1 - side] += map(bytes, frames)

    def settle(self) -> None:
        """A connection without faults and time to recover: everything must arrive."""
        self.drop = self.repeat = self.swap = 0
        deadline = self.now + 60
        while not all(end.idle for end in self.ends):
            for side in (0, 1):
                self.speak(side)
                while self.flying[side]:
                    self.arrive(side)
            if not any(self.flying):
                self.now = max(self.now, min(end.next_timer() for end in self.ends))
                for end in self.ends:
                    end.tick(self.now)
            assert self.now < deadline, "no progress"

    def check(self) -> None:
        assert self.got[1] == self.sent[0]
        assert self.got[0] == self.sent[1]


def steps_of(network: Network) -> list[Callable[[], None]]:
    rng = network.rng

    def frame() -> bytes:
        size = rng.choice((0, 1, 10, BUDGET_SMALL - 1, BUDGET_SMALL, BUDGET_SMALL + 1, 300))
        return rng.randbytes(size)

    def pass_time() -> None:
        network.now += rng.choice((0.0, 0.001, ACK_DELAY, 1.0))

    def check_so_far() -> None:
        for side in (0, 1):
            got = network.got[1 - side]
            assert got == network.sent[side][: len(got)]

    return [
        *(lambda side=side: network.send(side, frame()) for side in (0, 1)),
        *(lambda side=side: network.speak(side) for side in (0, 1)),
        *(lambda side=side: network.arrive(side) for side in (0, 1) for _ in range(2)),
        pass_time,
        check_so_far,
    ]


@pytest.mark.parametrize("block", range(10))
def test_every_frame_arrives_once_and_in_order(block: int) -> None:
    for seed in range(50 * block, 50 * (block + 1)):
        try:
            run_schedule(seed)
        except BaseException as error:
            error.add_note(f"with seed {seed}")
            raise


def run_schedule(seed: int) -> None:
    rng = random.Random(seed)
    faults = {name: rng.choice((0, 0.05, 0.4)) for name in ("drop", "repeat", "swap")}
    network = Network(rng, **faults)
    steps = [*steps_of(network), *[network.reconnect] * rng.choice((0, 1))]
    for _ in range(200):
        rng.choice(steps)()
    network.settle()
    network.check()


@settings(max_examples=100, deadline=None)
@given(
    sizes=st.lists(st.integers(0, 5 * BUDGET_SMALL), max_size=12),
    cuts=st.sets(st.integers(0, 60)),
    seed=st.integers(0, 2**32),
)
def test_a_break_at_any_step_loses_no_frame(sizes: list[int], cuts: set[int], seed: int) -> None:
    network = Network(random.Random(seed))
    for number, size in enumerate(sizes):
        network.send(number % 2, bytes([number]) * size)
    for step in range(60):
        if step in cuts:
            network.reconnect()
        network.speak(step % 2)
        network.arrive(1 - step % 2)
    network.settle()
    network.check()


def pair(now: float = 0.0, *, budget: int = BUDGET) -> tuple[LinkProtocol, LinkProtocol]:
    one, other = (LinkProtocol(now, budget=budget) for _ in range(2))
    one.connected(0)
    other.connected(0)
    meet(one, other, now)
    return one, other


def meet(one: LinkProtocol, other: LinkProtocol, now: float) -> None:
    """Exchange what both have to say."""
    for datagram in outgoing(one, now):
        other.received(datagram, now)
    for datagram in outgoing(other, now):
        one.received(datagram, now)


def test_a_new_connection_sends_a_datagram_without_a_message() -> None:
    one, other = LinkProtocol(0), LinkProtocol(0)
    one.connected(0)
    other.connected(0)
    assert not other.has_received
    (datagram,) = outgoing(one, 0)
    assert other.received(datagram, 0) == []
    assert other.has_received


def test_frames_that_wait_travel_in_one_datagram() -> None:
    one, other = pair()
    frames = [b"%d" % number for number in range(1000)]
    for frame in frames:
        one.send(frame)
    (datagram,) = outgoing(one, 0)
    assert other.received(datagram, 0) == frames


def test_a_frame_in_pieces_arrives_as_one_however_it_is_cut() -> None:
    for sizes in ((0, 1, 0), (BUDGET_SMALL, 1), (1, 3 * BUDGET_SMALL, 0, 5), (BUDGET_SMALL - 4, 9)):
        one, other = pair(budget=BUDGET_SMALL)
        pieces = [random.Random(size).randbytes(size) for size in sizes]
        one.send(*pieces)
        one.send(b"after it")
        frames = [f for datagram in outgoing(one, 0) for f in other.received(datagram, 0)]
        assert frames == [b"".join(pieces), b"after it"]
        assert one.statistics().queued_bytes == 0


def test_a_large_piece_is_sent_from_where_it_is() -> None:
    one, other = pair()
    large = bytearray(LARGE)
    one.send(b"head", large)
    (datagram,) = one.outgoing(0)
    large[-1] = 1  # so it is no copy that leaves
    assert other.received(joined(datagram), 0) == [b"head" + large]
    one.send(b"head", large[:-1])
    assert isinstance(one.outgoing(0)[0], bytes), "small ones are put together at once"


def test_the_window_bounds_the_unconfirmed_bytes() -> None:
    one, other = pair()
    frame = bytes(2 * WINDOW_BYTES - BUDGET)
    one.send(frame)
    first = outgoing(one, 0)
    assert WINDOW_BYTES <= one.statistics().unacknowledged_bytes <= WINDOW_BYTES + BUDGET
    assert outgoing(one, 0) == []
    acknowledgements = 0
    for datagram in first:
        assert other.received(datagram, 0) == []
        for acknowledgement in outgoing(other, 0):
            one.received(acknowledgement, 0)
            acknowledgements += 1
    assert acknowledgements == 4, "one for each quarter of the window"
    second = outgoing(one, 0)
    assert [f for datagram in second for f in other.received(datagram, 0)] == [frame]


def test_the_window_bounds_the_unconfirmed_frames() -> None:
    one, other = pair()
    datagrams = []
    for number in range(2 * WINDOW):
        one.send(b"%d" % number)
        datagrams += outgoing(one, 0)
    assert len(datagrams) == WINDOW == one.statistics().unacknowledged_datagrams
    for datagram in datagrams[: WINDOW // 4]:
        other.received(datagram, 0)
    (acknowledgement,) = outgoing(other, 0)
    one.received(acknowledgement, 0)
    (rest,) = outgoing(one, 0)
    assert one.statistics().queued_frames == 0
    for datagram in datagrams[WINDOW // 4 :]:
        other.received(datagram, 0)
    assert len(other.received(rest, 0)) == WINDOW, "what waited travels together"


def test_request_and_reply_need_no_separate_acknowledgement() -> None:
    one, other = pair()
    now = 0.0
    for number in range(10):
        one.send(b"request %d" % number)
        (request,) = outgoing(one, now)
        assert other.received(request, now) == [b"request %d" % number]
        assert outgoing(other, now) == []
        now += ACK_DELAY / 2
        other.send(b"reply")
        (reply,) = outgoing(other, now)
        assert one.received(reply, now) == [b"reply"]
    assert outgoing(one, now) == []
    assert one.statistics().datagrams_sent == 11


def test_an_acknowledgement_waits_only_so_long() -> None:
    one, other = pair()
    one.send(b"note")
    other.received(outgoing(one, 0)[0], 0)
    assert outgoing(other, 0) == []
    assert other.next_timer() == ACK_DELAY
    (acknowledgement,) = outgoing(other, ACK_DELAY)
    one.received(acknowledgement, ACK_DELAY)
    assert one.idle


def test_the_datagram_after_a_lost_one_raises_gap() -> None:
    one, other = pair()
    one.send(b"lost")
    outgoing(one, 0)
    one.send(b"next")
    (after,) = outgoing(one, 0)
    with pytest.raises(Gap, match="datagram 2 came where 1 was expected"):
        other.received(after, 0)
    assert other.statistics().missed == 1


def test_a_last_loss_is_noticed_by_the_heartbeat() -> None:
    one, other = pair()
    one.send(b"lost")
    outgoing(one, 0)
    (beat,) = outgoing(one, HEARTBEAT)
    with pytest.raises(Gap):
        other.received(beat, HEARTBEAT)


def test_a_repetition_is_dropped_and_acknowledged_at_once() -> None:
    one, other = pair()
    one.send(b"twice")
    (datagram,) = outgoing(one, 0)
    assert other.received(datagram, 0) == [b"twice"]
    assert other.received(datagram, 0) == []
    assert len(outgoing(other, 0)) == 1
    assert other.statistics().repeated == 1


def test_frames_wait_while_disconnected_and_leave_afterwards() -> None:
    one, other = pair()
    one.send(b"under way")
    outgoing(one, 0)
    one.disconnected()
    other.disconnected()
    one.send(b"queued")
    assert not one.wants_to_speak(50)
    assert outgoing(one, 50) == []
    one.connected(other.arrived)
    other.connected(one.arrived)
    frames = [frame for datagram in outgoing(one, 50) for frame in other.received(datagram, 50)]
    assert frames == [b"under way", b"queued"]
    assert one.statistics().breaks == one.statistics().resent == 1


@pytest.mark.parametrize("arrived", [-1, 3])
def test_a_peer_that_lost_its_place_cannot_resume(arrived: int) -> None:
    one, other = pair()
    for frame in (b"1", b"2"):
        one.send(frame)
        other.received(outgoing(one, 0)[0], 0)
    one.received(outgoing(other, ACK_DELAY)[0], 0)
    one.disconnected()
    with pytest.raises(ProtocolError, match=f"cannot resume after datagram {arrived}"):
        one.connected(arrived)


def test_an_idle_stream_says_that_it_is_alive() -> None:
    one, other = pair()
    assert outgoing(one, HEARTBEAT - 0.1) == []
    (beat,) = outgoing(one, HEARTBEAT)
    assert other.received(beat, HEARTBEAT) == []
    assert other.tick(HEARTBEAT) == 0
    assert outgoing(other, HEARTBEAT - 0.1) == [], "a heartbeat needs no answer"


def test_silence_counts_only_while_this_process_runs() -> None:
    stream, _ = pair()
    for now in range(1, 8):
        assert stream.next_timer() <= now
        assert stream.tick(now) == now
    assert stream.tick(1000) == 7 + 2 * HEARTBEAT / 3


def test_statistics_count_bytes_and_frames() -> None:
    one, other = pair()
    one.send(b"abc")
    assert one.statistics().queued_frames == 1
    (datagram,) = outgoing(one, 0)
    other.received(datagram, 0)
    counts = other.statistics()
    assert (counts.frames_received, counts.bytes_received) == (1, 24 + len(datagram))
    assert one.statistics().unacknowledged_bytes == len(datagram)
    assert one.statistics().frames_sent == 1


def entries(*pieces: tuple[int, bytes]) -> bytes:
    """A first datagram with these marks and bytes."""
    words = [marks | len(piece) for marks, piece in pieces]
    head = struct.pack(f"<BxxxIQQ{len(words)}I", 1, len(words), 1, 0, *words)
    return head + b"".join(piece for _, piece in pieces)


def numbered(frames: int) -> bytes:
    one, _ = pair()
    for _ in range(frames):
        one.send(b"frame")
    return outgoing(one, 0)[0]


@pytest.mark.parametrize(
    ("datagram", "complaint"),
    [
        (b"", "0 bytes has no header"),
        (b"\x07" + bytes(23), "unknown kind 7"),
        (numbered(3)[:-1], "does not hold the 3 entries"),
        (numbered(3) + b"!", "does not hold the 3 entries"),
        (
            b"\x01\x00\x00\x00\xff\xff\xff\xff\x01" + bytes(15),
            "does not hold the 4294967295 entries",
        ),
        (b"\x01\x00\x00\x00\x00\x00\x00\x00\x01" + bytes(15), "does not hold the 0 entries"),
        (entries((0, b"more")), "a piece does not go on where slot 0 ended"),
        (entries((FIRST, SIZE.pack(9)), (FIRST, SIZE.pack(9))), "where slot 0 ended"),
        (entries((FIRST, b"1234567")), "cannot be put together: unpack_from requires"),
        (entries((FIRST, SIZE.pack(2) + b"123")), "it has more than the 2 bytes that it announced"),
        (entries((FIRST, SIZE.pack(9)), (LAST, b"1")), "it ends after 1 of 9 bytes"),
        (entries((FIRST, SIZE.pack(2**60))), "cannot be put together"),
        (entries((FIRST, SIZE.pack(2**64 - 1))), "cannot be put together"),
        (b"\x02" + bytes(15) + b"\x09" + bytes(7), "acknowledges datagram 9, but only 0 were sent"),
    ],
)
def test_a_datagram_that_no_stream_sends_is_refused(datagram: bytes, complaint: str) -> None:
    stream, _ = pair()
    with pytest.raises(ProtocolError, match=complaint):
        stream.received(datagram, 0)


def test_frames_in_pieces_have_no_more_bytes_at_the_same_time_than_the_limit() -> None:
    stream, _ = pair()
    stream.largest = 9
    slot = 1 << SLOT_SHIFT
    within = entries((FIRST, SIZE.pack(4) + b"12"), (FIRST | slot, SIZE.pack(5) + b"12"))
    assert stream.received(within, 0) == []
    stream, _ = pair()
    stream.largest = 8
    with pytest.raises(ProtocolError, match="9 bytes are announced, and 8 may come"):
        stream.received(within, 0)


@given(st.binary(max_size=80))
def test_noise_never_raises_anything_else(datagram: bytes) -> None:
    stream, _ = pair()
    try:
        stream.received(datagram, 0)
    except ProtocolError:
        pass
