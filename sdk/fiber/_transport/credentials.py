"""Credentials by which a master and an agent prove themselves to each other.

A master has a certificate that it made for this run of the program.  There are two kinds of pools:

* A pool with one master (``OwnCredentials``): the master has the key of the pool, and each agent a
  key that is derived from it and the agent's name and uid.  The proofs are HMACs with that key.
  The agent knows the fingerprint of the master's certificate.
* A warm pool (``WarmCredentials``), where masters follow one another: an agent has a key pair, and
  the pool has signed its public key for its name and uid.  The operator signs the fingerprint of
  each master's certificate and the master's epoch.  No secret of one master is of use to the next
  one.
"""

from __future__ import annotations

import datetime
import hashlib
import hmac
import json
import os
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import NamedTuple, Protocol

from fiber._transport import credentials_file
from fiber.errors import ConfigError
from fiber_api import identity, signatures

_VALIDITY = datetime.timedelta(days=3650)
"""Validity of a certificate.  No side reads it: agents compare the certificate's fingerprint."""


class ProvenMaster(NamedTuple):
    """Master that has proved itself to an agent."""

    epoch: int
    certificate: str
    """Fingerprint of its certificate."""


@dataclass(frozen=True)
class Credentials:
    """Credentials of an agent."""

    name: str
    uid: str
    key: str = field(repr=False)
    """Secret of the agent: derived from the key of the pool, or the secret of its key pair."""
    master: str = ""
    """Fingerprint of the only master that this agent may have; empty in a warm pool."""
    pool: str = ""
    """Public key of the warm pool, in hexadecimal digits; empty in a pool with one master."""
    signature: str = ""
    """Signature of the warm pool for the name, the uid and the public key of this agent."""
    epoch: int = 0
    """Lowest epoch of a master that this agent serves: that of the latest one when its pod was
    made, or of the latest one that has proved itself."""
    met: str = ""
    """Fingerprint of the master of that epoch, if it has proved itself to this agent."""

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
        made = cls(
            str(values["name"]),
            str(values["uid"]),
            identity.check_key(values["key"]),
            str(values.get("master", "")),
            str(values.get("pool", "")),
            str(values.get("signature", "")),
            int(values.get("epoch", 0)),
            str(values.get("met", "")),
        )
        sizes = (len(bytes.fromhex(made.pool)), len(bytes.fromhex(made.signature)))
        signed = (signatures.PUBLIC_KEY_SIZE, signatures.SIGNATURE_SIZE)
        if sizes != ((0, 0) if made.master else signed):
            raise ValueError("neither the only master nor a signature of the pool")
        return made

    def prove(self, said: bytes) -> bytes:
        """Return the proof that this agent has said ``said``."""
        if not self.pool:
            return _hmac(self.key, said)
        signer = signatures.Signer(self.key)
        return signer.public_key + bytes.fromhex(self.signature) + signer.sign(said)

    def check_master(self, said: bytes, certificate: bytes, proof: bytes) -> ProvenMaster | None:
        """Return the master that has said ``said``; None if its proof is not valid.

        ``certificate`` is the SHA-256 of the one that the master has shown.  TLS proves that the
        master is its owner.
        """
        if self.pool:
            epoch, signature = int.from_bytes(proof[:_EPOCH_SIZE], "big"), proof[_EPOCH_SIZE:]
            statement = signatures.master_statement(epoch, certificate)
            is_valid = signatures.is_signed(bytes.fromhex(self.pool), statement, signature)
        else:
            epoch, is_valid = self.epoch, hmac.compare_digest(proof, _hmac(self.key, said))
        return ProvenMaster(epoch, certificate.hex()) if is_valid else None


_EPOCH_SIZE = 8
_KEY_END = signatures.PUBLIC_KEY_SIZE
_POOL_SIGNATURE_END = _KEY_END + signatures.SIGNATURE_SIZE
_AGENT_PROOF_SIZE = _POOL_SIGNATURE_END + signatures.SIGNATURE_SIZE


def _hmac(key: str, said: bytes) -> bytes:
    return hmac.digest(bytes.fromhex(key), said, "sha256")


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


class MasterCredentials(Protocol):
    """Credentials of a master for the agents of one pool."""

    @property
    def certificate(self) -> Certificate:
        """Certificate that the master shows all agents."""

    @property
    def complete(self) -> bool:
        """True if the master can prove itself."""

    def believes(self, name: str, uid: str, said: bytes, proof: bytes) -> bool:
        """Return True if the agent ``name`` with ``uid`` has said ``said``."""

    def prove(self, name: str, uid: str, said: bytes) -> bytes:
        """Return the proof to that agent that this master has said ``said``."""


@dataclass(frozen=True)
class OwnCredentials:
    """Credentials of the only master that a pool ever has."""

    pool_key: str = field(repr=False)
    certificate: Certificate = field(repr=False)
    complete = True

    @property
    def fingerprint(self) -> str:
        """Hash that agents compare the certificate with."""
        return self.certificate.hash.hex()

    def agent(self, name: str, uid: str) -> Credentials:
        """Return the credentials of an agent, which prove no other agent."""
        key = identity.agent_key(self.pool_key, name, uid)
        return Credentials(name, uid, key, self.fingerprint)

    def believes(self, name: str, uid: str, said: bytes, proof: bytes) -> bool:
        """Return True if the agent ``name`` with ``uid`` has said ``said``."""
        return hmac.compare_digest(proof, self.prove(name, uid, said))

    def prove(self, name: str, uid: str, said: bytes) -> bytes:
        """Return the proof to that agent that this master has said ``said``."""
        return _hmac(identity.agent_key(self.pool_key, name, uid), said)


class WarmCredentials:
    """Credentials of one of the masters of a warm pool.

    ``public_key`` is the pool's.  The credentials are complete once the operator has signed.
    """

    def __init__(self, public_key: bytes, certificate: Certificate) -> None:
        self.certificate = certificate
        self._public_key = public_key
        self._proof = b""

    @property
    def complete(self) -> bool:
        """True once the operator has signed the certificate."""
        return bool(self._proof)

    def take_signature(self, epoch: int, signature: bytes) -> bool:
        """Take the operator's signature for this master; return False if it is not valid."""
        statement = signatures.master_statement(epoch, self.certificate.hash)
        if not signatures.is_signed(self._public_key, statement, signature):
            return False
        self._proof = epoch.to_bytes(_EPOCH_SIZE, "big") + signature
        return True

    def believes(self, name: str, uid: str, said: bytes, proof: bytes) -> bool:
        """Return True if the agent ``name`` with ``uid`` has said ``said``."""
        if len(proof) != _AGENT_PROOF_SIZE:
            return False
        key, pool_signature = proof[:_KEY_END], proof[_KEY_END:_POOL_SIGNATURE_END]
        statement = signatures.agent_statement(name, uid, key)
        return signatures.is_signed(
            self._public_key, statement, pool_signature
        ) and signatures.is_signed(key, said, proof[_POOL_SIGNATURE_END:])

    def prove(self, name: str, uid: str, said: bytes) -> bytes:
        """Return the operator's signature, which serves for all agents."""
        return self._proof


def make_credentials(certificate: Certificate | None = None) -> OwnCredentials:
    """Return the credentials of a new pool's master; without ``certificate`` it gets a new one."""
    return OwnCredentials(identity.new_key(), certificate or make_certificate())


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
