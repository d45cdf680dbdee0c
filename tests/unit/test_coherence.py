"""Twins and patches: what is sent, and what is done with it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber._hub.replicas import PATCH, Twin

SIZE = 10_000


class Pair:
    """The two sides of a link."""

    def __init__(self, size: int = SIZE) -> None:
        self.home, self.other = bytearray(size), bytearray(size)
        self.up = Twin(memoryview(self.home), follows=False)
        self.down = Twin(memoryview(self.other), follows=True)

    def send_down(self) -> int:
        patches = list(self.up.collect())
        for patch in patches:
            self.down.merge(memoryview(patch))
        return sum(map(len, patches))

    def send_up(self) -> None:
        for patch in list(self.down.collect()):
            self.up.merge(memoryview(patch))
            self.down.acknowledged()


writes = st.lists(
    st.tuples(st.integers(0, SIZE - 50), st.binary(min_size=1, max_size=50)), max_size=8
)


@given(writes, writes)
def test_writes_on_either_side_arrive(ours: object, theirs: object) -> None:
    pair = Pair()
    for memory, written, send in (
        (pair.home, ours, pair.send_down),
        (pair.other, theirs, pair.send_up),
    ):
        for start, data in written:  # type: ignore[attr-defined]
            memory[start : start + len(data)] = data
        send()
    assert pair.home == pair.other
    assert not list(pair.up.collect())
    assert not list(pair.down.collect())


def test_writers_of_neighbouring_bytes_do_not_meet() -> None:
    pair = Pair()
    pair.home[::2] = b"\1" * (SIZE // 2)
    pair.other[1::2] = b"\2" * (SIZE // 2)
    patches = list(pair.down.collect())
    pair.send_down()
    for patch in patches:
        pair.up.merge(memoryview(patch))
    assert pair.home == pair.other == b"\1\2" * (SIZE // 2)


def test_the_home_decides_about_a_byte_that_both_sides_wrote() -> None:
    pair = Pair()
    pair.home[0], pair.other[0] = 1, 2
    (down,), (up,) = list(pair.up.collect()), list(pair.down.collect())
    pair.up.merge(memoryview(up))
    pair.down.merge(memoryview(down))
    assert pair.home[0] == pair.other[0] == 2
    pair.down.acknowledged()
    pair.home[0] = 3
    pair.send_down()
    assert pair.other[0] == 3


def test_unsent_local_writes_are_kept() -> None:
    pair = Pair()
    pair.home[0:4] = b"aaaa"
    pair.other[1:3] = b"bb"
    pair.send_down()
    assert pair.other[0:4] == b"abba"
    pair.send_up()
    assert pair.home[0:4] == b"abba"


def test_little_is_sent_for_little_and_large_patches_go_in_pieces() -> None:
    pair = Pair(4 * PATCH)
    pair.home[PATCH] = 1
    assert pair.send_down() < 20
    pair.home[:] = b"\7" * len(pair.home)
    assert len(list(pair.up.collect())) > 3


@pytest.mark.parametrize(
    "patch",
    [
        b"\0",
        b"\0" * 8 + b"\1\0\0\0",  # no bytes
        b"\0" * 8 + b"\0\0\0\0",  # none changed
        b"\x10\x27" + b"\0" * 6 + b"\1\0\0\0" + b"\x01x",  # beyond the end
        b"\0" * 8 + b"\1\0\0\0" + b"\xffx",  # more bits than bytes
        b"\0" * 8 + b"\xff\xff\0\0" + bytes(80_000),  # longer than any
    ],
)
def test_an_invalid_patch_changes_no_byte(patch: bytes) -> None:
    pair = Pair()
    with pytest.raises((ValueError, Exception), match=r"malformed|buffer"):
        pair.down.merge(memoryview(patch))
    assert not any(pair.other)
