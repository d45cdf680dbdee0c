"""Large frames put together from pieces, and packets that refer to where these lie."""

from __future__ import annotations

import os
import resource
import socket
from collections.abc import Iterator

import pytest

from fiber._wire import memory_files, packet
from fiber._wire.memory_files import IN_FILE, RETAINED_LIMIT, Assembly, pass_on
from fiber._wire.messages import Deliver, FromChild, TunnelData, decode, is_passed_on
from fiber._wire.packet import INLINE_LIMIT

SIZES = (INLINE_LIMIT + 1, IN_FILE, RETAINED_LIMIT + 1)

Pair = tuple[socket.socket, socket.socket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with one, other:
        yield one, other


def arrived(*parts: bytes) -> Deliver:
    """A message with these buffers, after it was put together from pieces."""
    sent = Deliver(1, 2, b"payload", parts).encode()
    whole = Assembly(len(sent))
    for start in range(0, len(sent), 1 << 20):
        whole.add(memoryview(sent)[start : start + (1 << 20)])
    message = decode(whole.frame())
    assert isinstance(message, Deliver)
    assert message.buffers == list(parts)
    return message


def views(message: Deliver) -> list[memoryview]:
    return [memoryview(buffer) for buffer in message.buffers]


@pytest.mark.parametrize("size", SIZES)
def test_a_packet_brings_parts_of_a_frame(pair: Pair, size: int) -> None:
    one, other = pair
    parts = [os.urandom(size), os.urandom(INLINE_LIMIT)]
    message = arrived(*parts)
    for buffer in views(message):
        pass_on(buffer)
    for payload, buffers in ((b"small", views(message)), (views(message)[0], views(message)[1:])):
        packet.send(one, payload, buffers)
        received = packet.receive(other)
        assert received.payload == payload
        assert received.buffers == buffers
        assert not any(buffer.readonly for buffer in received.buffers)
        received.release()


def test_a_packet_refers_to_memory_that_was_passed_on_and_copies_any_other(pair: Pair) -> None:
    one, other = pair
    message = arrived(bytes(RETAINED_LIMIT))
    (buffer,) = views(message)
    packet.send(one, b"", [buffer])
    pass_on(buffer)
    packet.send(one, b"", [buffer])
    buffer[:3] = b"now"
    copied, passed = packet.receive(other), packet.receive(other)
    assert bytes(copied.buffers[0][:3]) == bytes(3)
    assert bytes(passed.buffers[0][:3]) == b"now"


def test_parts_of_two_frames_are_copied(pair: Pair) -> None:
    one, other = pair
    buffers = [*views(arrived(b"1" * IN_FILE)), *views(arrived(b"2" * IN_FILE))]
    for buffer in buffers:
        pass_on(buffer)
    packet.send(one, b"payload", buffers)
    message = packet.receive(other)
    assert bytes(message.payload) == b"payload"
    assert message.buffers == buffers
    message.release()


def test_a_process_that_may_write_no_file_keeps_a_frame_in_its_own_memory(pair: Pair) -> None:
    one, other = pair
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
    try:
        message = arrived(b"x" * IN_FILE)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    (buffer,) = views(message)
    assert memory_files.place_of(buffer) is None
    pass_on(buffer)
    packet.send(one, b"payload", [buffer])
    assert packet.receive(other).buffers == [buffer]


def test_a_frame_that_is_not_passed_on_takes_no_descriptor() -> None:
    frame = os.urandom(IN_FILE)
    before = os.listdir("/proc/self/fd")
    whole = Assembly(len(frame), passed_on=False)
    whole.add(memoryview(frame))
    assert os.listdir("/proc/self/fd") == before
    assert bytes(whole.frame()) == frame


def test_the_master_keeps_its_childrens_messages_and_forwards_the_rest() -> None:
    assert not is_passed_on(FromChild(1, b"result").encode())
    assert is_passed_on(Deliver(1, 2, b"task").encode())
    assert is_passed_on(TunnelData(1, b"item").encode())


@pytest.mark.parametrize("size", [0, 10, IN_FILE])
def test_a_frame_is_no_longer_and_no_shorter_than_announced(size: int) -> None:
    whole = Assembly(size)
    with pytest.raises(ValueError, match=f"more than the {size} bytes"):
        whole.add(memoryview(bytes(size + 1)))
    if size:
        with pytest.raises(ValueError, match=f"it ends after 0 of {size} bytes"):
            Assembly(size).frame()
