"""Bundles: small messages that travel as one part of a packet, in their order.

Layout (little endian), for each message: length:u32, content.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

_LENGTH = struct.Struct("<I")

LIMIT = 1 << 15
"""Bytes of a bundle, at most, unless its first message is longer."""


def pack(messages: Iterable[bytes]) -> bytes:
    """Return a bundle of ``messages``."""
    parts: list[bytes] = []
    for message in messages:
        parts += (_LENGTH.pack(len(message)), message)
    return b"".join(parts)


def unpack(bundle: memoryview) -> list[bytes]:
    """Return the messages of a bundle; ValueError or struct.error if it is no bundle."""
    data = bytes(bundle)
    messages, start = [], 0
    while start < len(data):
        (size,) = _LENGTH.unpack_from(data, start)
        start += _LENGTH.size
        messages.append(data[start : start + size])
        start += size
    if start != len(data) or not messages:
        raise ValueError("a bundle of messages is cut short")
    return messages
