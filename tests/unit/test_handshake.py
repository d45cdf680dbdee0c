"""The first words on a connection."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber._transport.authentication import (
    AgentHello,
    Identity,
    MasterRefusal,
    MasterWelcome,
    decode_greeting,
    version_mismatch,
)
from fiber._wire.messages import ProtocolError
from fiber._wire.packet_layout import PROTOCOL

OURS = Identity("the master", PROTOCOL, "3.11.7", "1.0", {"host": "here"})


@pytest.mark.parametrize(
    "greeting",
    [
        AgentHello(OURS, "ab12", 7, True),
        MasterWelcome(OURS, 0, 0.5, 1.0, 2.0),
        MasterRefusal(OURS, "no such session"),
    ],
)
def test_encoded_messages_decode_to_equal_ones(
    greeting: AgentHello | MasterWelcome | MasterRefusal,
) -> None:
    assert decode_greeting(greeting.encode()) == greeting


def test_a_hello_of_another_protocol_still_names_its_sender() -> None:
    strange = {"identity": {**vars(OURS), "protocol": 99, "facts": {}}, "ticket": "whatever"}
    hello = decode_greeting(b"\x10" + json.dumps(strange).encode())
    assert hello.identity == replace(OURS, protocol=99, facts={})


@pytest.mark.parametrize(
    ("datagram", "complaint"),
    [
        (b"", "first 0 bytes are no greeting"),
        (b"GET / HTTP/1.1", "first 14 bytes are no greeting"),
        (b"\x10", "malformed"),
        (b"\x10[]", "malformed"),
        (b'\x10{"identity": {}}', "malformed"),
        (AgentHello(OURS, "ab12", 7, True).encode().replace(b"arrived", b"arrival"), "'arrived'"),
        (MasterWelcome(OURS, 0, 0.5, 1.0, 2.0).encode().replace(b"0.5", b'"x"'), "malformed"),
        (b"\x12\xff", "malformed"),
        (AgentHello(replace(OURS, name="\ud800"), "ab12", 7, True).encode(), "UnicodeEncodeError"),
        (AgentHello(replace(OURS, uid="\ud800"), "ab12", 7, True).encode(), "UnicodeEncodeError"),
        (
            AgentHello(replace(OURS, name="a" * 60_000), "ab12", 7, True).encode(),
            "60000 characters",
        ),
        (b"\x10" + b"[" * 30_000, "RecursionError"),
        (
            MasterWelcome(OURS, 31, 1.0, 2.0, 3.0).encode().replace(b"31", b"Infinity"),
            "OverflowError",
        ),
    ],
)
def test_an_invalid_greeting_is_named(datagram: bytes, complaint: str) -> None:
    with pytest.raises(ProtocolError, match=complaint):
        decode_greeting(datagram)


@given(st.sampled_from([0x10, 0x11, 0x12, 0x13]), st.binary(max_size=50))
def test_noise_raises_only_protocol_error(kind: int, noise: bytes) -> None:
    try:
        decode_greeting(bytes([kind]) + noise)
    except ProtocolError:
        pass


@pytest.mark.parametrize(
    ("theirs", "complaint"),
    [
        (replace(OURS, name="agent-1"), None),
        (replace(OURS, name="agent-1", python="3.11.0"), None),
        (replace(OURS, name="agent-1", fiber="1.1"), None),
        (
            replace(OURS, name="agent-1", python="3.12.1"),
            "Python version mismatch: agent-1 has 3.12.1, this process has 3.11.7",
        ),
        (
            replace(OURS, name="agent-1", protocol=99, fiber="9.0"),
            f"Fiber protocol version mismatch: agent-1 has 99 (fiberpool 9.0), this process has "
            f"{PROTOCOL} (fiberpool 1.0)",
        ),
    ],
)
def test_versions_must_fit(theirs: Identity, complaint: str | None) -> None:
    error = version_mismatch(OURS, theirs)
    assert (error is None) == (complaint is None)
    assert complaint is None or str(error).startswith(complaint)


def test_the_identity_of_this_process_has_its_versions() -> None:
    identity = Identity.of_this_process("agent-1", host="here")
    assert identity.protocol == PROTOCOL
    assert identity.facts == {"host": "here"}
    assert identity.fiber
