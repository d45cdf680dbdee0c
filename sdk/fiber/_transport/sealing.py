"""Sealed messages: AES-256-GCM under a counter, with one key for each direction.

The counter is not sent: both sides count.  A message that was changed, repeated or moved on the way
does not open, and neither does any message after it.  The same holds if a message was left out.  A
key serves for a bounded number of messages and bytes.  Then its successor is derived from it, and
the key is forgotten.
"""

from __future__ import annotations

import hmac
import threading
from typing import NamedTuple

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from fiber._wire.memory_files import BytesLike
from fiber._wire.messages import ProtocolError

SECRET_SIZE = 32
OVERHEAD = 16
"""Bytes by which a sealed message is longer."""

MESSAGES_PER_KEY = 1 << 20
BYTES_PER_KEY = 1 << 36
"""Well below what GCM bears: TLS 1.3 stops at about 2**38 bytes (RFC 8446, 5.5)."""

_NONCE = 12


class Secrets(NamedTuple):
    """Secrets from which one side derives the keys of a connection."""

    outgoing: bytes
    incoming: bytes

    def __repr__(self) -> str:
        return "Secrets(...)"


def derive(agent: bytes, master: bytes, *, for_master: bool) -> Secrets:
    """Derive the secrets of a connection from the random bytes of both sides (HKDF, RFC 5869)."""
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
    """Memory for the message that a thread has just opened.

    All connections share it.  So it stays in the processor's cache and needs no zeroing, and a
    thousand connections take no more memory than one.
    """

    def __init__(self) -> None:
        self.view = memoryview(bytearray())

    def of(self, size: int) -> memoryview:
        """Return ``size`` bytes of the memory."""
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
        """Return the next message; ProtocolError if ``sealed`` is not that message.

        The caller must use it before this thread opens another message, of any connection.
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
    """Sequence of keys, each with its counter.  Both sides change the key at the same message."""

    def __init__(self, secret: bytes, messages: int, size: int) -> None:
        self._messages = messages
        self._size = size
        self._begin(secret)

    def next(self, size: int) -> tuple[AESGCM, bytes]:
        """Return key and nonce for the next message, which has ``size`` bytes."""
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
