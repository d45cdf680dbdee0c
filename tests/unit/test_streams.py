"""Frames between relay and master: round trips in pieces of any size, garbage, and bounds."""

from __future__ import annotations

import json
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber._wire.messages import ProtocolError
from fiber._wire.streams import (
    MOST_DATA,
    VERSION,
    FrameDecoder,
    Kind,
    StreamFrame,
    credit,
    hello,
)

NUMBERS = st.integers(0, 2**32 - 1)
PAYLOADS = st.one_of(st.binary(max_size=100), st.integers(0, MOST_DATA).map(bytes))
FRAMES = st.builds(StreamFrame, st.sampled_from(Kind), NUMBERS, PAYLOADS)


@given(st.lists(FRAMES, max_size=8), st.data())
def test_frames_arrive_whole_in_pieces_of_any_size(
    frames: list[StreamFrame], data: st.DataObject
) -> None:
    whole = b"".join(frame.encode() for frame in frames)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(whole)), max_size=20)))
    decoder = FrameDecoder()
    found: list[StreamFrame] = []
    for start, end in zip([0, *cuts], [*cuts, len(whole)], strict=True):
        found += decoder.feed(whole[start:end])
    assert found == frames
    assert decoder._rest == b""


def test_frames_arrive_whole_byte_by_byte() -> None:
    frames = [hello(epoch=3), StreamFrame(Kind.DATA, 7, b"x" * 300), StreamFrame(Kind.END, 7)]
    decoder = FrameDecoder()
    found: list[StreamFrame] = []
    for byte in b"".join(frame.encode() for frame in frames):
        found += decoder.feed(bytes([byte]))
    assert found == frames


@given(st.binary(max_size=400))
def test_garbage_is_decoded_or_refused_and_never_kept_beyond_a_frame(garbage: bytes) -> None:
    decoder = FrameDecoder()
    try:
        for frame in decoder.feed(garbage):
            assert isinstance(frame.kind, Kind)
    except ProtocolError:
        pass
    assert len(decoder._rest) <= len(garbage)


@pytest.mark.parametrize("kind", [0, 9, 255])
def test_an_unknown_kind_is_refused(kind: int) -> None:
    with pytest.raises(ProtocolError, match=f"unknown kind {kind}"):
        list(FrameDecoder().feed(struct.pack(">BII", kind, 0, 0)))


def test_a_frame_that_is_too_long_is_refused_by_its_head() -> None:
    decoder = FrameDecoder()
    assert list(decoder.feed(struct.pack(">BII", Kind.DATA, 1, MOST_DATA))) == []
    with pytest.raises(ProtocolError, match=f"a frame has {MOST_DATA + 1} bytes"):
        list(FrameDecoder().feed(struct.pack(">BII", Kind.DATA, 1, MOST_DATA + 1)))


def test_frames_before_a_wrong_one_are_decoded() -> None:
    good = StreamFrame(Kind.DATA, 1, b"good")
    frames = FrameDecoder().feed(good.encode() + b"\xff" * 9)
    assert next(frames) == good
    with pytest.raises(ProtocolError):
        next(frames)


def test_a_reader_that_stops_halfway_reads_on_at_the_next_frame() -> None:
    first, second = StreamFrame(Kind.DATA, 1, b"one"), StreamFrame(Kind.DATA, 1, b"two")
    decoder = FrameDecoder()
    frames = decoder.feed(first.encode() + second.encode())
    assert next(frames) == first
    frames.close()  # type: ignore[attr-defined]  # it is a generator
    assert list(decoder.feed(b"")) == [second]


@given(st.integers(0, 1 << 30))
def test_a_credit_is_what_was_granted(count: int) -> None:
    frame = credit(3, count)
    assert (frame.kind, frame.stream, frame.credit) == (Kind.CREDIT, 3, count)


@pytest.mark.parametrize("payload", [b"", b"123", b"12345", struct.pack(">I", (1 << 30) + 1)])
def test_a_wrong_credit_is_refused(payload: bytes) -> None:
    with pytest.raises(ProtocolError, match="a CREDIT frame"):
        _ = StreamFrame(Kind.CREDIT, 1, payload).credit


def test_a_hello_has_the_version_and_its_content() -> None:
    assert hello(epoch=4, identity="laptop").hello == {
        "version": VERSION,
        "epoch": 4,
        "identity": "laptop",
    }


@pytest.mark.parametrize("payload", [b"", b"{", b"\xff\xfe", b"[" * 60_000, b'{"a":' * 10_000])
def test_a_hello_that_is_no_json_is_refused(payload: bytes) -> None:
    with pytest.raises(ProtocolError, match="no JSON"):
        _ = StreamFrame(Kind.HELLO, 0, payload).hello


@pytest.mark.parametrize("content", [[], 1, {}, {"version": VERSION + 1}, {"version": None}])
def test_a_hello_of_another_version_says_what_to_do(content: object) -> None:
    with pytest.raises(ProtocolError, match="the same version of Fiber"):
        _ = StreamFrame(Kind.HELLO, 0, json.dumps(content).encode()).hello


@pytest.mark.parametrize("origin", ["10.0.0.1:4711", "[fe80::1%eth0]:80", ""])
def test_the_origin_is_an_address(origin: str) -> None:
    assert StreamFrame(Kind.OPEN, 1, origin.encode()).origin == origin


@pytest.mark.parametrize("payload", [b"\xff", b"1.2.3.4:5\n", b"\x1b[2J", b"1" * 101])
def test_an_origin_that_could_not_be_printed_is_refused(payload: bytes) -> None:
    with pytest.raises(ProtocolError, match="no address"):
        _ = StreamFrame(Kind.OPEN, 1, payload).origin
