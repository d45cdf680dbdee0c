"""Signatures (Ed25519, RFC 8032) that tie the agents and the masters of a warm pool.

Masters of such a pool follow one another, so no two of them may share a secret (decision 44). The
pool has a key pair, which its key and its uid give. Only the operator and each pod's init
container can sign with it: the operator signs the certificate of each master, the init container
the public key of its agent. Agents and masters know the public key alone.
"""

from __future__ import annotations

import hmac

SIGNATURE_SIZE = 64
PUBLIC_KEY_SIZE = 32


class Signer:
    """Owner of a key pair. ``secret`` is 32 bytes in hexadecimal digits."""

    def __init__(self, secret: str) -> None:
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

        self._key = Ed25519PrivateKey.from_private_bytes(bytes.fromhex(secret))
        self.public_key = self._key.public_key().public_bytes_raw()

    def sign(self, statement: bytes) -> bytes:
        """Sign ``statement``."""
        return self._key.sign(statement)


def pool_signer(pool_key: str, pool_uid: str) -> Signer:
    """Return the signer of the FiberPool with this key and uid.

    A Secret may outlive its pool, and the next pool with the Secret begins with the first epoch. So
    each pool has its own key pair.
    """
    words = b"fiber signer " + pool_uid.encode()
    return Signer(hmac.new(bytes.fromhex(pool_key), words, "sha256").hexdigest())


def is_signed(public_key: bytes, statement: bytes, signature: bytes) -> bool:
    """Return True if the owner of ``public_key`` has signed ``statement``."""
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    try:
        Ed25519PublicKey.from_public_bytes(public_key).verify(signature, statement)
    except (InvalidSignature, ValueError):
        return False
    return True


def agent_statement(name: str, uid: str, public_key: bytes) -> bytes:
    """Return the statement that the agent in the pod ``name`` with ``uid`` has ``public_key``."""
    return b"fiber agent " + public_key + f" {len(name)} {name} {uid}".encode()


def master_statement(epoch: int, certificate: bytes) -> bytes:
    """Return the statement that the master of ``epoch`` has the certificate with this SHA-256."""
    return b"fiber master " + certificate + f" {epoch}".encode()
