"""Key of a pool, and the key of each agent that is derived from it. Standard library only.

An agent proves by its own key that it is the pod of that name and uid. In a pool with one master,
the pool's key gives the keys of all its agents, and the master knows it. In a warm pool, where
masters follow one another, no master knows it: see ``fiber_api.signatures``.
"""

from __future__ import annotations

import base64
import binascii
import hmac
import re
import secrets
from collections.abc import Mapping

from fiber_api import names

_KEY = re.compile(r"[0-9a-f]{64}")


class InvalidKey(ValueError):
    """A Secret that cannot serve; the message says why and shows no key."""


def new_key() -> str:
    """Return a random key: 256 bits, in hexadecimal digits."""
    return secrets.token_hex(32)


def agent_key(pool_key: str, name: str, uid: str) -> str:
    """Derive the key of the agent in the pod ``name`` with ``uid``."""
    words = f"fiber agent {len(name)} {name} {uid}".encode()
    return hmac.new(bytes.fromhex(pool_key), words, "sha256").hexdigest()


def check_key(text: str) -> str:
    """Return ``text`` without white space around it; InvalidKey if it is no key."""
    key = text.strip()
    if not _KEY.fullmatch(key):
        raise InvalidKey(f"{names.KEY_POOL} does not hold 64 hexadecimal digits")
    return key


def key_in(data: Mapping[str, object]) -> str:
    """Return the pool's key from ``data`` of its Secret, whose values are in base64."""
    value = data.get(names.KEY_POOL)
    if not isinstance(value, str) or not value:
        raise InvalidKey(f"{names.KEY_POOL} is absent")
    try:
        text = base64.b64decode(value, validate=True).decode()
    except (binascii.Error, ValueError):
        raise InvalidKey(f"{names.KEY_POOL} is no text in base64") from None
    return check_key(text)
