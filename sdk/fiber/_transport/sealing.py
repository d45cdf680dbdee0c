"""Sealed messages: AES-256-GCM under a counter, with a key of its own for each direction.

The counter is not sent: both sides count.  So whatever is changed, left out, repeated or put
elsewhere on the way does not open, and neither does anything after it.  A key is used for a bounded
number of messages and bytes; its successor is derived from it, and it is forgotten.
"""

from __future__ import annotations

import hmac
import threading
from typing import NamedTuple

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from fiber._wire.messages import BytesLike, ProtocolError

SECRET_SIZE = 32
OVERHEAD = 16
"""Bytes by which a sealed message is longer."""

MESSAGES_PER_KEY = 1 << 20
BYTES_PER_KEY = 1 << 36
"""Well below what GCM bears: TLS 1.3 stops at about 2**38 bytes (RFC 8446, 5.5)."""

_NONCE = 12


class Secrets(NamedTuple):
    """What the keys of one connection come from, as one side uses them."""

    outgoing: bytes
    incoming: bytes

    def __repr__(self) -> str:
        return "Secrets(...)"


def derive(agent: bytes, master: bytes, *, for_master: bool) -> Secrets:
    """The secrets of a connection from what each side contributed (HKDF, RFC 5869)."""
    both = hmac.digest(b"fiber link", agent + master, "sha256")
    up, down = _expand(both, b"agent to master"), _expand(both, b"master to agent")
    return Secrets(down, up) if for_master else Secrets(up, down)


class Sealer:
    """The sending side."""

    def __init__(
        self, secret: bytes, messages: int = MESSAGES_PER_KEY, size: int = BYTES_PER_KEY
    ) -> None:
        self._keys = _Keys(secret, messages, size)

    def seal_into(self, data: BytesLike, sealed: BytesLike) -> None:
        """Write ``data`` sealed to ``sealed``, which is OVERHEAD bytes longer."""
        cipher, nonce = self._keys.next(len(data))
        cipher.encrypt_into(nonce, data, None, sealed)


class _Block(threading.local):
    """Memory for the message that a thread has just opened, of whatever connection.

    One for all of them stays in the processor's cache and needs no zeroing, and a thousand
    connections take no more of it than one.
    """

    def __init__(self) -> None:
        self.view = memoryview(bytearray())

    def of(self, size: int) -> memoryview:
        """So many bytes of it."""
        if size > len(self.view):
            self.view = memoryview(bytearray(size))
        return self.view[:size]


_block = _Block()


class Opener:
    """The receiving side."""

    def __init__(
        self, secret: bytes, messages: int = MESSAGES_PER_KEY, size: int = BYTES_PER_KEY
    ) -> None:
        self._keys = _Keys(secret, messages, size)

    def open(self, sealed: BytesLike) -> memoryview:
        """The next message, to be used before this thread opens another one, of any connection;
        ProtocolError if it is anything else.
        """
        size = len(sealed) - OVERHEAD
        if size < 0:
            raise ProtocolError(f"a sealed message cannot have {len(sealed)} bytes")
        cipher, nonce = self._keys.next(size)
        data = _block.of(size)
        try:
            cipher.decrypt_into(nonce, sealed, None, data)
        except InvalidTag:
            raise ProtocolError(
                f"a sealed message of {len(sealed)} bytes does not open: it was changed on the "
                "way, or is not the one that comes next"
            ) from None
        return data


class _Keys:
    """One key after the other, each with its counter.  Both sides step at the same message."""

    def __init__(self, secret: bytes, messages: int, size: int) -> None:
        self._messages = messages
        self._size = size
        self._begin(secret)

    def next(self, size: int) -> tuple[AESGCM, bytes]:
        """Key and nonce for the next message, of so many bytes."""
        if self._count == self._messages or self._used + size > self._size:
            self._begin(self._successor)
        nonce = self._count.to_bytes(_NONCE, "big")
        self._count += 1
        self._used += size
        return self._cipher, nonce

    def _begin(self, secret: bytes) -> None:
        self._cipher = AESGCM(_expand(secret, b"key"))
        self._successor = _expand(secret, b"next")
        self._count = 0
        self._used = 0


def _expand(secret: bytes, label: bytes) -> bytes:
    return hmac.digest(secret, b"fiber " + label + b"\x01", "sha256")
