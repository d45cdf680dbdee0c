"""Packets: one whole message each, at every size, with all that belongs to it or nothing."""

from __future__ import annotations

import ctypes
import mmap
import os
import pickle
import resource
import socket
import struct
import threading
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fiber._wire import memory_files, packet
from fiber._wire.descriptor import own
from fiber._wire.memory_files import RETAINED_LIMIT
from fiber._wire.packet import BULK, INLINE_LIMIT
from fiber.errors import TooManyOpenFiles
from patience import PATIENCE

SIZES = [0, 1, 2047, 2048, INLINE_LIMIT - 1, INLINE_LIMIT, INLINE_LIMIT + 1, BULK + 1, 3_000_000]

Pair = tuple[socket.socket, socket.socket]


@pytest.fixture
def pair() -> Iterator[Pair]:
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with one, other:
        yield one, other


def views(*sizes: int) -> list[memoryview]:
    return [memoryview(os.urandom(size)) for size in sizes]


# Content


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_a_payload_of_any_size_arrives(pair: Pair, size: int, kind: type) -> None:
    one, other = pair
    payload = os.urandom(size)
    packet.send(one, kind(payload))
    message = packet.receive(other)
    assert message.buffers == []
    assert message.tobytes() == payload


@given(st.lists(st.sampled_from(SIZES), min_size=1, max_size=5))
@settings(max_examples=30, deadline=None)
def test_payload_and_buffers_arrive_apart(sizes: list[int]) -> None:
    one, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with one, other:
        payload, *buffers = views(*sizes)
        packet.send(one, payload, buffers)
        message = packet.receive(other)
        assert message.payload == payload
        assert message.buffers == buffers
        assert not any(buffer.readonly for buffer in message.buffers)
        message.release()


def test_packets_stay_apart_and_in_order(pair: Pair) -> None:
    one, other = pair
    payloads = [os.urandom(size) for size in (3, 0, INLINE_LIMIT + 5, 1)]
    for payload in payloads:
        packet.send(one, payload)
    assert [packet.receive(other).tobytes() for _ in payloads] == payloads


def test_memory_above_the_limit_of_reuse_belongs_to_the_receiver(pair: Pair) -> None:
    one, other = pair
    payload = bytes(RETAINED_LIMIT + 1)
    packet.send(one, payload)
    message = packet.receive(other)
    assert len(message.payload) == len(payload)
    message.payload[0] = 7
    packet.send(one, payload)
    assert packet.receive(other).payload[0] == 0
    assert message.payload[0] == 7


def test_reuse_of_memory_does_not_change_received_messages(pair: Pair) -> None:
    one, other = pair
    received = []
    for number in range(8):
        packet.send(one, bytes([number]) * 200_000)
        received.append(packet.receive(other).payload)
    assert [bytes(payload[:1]) for payload in received] == [bytes([n]) for n in range(8)]


def test_a_large_message_that_is_passed_on_stays_where_it_is(pair: Pair) -> None:
    sender, receiver = pair
    content = os.urandom(1 << 20)
    for _ in range(3):
        packet.send(sender, b"payload", [memoryview(content)])
        message = packet.receive(receiver, passing=True)
        (buffer,) = message.buffers
        assert (bytes(message.payload), bytes(buffer)) == (b"payload", content)
        assert isinstance(buffer.obj, mmap.mmap)


def test_messages_held_at_once_do_not_share_memory(pair: Pair) -> None:
    one, other = pair
    for number in range(3):
        packet.send(one, bytes([number]))
    messages = [packet.receive(other) for _ in range(3)]
    assert [bytes(message.payload) for message in messages] == [b"\0", b"\1", b"\2"]
    for message in messages:
        message.release()


# Objects


def test_objects_arrive_with_their_arrays_writable(pair: Pair) -> None:
    one, other = pair
    arrays = [np.arange(size) for size in (3, 20_000, 1_000_000)]
    payload, buffers = packet.dumps({"arrays": arrays})
    assert [buffer.nbytes for buffer in buffers] == [array.nbytes for array in arrays[1:]]
    packet.send(one, payload, buffers)
    got = packet.loads(packet.receive(other))["arrays"]
    for array, copy in zip(arrays, got, strict=True):
        assert (array == copy).all()
        assert copy.flags.writeable


def test_a_message_is_released_after_any_unpickling(pair: Pair) -> None:
    one, other = pair
    packet.send(one, b"no pickle")
    message = packet.receive(other)
    with pytest.raises(pickle.UnpicklingError):
        packet.loads(message)
    assert message._buffer is None


def test_too_many_buffers_are_refused(pair: Pair) -> None:
    with pytest.raises(ValueError, match="1025 out-of-band buffers"):
        packet.send(pair[0], b"", [memoryview(b"x")] * 1025)


# Descriptors


@pytest.mark.parametrize("size", [0, INLINE_LIMIT + 1])
def test_descriptors_go_along(pair: Pair, size: int) -> None:
    one, other = pair
    reader, writer = os.pipe()
    packet.send(one, bytes(size), (), [reader, writer])
    os.close(reader)
    os.close(writer)
    message = packet.receive(other, descriptors=True)
    got_reader, got_writer = message.fds
    os.write(got_writer, b"through")
    assert os.read(got_reader, 10) == b"through"
    message.close_descriptors()
    assert message.fds == []
    message.release()


def test_received_descriptors_do_not_leak_into_programs_we_start(pair: Pair) -> None:
    one, other = pair
    packet.send(one, b"", (), [one.fileno()])
    message = packet.receive(other, descriptors=True)
    inherited = [fd for fd in message.fds if os.get_inheritable(fd)]
    message.close_descriptors()
    message.release()
    assert inherited == []


