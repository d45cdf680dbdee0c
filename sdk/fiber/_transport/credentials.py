"""Credentials by which a master and an agent prove themselves to each other.

A master has the key of the pool, and a certificate that it signed itself for this run of the
program.  An agent has its own key.  The master derives that key again from the agent's name and
uid, so it stores nothing about agents, and an agent cannot prove to be another one.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import os
from dataclasses import asdict, dataclass, field
from functools import cached_property

from fiber._transport import credentials_file
from fiber.errors import ConfigError
from fiber_api import identity

_VALIDITY = datetime.timedelta(days=3650)
"""Validity of a certificate.  No side reads it: agents compare the certificate's fingerprint."""


@dataclass(frozen=True)
class Credentials:
    """Credentials of an agent."""

    name: str
    uid: str
    key: str = field(repr=False)
    """Key of the agent, derived from the key of the pool."""
    master: str = ""
    """Fingerprint of the only master that this agent may have; empty in a warm pool, where masters
    follow one another."""
    epoch: int = 0
    """Lowest epoch of a master that this agent serves: that of the latest one when its pod was
    made, or of the latest one that it has served."""

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Credentials:
        """Read the file that the init container of a pod wrote, and remove it."""
        try:
            return cls._read(credentials_file.take(os.fspath(path)))
        except OSError as error:
            raise cls._unreadable(path, str(error.strerror or error).lower()) from None
        except (ValueError, KeyError, TypeError, AttributeError):
            raise cls._unreadable(path, "its content is incomplete or not Fiber's") from None

    @staticmethod
    def _unreadable(path: str | os.PathLike[str], why: str) -> ConfigError:
        return ConfigError(
            f"no credentials can be read from {os.fspath(path)} and removed: {why}. The init "
            "container of this pod writes them, and the agent removes them when it begins. Let the "
            "agent be the only process of the pod that reads them, as the init container's user, "
            "from a volume that can be written to."
        )

    def to_descriptor(self) -> int:
        """Return a descriptor from which another process can read the credentials, once."""
        values = json.dumps(asdict(self)).encode()
        reader, writer = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        try:
            if os.write(writer, values) < len(values):
                raise ConfigError(f"credentials of {len(values)} bytes are too long for a pipe")
        except BaseException:
            os.close(reader)
            raise
        finally:
            os.close(writer)
        return reader

    @classmethod
    def from_descriptor(cls, descriptor: int) -> Credentials:
        """Read what ``to_descriptor`` wrote, and close the descriptor.  Errors repeat no secret."""
        try:
            with open(descriptor, "rb") as file:
                return cls._read(file.read())
        except (OSError, OverflowError, ValueError, KeyError, TypeError, AttributeError):
            # A descriptor may have any content.
            raise ConfigError(
                f"the credentials on descriptor {descriptor} cannot be read: it is not open, or "
                "its content is incomplete or not Fiber's. Pass them on as the master made them."
            ) from None

    @classmethod
    def _read(cls, data: bytes) -> Credentials:
        values = json.loads(data)
        return cls(
            str(values["name"]),
            str(values["uid"]),
            identity.check_key(values["key"]),
            str(values.get("master", "")),
            int(values.get("epoch", 0)),
        )


@dataclass(frozen=True)
class Certificate:
    """Certificate that a master signed itself, and the private key to it, in PEM."""

    text: str = field(repr=False)
    key: str = field(repr=False)

    @cached_property
    def hash(self) -> bytes:
        """SHA-256 of the certificate."""
        import ssl

        return hashlib.sha256(ssl.PEM_cert_to_DER_cert(self.text)).digest()


@dataclass(frozen=True)
class MasterCredentials:
    """Key of a pool, and the certificate of its master."""

    pool_key: str = field(repr=False)
    certificate: Certificate = field(repr=False)
    only: bool = True
    """True if the pool never has another master.  Then its agents know the fingerprint."""

    @property
    def fingerprint(self) -> str:
        """Hash that agents compare the certificate with; empty if another master may follow."""
        return self.certificate.hash.hex() if self.only else ""

    def agent_key(self, name: str, uid: str) -> str:
        """Derive the key of an agent."""
        return identity.agent_key(self.pool_key, name, uid)

    def agent(self, name: str, uid: str) -> Credentials:
        """Return the credentials of an agent, which prove no other agent."""
        return Credentials(name, uid, self.agent_key(name, uid), self.fingerprint)


def make_credentials(
    pool_key: str | None = None, certificate: Certificate | None = None
) -> MasterCredentials:
    """Return the credentials of a pool's master.

    A pool without a key gets a new one. A master without a certificate gets a new one too.
    """
    return MasterCredentials(
        pool_key or identity.new_key(), certificate or make_certificate(), only=pool_key is None
    )


def make_certificate() -> Certificate:
    """Make a certificate and its private key, in a millisecond."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Fiber")])
    now = datetime.datetime.now(datetime.UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + _VALIDITY)
        .sign(key, hashes.SHA256())
    )
    pem = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    return Certificate(certificate.public_bytes(serialization.Encoding.PEM).decode(), pem.decode())
