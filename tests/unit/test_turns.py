"""Large frames in pieces: whose turn it is, and what waits for what."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest

from fiber._transport.link_protocol import SLOTS, LinkProtocol, SendQueue
from fiber._wire import memory_files
from unit.datagrams import outgoing

BUDGET = 64
LARGE = 10 * BUDGET


@pytest.fixture
def ends() -> tuple[LinkProtocol, LinkProtocol]:
    sender, receiver = (LinkProtocol(0, budget=BUDGET) for _ in range(2))
    sender.connected(0)
    receiver.connected(0)
    return sender, receiver


def arriving(sender: LinkProtocol, receiver: LinkProtocol) -> Iterator[bytes]:
    """The frames, in the order in which they are complete."""
    while not sender.idle:
        for datagram in outgoing(sender, 0):
            yield from map(bytes, receiver.received(datagram, 0))
        for answer in outgoing(receiver, 1):
            sender.received(answer, 1)


def filled(number: int, size: int) -> bytes:
    return bytes([number]) * size


def test_small_frames_pass_a_large_one_of_another_lane(
    ends: tuple[LinkProtocol, LinkProtocol],
) -> None:
    sender, receiver = ends
    large = filled(1, LARGE)
    sender.send(large, lane="one")
    for number in range(2, 8):
        sender.send(filled(number, 10), lane=number)
    arrived = list(arriving(sender, receiver))
    assert arrived == [*(filled(number, 10) for number in range(2, 8)), large]


def test_the_frames_of_a_lane_keep_their_order(
    ends: tuple[LinkProtocol, LinkProtocol],
) -> None:
    sender, receiver = ends
    frames = [filled(1, LARGE), b"behind it", filled(2, LARGE), b"last"]
    for frame in frames:
        sender.send(frame, lane="one")
    sender.send(b"of another", lane="other")
    assert list(arriving(sender, receiver)) == [b"of another", *frames]


def test_no_message_passes_one_without_a_lane(
    ends: tuple[LinkProtocol, LinkProtocol],
) -> None:
    sender, receiver = ends
    sender.send(filled(1, 2 * BUDGET))
    sender.send(filled(2, LARGE))
    sender.send(filled(3, LARGE), lane="one")
    sender.send(b"small", lane="two")
    arrived = list(arriving(sender, receiver))
    assert arrived == [filled(1, 2 * BUDGET), filled(2, LARGE), b"small", filled(3, LARGE)]


def test_large_frames_take_turns(ends: tuple[LinkProtocol, LinkProtocol]) -> None:
    sender, receiver = ends
    sender.send(filled(1, 10 * LARGE), lane="long")
    sender.send(filled(2, LARGE), lane="short")
    sender.send(filled(3, LARGE), lane="another short")
    arrived = [frame[0] for frame in arriving(sender, receiver)]
    assert arrived == [2, 3, 1]


def test_small_frames_without_end_do_not_keep_a_large_one_waiting() -> None:
    left: list[str] = []
    turns = SendQueue(BUDGET)
    turns.add([filled(1, LARGE)], "one", lambda: left.append("large"))
    for _ in range(4 * LARGE // BUDGET):
        for _ in range(10):
            turns.add([b"small"], None, None)
        turns.take()
    assert left == ["large"]


def test_no_more_frames_than_slots_are_put_together_at_a_time(
    ends: tuple[LinkProtocol, LinkProtocol],
) -> None:
    sender, receiver = ends
    frames = [filled(number, LARGE) for number in range(2 * SLOTS)]
    for number, frame in enumerate(frames):
        sender.send(frame, lane=number)
    together = 0
    arrived = []
    for frame in arriving(sender, receiver):
        arrived.append(frame)
        together = max(together, sum(each is not None for each in receiver._assemblies))
    assert sorted(arrived) == frames
    assert together <= SLOTS


def test_on_left_is_called_in_the_order_in_which_frames_leave(
    ends: tuple[LinkProtocol, LinkProtocol],
) -> None:
    sender, receiver = ends
    left: list[str] = []
    sender.send(filled(1, LARGE), lane="one", on_left=lambda: left.append("large"))
    sender.send(b"behind it", lane="one", on_left=lambda: left.append("behind it"))
    sender.send(b"small", lane="two", on_left=lambda: left.append("small"))
    assert not left
    assert len(list(arriving(sender, receiver))) == 3
    assert left == ["small", "large", "behind it"]
    assert sender.statistics().queued_bytes == sender.statistics().queued_frames == 0


def test_a_link_holds_at_most_a_window_and_the_partial_message() -> None:
    sender, receiver = (LinkProtocol(0, budget=BUDGET, window_bytes=4 * BUDGET) for _ in range(2))
    sender.connected(0)
    receiver.connected(0)
    sender.send(bytes(LARGE), lane="one")
    most = 0
    for _ in arriving(sender, receiver):
        pass
    sender.send(bytes(LARGE), lane="one")
    while not sender.idle:
        for datagram in outgoing(sender, 0):
            most = max(most, sender.statistics().unacknowledged_bytes)
            receiver.received(datagram, 0)
            assert receiver.statistics().partial_bytes <= LARGE
        for answer in outgoing(receiver, 1):
            sender.received(answer, 1)
    assert most <= 6 * BUDGET
    assert receiver.statistics().partial_bytes == 0


def test_a_stream_that_ends_drops_partial_frames(
    ends: tuple[LinkProtocol, LinkProtocol],
) -> None:
    sender, receiver = ends
    sender.send(bytes(LARGE), lane="one")
    receiver.received(outgoing(sender, 0)[0], 0)
    assert receiver.statistics().partial_bytes
    for end in ends:
        end.end()
        counts = end.statistics()
        assert counts.partial_bytes == counts.queued_bytes == counts.unacknowledged_bytes == 0


@pytest.mark.parametrize("seed", range(20))
def test_whatever_is_sent_arrives_in_the_order_that_is_promised(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory_files, "IN_FILE", 3 * BUDGET)
    rng = random.Random(seed)
    sender, receiver = (LinkProtocol(0, budget=BUDGET) for _ in range(2))
    sender.connected(0)
    receiver.connected(0)
    sent: list[tuple[int | None, bytes]] = []
    arrived: list[bytes] = []

    def carry() -> None:
        datagrams = outgoing(sender, 0)
        lost = rng.random() < 0.2
        for datagram in datagrams[: rng.randrange(len(datagrams) + 1) if lost else None]:
            arrived.extend(map(bytes, receiver.received(datagram, 0)))
        if lost:
            for end, other in ((sender, receiver), (receiver, sender)):
                end.disconnected()
                end.connected(other.arrived)
        for answer in outgoing(receiver, 1):
            sender.received(answer, 1)

    for number in range(100):
        lane = rng.choice((None, 1, 2, 3))
        size = rng.choice((1, BUDGET // 2, BUDGET, LARGE, 3 * LARGE))
        frame = number.to_bytes(4, "big") + rng.randbytes(size)
        cut = rng.randrange(len(frame))
        sender.send(frame[:cut], frame[cut:], lane=lane)
        sent.append((lane, frame))
        if rng.random() < 0.3:
            carry()
    while not sender.idle:
        carry()
    place = {frame: at for at, frame in enumerate(arrived)}
    assert len(arrived) == len(place) == len(sent)
    for at, (lane, frame) in enumerate(sent):
        for earlier, before in sent[:at]:
            if earlier is None or earlier == lane:
                assert place[before] < place[frame]
