"""The frames between master and agent."""

from __future__ import annotations

import pickle
from array import array

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber._agent.interface import Cause
from fiber._wire.blob_messages import (
    DIGEST_BYTES,
    Fetch,
    Forget,
    Holding,
    KeepBlob,
    Lacking,
    Serve,
    Unfetched,
    Want,
)
from fiber._wire.messages import (
    ChildOutput,
    Deliver,
    DeliverShared,
    Exited,
    FromChild,
    Leave,
    LinkMessage,
    Measure,
    Measured,
    ProtocolError,
    Recall,
    Recalled,
    Shutdown,
    Signal,
    Start,
    Started,
    TunnelClose,
    TunnelData,
    TunnelOpen,
    decode,
    lane,
)
from fiber._wire.packet_layout import PROTOCOL

SECRET = "the user's own"

ids = st.integers(0, 2**64 - 1)
numbers = st.integers(-(2**63), 2**63 - 1)
data = st.binary(max_size=200)
buffers = st.lists(data, max_size=4)
any_text = st.text(st.characters(), max_size=50)

digests = st.binary(min_size=DIGEST_BYTES, max_size=DIGEST_BYTES)

messages: st.SearchStrategy[LinkMessage] = st.one_of(
    st.builds(Start, ids, data, data),
    st.builds(KeepBlob, digests, data),
    st.builds(Forget, digests),
    st.builds(Leave, st.floats(allow_nan=False), any_text),
    st.builds(Lacking, digests),
    st.builds(Serve, digests, ids, ids),
    st.builds(Fetch, digests, ids, ids, any_text, any_text, any_text, any_text, ids),
    st.builds(Holding, digests, ids, any_text, any_text, any_text),
    st.builds(Unfetched, digests, ids, any_text),
    st.builds(Want, digests),
    st.builds(Started, ids, numbers),
    st.builds(Signal, ids, numbers),
    st.builds(Deliver, ids, ids, data, buffers),
    st.builds(
        DeliverShared,
        ids,
        ids,
        st.lists(st.tuples(st.integers(0, 2**32 - 1), digests), max_size=3).map(tuple),
        data,
        buffers,
    ),
    st.builds(FromChild, ids, data, buffers),
    st.builds(Recall, ids),
    st.builds(Measure, ids),
    st.builds(Measured, ids, ids, ids),
    st.builds(Recalled, ids, st.lists(ids).map(tuple)),
    st.builds(
        Exited,
        ids,
        ids,
        numbers,
        any_text,
        st.lists(ids, max_size=3).map(tuple),
        st.none() | st.tuples(ids, ids),
        st.lists(any_text, max_size=3).map(tuple),
        any_text,
        st.sampled_from(Cause),
    ),
    st.builds(ChildOutput, ids, any_text),
    st.builds(TunnelOpen, ids, any_text),
    st.builds(TunnelData, ids, data, buffers),
    st.builds(TunnelClose, ids, any_text),
    st.builds(Shutdown, st.floats(allow_nan=False)),
)


@given(messages)
def test_encoded_messages_decode_to_equal_ones(message: LinkMessage) -> None:
    assert decode(message.encode()) == message


@given(messages, st.data())
def test_a_damaged_frame_raises_only_protocol_error(
    message: LinkMessage, draw: st.DataObject
) -> None:
    frame = bytearray(message.encode())
    for _ in range(draw.draw(st.integers(0, 3))):
        position = draw.draw(st.integers(0, len(frame) - 1))
        frame[position] = draw.draw(st.integers(0, 255))
    size = draw.draw(st.integers(0, len(frame)))
    try:
        decode(bytes(frame[:size]))
    except ProtocolError:
        pass


@given(st.integers(0, 30), data)
def test_noise_of_any_kind_raises_only_protocol_error(kind: int, noise: bytes) -> None:
    try:
        decode(bytes([PROTOCOL, kind]) + noise)
    except ProtocolError:
        pass


@pytest.mark.parametrize(
    ("frame", "complaint"),
    [
        (b"", "a frame of 0 bytes is too short"),
        (bytes([PROTOCOL + 1, 1]), f"protocol version {PROTOCOL + 1}; this process has {PROTOCOL}"),
        (bytes([PROTOCOL, 99]), "unknown kind 99"),
        (Signal(1, 15).encode()[:-1], "of kind signal and 17 bytes is malformed"),
        (Recall(1).encode() + b"!", "of kind recall and 11 bytes is malformed"),
        (Forget(bytes(DIGEST_BYTES)).encode()[:-1], "of kind forget and 33 bytes is malformed"),
        (
            KeepBlob(bytes(DIGEST_BYTES), b"").encode()[:-1],
            "of kind blob and 33 bytes is malformed",
        ),
        (Recalled(1, (5,)).encode()[:-1], "sequence numbers is cut short"),
        (FromChild(1, b"", [b"12"]).encode()[:-1], "a packet that ends after 66 bytes"),
        (bytes([PROTOCOL, 5]) + bytes(8) + b"\xff\xff\xff\xff" + bytes(8), "4294967295 buffers"),
        (ChildOutput(1, "x").encode() + b"\xff", "of kind output .* is malformed"),
        (Exited(1, 0, 0, "").encode()[:-1], "of kind exited .* is malformed"),
        (
            Recall(1).encode()[:1] + b"\x08" + bytes(8) + b'[0, "0", "", [], null, [], "", 0, ""]',
            "number",
        ),
        (
            Recall(1).encode()[:1] + b"\x08" + bytes(8) + b'[0, 0, 1, [], null, [], "", 0, ""]',
            "text",
        ),
        (Recall(1).encode()[:1] + b"\x08" + bytes(8) + b"7", "of kind exited .* is malformed"),
        (
            Recall(1).encode()[:1] + b"\x08" + bytes(8) + b"[" * 30_000,
            "of kind exited .* is malformed",
        ),
    ],
)
def test_an_error_names_the_fault(frame: bytes, complaint: str) -> None:
    with pytest.raises(ProtocolError, match=complaint):
        decode(frame)


