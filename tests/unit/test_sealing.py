"""Sealed messages: what was changed, repeated or left out does not open."""

from __future__ import annotations

import os
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber._transport import nng
from fiber._transport.authentication import derive
from fiber._transport.nng import OVERHEAD, Opener, Sealer
from fiber._wire.messages import ProtocolError

SECRET = bytes(range(32))


def sealed(sealer: Sealer, data: bytes) -> bytes:
    target = bytearray(len(data) + OVERHEAD)
    sealer.seal_into(data, target)
    return bytes(target)


@pytest.mark.parametrize("size", [0, 1, 1000])
def test_a_sealed_message_shows_its_size_alone(size: int) -> None:
    sealer = Sealer(SECRET)
    first, second = sealed(sealer, bytes(size)), sealed(sealer, bytes(size))
    assert len(first) == len(second) == size + OVERHEAD
    assert first != second


@given(st.lists(st.binary(max_size=300), max_size=30), st.integers(1, 5), st.integers(300, 1000))
def test_messages_open_in_order_whenever_the_key_changes(
    messages: list[bytes], per_key: int, bytes_per_key: int
) -> None:
    sealer = Sealer(SECRET, per_key, bytes_per_key)
    opener = Opener(SECRET, per_key, bytes_per_key)
    for message in messages:
        assert opener.open(sealed(sealer, message)) == message


def test_a_key_is_used_for_so_many_messages_and_its_successor_is_another() -> None:
    few, many = Sealer(SECRET, 3), Sealer(SECRET)
    same = [sealed(few, b"x") == sealed(many, b"x") for _ in range(6)]
    assert same == [True, True, True, False, False, False]


def test_a_key_is_used_for_so_many_bytes() -> None:
    few, many = Sealer(SECRET, size=10), Sealer(SECRET)
    same = [sealed(few, b"four") == sealed(many, b"four") for _ in range(4)]
    assert same == [True, True, False, False]


def test_no_nonce_comes_twice_under_a_key(monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[tuple[bytes, bytes]] = []

    class Recorder:
        def __init__(self, key: bytes) -> None:
            self._key = key

        def encrypt_into(self, nonce: bytes, *_: object) -> None:
            used.append((self._key, nonce))

    monkeypatch.setattr(nng, "AESGCM", Recorder)
    secrets = derive(os.urandom(32), os.urandom(32), for_master=True)
    for secret in secrets:
        sealer = Sealer(secret, 7)
        for _ in range(50):
            sealer.seal_into(b"x", bytearray())
    assert len(set(used)) == 100
    assert len({key for key, _ in used}) == 16


def test_the_limits_of_a_key_are_below_those_of_gcm() -> None:
    assert nng.MESSAGES_PER_KEY < 2**32
    assert nng.BYTES_PER_KEY <= 2**36


@pytest.mark.parametrize("at", [0, 5, 20])
def test_a_changed_message_does_not_open(at: int) -> None:
    message = bytearray(sealed(Sealer(SECRET), b"hello"))
    message[at] ^= 1
    with pytest.raises(ProtocolError, match="does not open"):
        Opener(SECRET).open(message)


@pytest.mark.parametrize("size", [0, 15])
def test_a_message_that_is_too_short_to_be_sealed_is_refused(size: int) -> None:
    with pytest.raises(ProtocolError, match=f"cannot have {size} bytes"):
        Opener(SECRET).open(bytes(size))


def test_a_repeated_or_early_message_does_not_open() -> None:
    sealer = Sealer(SECRET)
    first, _, third = (sealed(sealer, b"same") for _ in range(3))
    opener = Opener(SECRET)
    opener.open(first)
    with pytest.raises(ProtocolError):
        opener.open(first)
    opener = Opener(SECRET)
    opener.open(first)
    with pytest.raises(ProtocolError):
        opener.open(third)


def test_both_sides_derive_the_same_keys_and_each_direction_has_another() -> None:
    agent, master = os.urandom(32), os.urandom(32)
    up, down = derive(agent, master, for_master=False)
    assert (down, up) == derive(agent, master, for_master=True)
    assert len({up, down, agent, master}) == 4
    assert derive(os.urandom(32), master, for_master=True) != (down, up)
    assert derive(agent, os.urandom(32), for_master=True) != (down, up)


def test_secrets_stay_out_of_logs() -> None:
    assert repr(derive(SECRET, SECRET, for_master=True)) == "Secrets(...)"


def opened(size: int) -> memoryview:
    """Return the opened message of a separate connection."""
    return Opener(SECRET).open(sealed(Sealer(SECRET), bytes(size)))


def test_a_thousand_connections_take_the_memory_of_one() -> None:
    largest = opened(1000)
    assert {id(opened(size).obj) for size in range(1000)} == {id(largest.obj)}


def test_threads_open_messages_into_buffers_of_their_own() -> None:
    mine, others = opened(1000), []
    thread = threading.Thread(target=lambda: others.append(opened(1000)))
    thread.start()
    thread.join()
    assert others[0].obj is not mine.obj