def test_descriptors_that_find_no_room_are_an_error_that_says_the_limit(pair: Pair) -> None:
    one, other = pair
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    packet.send(one, b"with a descriptor", (), [one.fileno()])
    highest = max(int(name) for name in os.listdir("/proc/self/fd"))
    filler = []
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (highest + 1, hard))
        try:
            while True:
                filler.append(os.dup(0))
        except OSError:
            pass  # full
        with pytest.raises(TooManyOpenFiles, match="receiving a descriptor"):
            packet.receive(other, descriptors=True)
    finally:
        for fd in filler:
            os.close(fd)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


# Waiting, and the end


def test_receive_without_waiting_raises_if_no_message_is_there(pair: Pair) -> None:
    one, other = pair
    with pytest.raises(BlockingIOError):
        packet.receive(other, wait=False)
    packet.send(one, b"x")
    assert packet.receive(other, wait=False).tobytes() == b"x"


@pytest.mark.parametrize("size", [10, 200_000])
def test_a_full_socket_takes_no_packet(pair: Pair, size: int) -> None:
    one, other = pair
    one.setblocking(False)
    sent = 0
    try:
        while True:
            packet.send(one, bytes(size))
            sent += 1
    except BlockingIOError:
        pass  # full
    for _ in range(sent):
        assert len(packet.receive(other).tobytes()) == size
    with pytest.raises(BlockingIOError):
        packet.receive(other, wait=False)
    packet.send(one, b"there is room again")


def test_a_bulky_message_fills_the_socket_until_it_is_read(pair: Pair) -> None:
    one, other = pair
    assert packet.send(one, bytes(BULK + 1), ballast=True)
    assert not packet.send(one, b"small", ballast=True)
    writable = threading.Event()

    def wait_until_writable() -> None:
        import select

        poller = select.poll()
        poller.register(one, select.POLLOUT)
        poller.poll()
        writable.set()

    thread = threading.Thread(target=wait_until_writable)
    thread.start()
    assert not writable.wait(0.05)
    assert len(packet.receive(other).payload) == BULK + 1
    assert writable.wait(PATIENCE)
    thread.join()
    assert packet.receive(other).tobytes() == b"small"


def test_the_end_comes_after_the_last_packet(pair: Pair) -> None:
    one, other = pair
    packet.send(one, b"last")
    one.close()
    assert packet.receive(other).tobytes() == b"last"
    with pytest.raises(EOFError):
        packet.receive(other)
    with pytest.raises(BrokenPipeError):
        packet.send(other, b"x")


def test_an_unread_message_of_a_closed_peer_does_not_hide_its_own(pair: Pair) -> None:
    one, other = pair
    packet.send(other, b"never read")
    packet.send(one, b"still here")
    one.close()
    assert packet.receive(other).tobytes() == b"still here"
    with pytest.raises(EOFError):
        packet.receive(other)


def test_sending_to_a_peer_that_left_messages_unread_is_a_broken_pipe(pair: Pair) -> None:
    one, other = pair
    packet.send(other, b"never read")
    one.close()
    with pytest.raises(BrokenPipeError):
        packet.send(other, b"x")


@pytest.mark.parametrize("junk", [b"\x01", b"\x07" + bytes(40), b"\x01" + bytes(3)])
def test_junk_raises_and_its_buffer_is_reused(pair: Pair, junk: bytes) -> None:
    one, other = pair
    one.send(junk)
    free = len(packet._buffers.free)
    with pytest.raises((struct.error, ValueError, IndexError)):
        packet.receive(other)
    assert len(packet._buffers.free) >= free
    packet.send(one, b"next")
    assert packet.receive(other).tobytes() == b"next"


# Large objects


def test_large_bytes_in_a_call_are_not_copied_into_its_pickle() -> None:
    large, small = os.urandom(packet.OUT_OF_BAND_MIN), b"small"
    call = (max, (large, small, large), {"key": len})
    data, buffers = packet.dumps(call)
    assert len(data) < 1000
    assert [buffer.obj for buffer in buffers] == [large]
    assert buffers[0].obj is large
    function, (one, other, same), keywords = pickle.loads(data, buffers=map(bytearray, buffers))
    assert (function, one, other, keywords) == (max, large, small, {"key": len})
    assert same is one
    assert type(one) is bytes


def test_a_buffer_that_can_change_is_kept_as_a_copy() -> None:
    fixed, open_ = bytes(10), bytearray(10)
    views = packet.kept([memoryview(fixed), memoryview(open_)])
    open_[0] = 1
    assert views == [fixed, fixed]
    assert views[0].obj is fixed


@pytest.mark.parametrize("size", [0, 1, packet.OUT_OF_BAND_MIN, 5_000_000])
def test_a_copy_without_the_interpreter_lock_is_equal_to_its_source(size: int) -> None:
    source = bytearray(os.urandom(size))
    made = memory_files.copy_bytes(memoryview(source).toreadonly())
    assert type(made) is bytes
    assert made == source
    assert hash(made) == hash(bytes(source))


def test_a_copy_of_a_mapped_message_is_read_from_its_file(monkeypatch: pytest.MonkeyPatch) -> None:
    size = 33 << 20
    file = own(os.memfd_create("message"))
    os.pwrite(file.fileno(), b"header" + os.urandom(size), 0)
    mapped = memory_files.mapping(file, 6 + size)
    expected = bytes(mapped[6:])
    monkeypatch.setattr(ctypes, "memmove", None)  # it would fault at every page
    assert memory_files.copy_bytes(memoryview(mapped)[6:]) == expected
    os.ftruncate(file.fileno(), size)
    with pytest.raises(ValueError, match=f"ends after {size - 6} of {size} bytes"):
        memory_files.copy_bytes(memoryview(mapped)[6:])
