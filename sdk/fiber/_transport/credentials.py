"""Who may talk to whom: a certificate authority per run, one certificate for each side.

nng checks the server's name in the certificate, not its address, so one certificate serves a
master behind any address.  The authority's key is forgotten once both certificates are signed:
nobody can make a third one.
"""

from __future__ import annotations

import base64
import datetime
import json
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from fiber.errors import AuthenticationError, ConfigError

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

VALID_FOR = datetime.timedelta(days=365)
"""A run that lasts longer cannot take new agents."""

CLOCK_SKEW = datetime.timedelta(days=1)
"""How far an agent's clock may be behind."""

_POOL = re.compile(r"[a-z0-9]([a-z0-9.-]{0,100}[a-z0-9])?")

_FILES = {
    "server_name": "server-name",
    "authority": "ca.crt",
    "certificate": "tls.crt",
    "key": "tls.key",
}
"""The three of them that Kubernetes knows have the names that they have there."""


@dataclass(frozen=True)
class Credentials:
    """What one side needs: the authority that it trusts, its own certificate and key, all PEM."""

    server_name: str
    """The name that the master's certificate bears."""
    authority: str = field(repr=False)
    certificate: str = field(repr=False)
    key: str = field(repr=False)

    def to_directory(self, directory: str | os.PathLike[str]) -> None:
        """Write them to a new directory (mode 0700) as files that only this user can read."""
        folder = Path(directory)
        folder.mkdir(mode=0o700)
        for name, file in _FILES.items():
            _write_private(folder / file, getattr(self, name))

    @classmethod
    def from_directory(cls, directory: str | os.PathLike[str]) -> Credentials:
        """Read what ``to_directory`` wrote, or a mounted Secret of the same files."""
        values = {}
        for name, file in _FILES.items():
            path = Path(directory) / file
            try:
                values[name] = path.read_text().strip()
            except (OSError, UnicodeDecodeError) as error:
                raise ConfigError(
                    f"no credentials can be read from {path}: {error}. The directory must hold "
                    f"{', '.join(_FILES.values())}."
                ) from error
        return cls(**values)

    def to_environment(self) -> str:
        """One value for an environment variable."""
        values = {name: getattr(self, name) for name in _FILES}
        return base64.b64encode(json.dumps(values).encode()).decode()

    @classmethod
    def from_environment(cls, value: str) -> Credentials:
        """Read what ``to_environment`` made.  The error does not repeat the value."""
        try:
            values = json.loads(base64.b64decode(value, validate=True))
            return cls(**{name: str(values[name]) for name in _FILES})
        except (ValueError, KeyError, TypeError):
            # Whatever else may stand in an environment variable.
            raise ConfigError(
                f"the credentials in the environment ({len(value)} characters) cannot be read: "
                "they are cut short or not Fiber's. Hand them over as the master made them."
            ) from None

    def expires(self) -> datetime.datetime:
        """When the certificate ends to be valid."""
        from cryptography import x509

        try:
            certificate = x509.load_pem_x509_certificate(self.certificate.encode())
        except ValueError as error:
            raise AuthenticationError(
                f"the certificate for {self.server_name} is not a PEM certificate: {error}"
            ) from None
        return certificate.not_valid_after_utc


@dataclass(frozen=True)
class MasterCredentials(Credentials):
    """The master's half, and the agents' that it hands on."""

    agent: Credentials = field(repr=False)

    def agent_half(self) -> Credentials:
        """What an agent gets: nothing in it lets its holder pose as the master."""
        return self.agent


def make_credentials(pool: str) -> MasterCredentials:
    """New credentials for the master and the agents of ``pool``, related to no others."""
    if not _POOL.fullmatch(pool):
        raise ConfigError(
            f"{pool!r} cannot be the name of a pool: use up to 102 lower-case letters, digits, '-' "
            "and '.', with a letter or digit at both ends"
        )
    authority = _Authority()
    server_name = f"master.{pool}.fiber"
    certificate, key = authority.issue(server_name, server=True)
    own, own_key = authority.issue(f"agent.{pool}.fiber", server=False)
    return MasterCredentials(
        server_name,
        authority.certificate,
        certificate,
        key,
        agent=Credentials(server_name, authority.certificate, own, own_key),
    )


class _Authority:
    """A certificate authority that exists for one ``make_credentials``."""

    def __init__(self) -> None:
        from cryptography import x509
        from cryptography.hazmat.primitives.asymmetric import ec
        from cryptography.x509.oid import NameOID

        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Fiber run")])
        builder = self._builder(self._name, self._key.public_key()).add_extension(
            x509.BasicConstraints(ca=True, path_length=0), critical=True
        )
        self.certificate = self._sign(builder)

    def issue(self, name: str, *, server: bool) -> tuple[str, str]:
        """A certificate for ``name`` and its key."""
        from cryptography import x509
        from cryptography.hazmat.primitives.asymmetric import ec
        from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

        key = ec.generate_private_key(ec.SECP256R1())
        usage = ExtendedKeyUsageOID.SERVER_AUTH if server else ExtendedKeyUsageOID.CLIENT_AUTH
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Fiber")])
        builder = (
            self._builder(subject, key.public_key())
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
            .add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
        )
        return self._sign(builder), _pem(key)

    def _builder(
        self, subject: x509.Name, key: ec.EllipticCurvePublicKey
    ) -> x509.CertificateBuilder:
        from cryptography import x509

        now = datetime.datetime.now(datetime.UTC)
        return (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(self._name)
            .public_key(key)
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - CLOCK_SKEW)
            .not_valid_after(now + VALID_FOR)
        )

    def _sign(self, builder: x509.CertificateBuilder) -> str:
        from cryptography.hazmat.primitives import hashes, serialization

        signed = builder.sign(self._key, hashes.SHA256())
        return signed.public_bytes(serialization.Encoding.PEM).decode().strip()


def _pem(key: ec.EllipticCurvePrivateKey) -> str:
    from cryptography.hazmat.primitives import serialization

    pem = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    return pem.decode().strip()


def _write_private(path: Path, text: str) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w") as file:
        file.write(text + "\n")