def test_a_pickle_is_only_bytes() -> None:
    class Bomb:
        def __reduce__(self) -> tuple[object, ...]:
            return pytest.fail, ("it was unpickled",)

    packet = pickle.dumps(Bomb())
    received = decode(FromChild(1, packet, [packet]).encode())
    assert isinstance(received, FromChild)
    assert received.payload == packet


def test_a_packet_is_not_copied_and_writable_where_the_frame_is() -> None:
    frame = bytearray(Deliver(1, 2, b"payload", [b"buffer"]).encode())
    message = decode(frame)
    assert isinstance(message, Deliver)
    (buffer,) = message.buffers
    assert isinstance(buffer, memoryview)
    buffer[:3] = b"BUF"
    assert b"payload\0" in frame
    assert frame.endswith(b"BUFfer")


def test_buffers_of_any_item_size_are_taken_by_their_bytes() -> None:
    floats = memoryview(array("d", (1.5, 2.5)))
    message = decode(FromChild(1, b"", [floats]).encode())
    assert isinstance(message, FromChild)
    assert bytes(message.buffers[0]) == floats.tobytes()


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        (Start(3, SECRET.encode(), b"1"), "Start(child=3, spec=<14 bytes>, process=<1 bytes>)"),
        (
            KeepBlob(bytes(DIGEST_BYTES), SECRET.encode()),
            "KeepBlob(digest=<32 bytes>, data=<14 bytes>)",
        ),
        (
            Fetch(bytes(DIGEST_BYTES), 1, 2, "host:1", "word", SECRET, "hash", 3),
            "Fetch(digest=<32 bytes>, number=1, size=2, address=<6 characters>, "
            "uid=<4 characters>, key=<14 characters>, certificate=<4 characters>, port=3)",
        ),
        (
            Holding(bytes(DIGEST_BYTES), 1, "host:1", SECRET, "hash"),
            "Holding(digest=<32 bytes>, number=1, address=<6 characters>, key=<14 characters>, "
            "certificate=<4 characters>)",
        ),
        (
            Deliver(3, 4, SECRET.encode(), [SECRET.encode()]),
            "Deliver(child=3, seq=4, payload=<14 bytes>, buffers=<1 items>)",
        ),
        (
            DeliverShared(3, 4, [(0, bytes(DIGEST_BYTES))], SECRET.encode()),
            "DeliverShared(child=3, seq=4, shared=<1 items>, payload=<14 bytes>, buffers=())",
        ),
        (
            FromChild(3, memoryview(SECRET.encode())),
            "FromChild(child=3, payload=<14 bytes>, buffers=())",
        ),
        (ChildOutput(3, SECRET), "ChildOutput(child=3, text=<14 characters>)"),
        (
            Exited(3, 2, -9, SECRET, (1, 2), (1, 0), (SECRET,), SECRET, 0, SECRET),
            "Exited(child=3, delivered=2, exitcode=-9, reason=<14 characters>, "
            "unread=(1, 2), running=(1, 0), "
            "log=<1 items>, host=<14 characters>, cause=0, stack=<14 characters>)",
        ),
        (
            TunnelData(3, bytearray(SECRET.encode())),
            "TunnelData(tunnel=3, payload=<14 bytes>, buffers=())",
        ),
        (Signal(3, 15), "Signal(child=3, signum=15)"),
    ],
)
def test_a_repr_shows_no_data_of_the_user(message: LinkMessage, shown: str) -> None:
    assert repr(message) == shown
    assert str(message) == shown


def test_only_messages_about_the_same_child_or_blob_wait_for_a_large_one() -> None:
    start, blob = Start(1, b"", b""), KeepBlob(bytes(DIGEST_BYTES), b"")
    assert lane(start) == lane(Deliver(1, 2, b"")) == lane(Recall(1))
    assert lane(blob) == lane(Forget(blob.digest))
    lanes = [lane(start), lane(blob), lane(Start(2, b"", b"")), lane(TunnelData(1, b""))]
    assert len({*lanes, None}) == 5
    assert lane(Signal(1, 15)) is None, "it does not wait for what the child was sent"
