"""Who may talk to whom: a certificate authority per run, one certificate for each side.

An agent checks the master's name in its certificate, not its address, so one certificate serves a
master behind any address.
"""

from __future__ import annotations

import datetime
import json
import os
from dataclasses import dataclass, field
from pathlib import Path

from fiber.errors import AuthenticationError, ConfigError
from fiber_api.certificates import RUN_VALIDITY, Certificates, make_certificates
from fiber_api.names import InvalidName

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

    def to_descriptor(self) -> int:
        """A descriptor from which they can be read once, by whoever inherits it."""
        values = json.dumps({name: getattr(self, name) for name in _FILES}).encode()
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
        """Read what ``to_descriptor`` wrote, and close it.  The error does not repeat anything."""
        try:
            with open(descriptor, "rb") as file:
                values = json.loads(file.read())
            return cls(**{name: str(values[name]) for name in _FILES})
        except (OSError, OverflowError, ValueError, KeyError, TypeError):
            # Whatever else a descriptor may bring.
            raise ConfigError(
                f"the credentials on descriptor {descriptor} cannot be read: it is not open, or "
                "brings what is cut short or not Fiber's. Hand them over as the master made them."
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

    @classmethod
    def of(cls, made: Certificates) -> MasterCredentials:
        """The credentials that these certificates are."""
        agent = Credentials(
            made.server_name, made.authority, made.agent.certificate, made.agent.key
        )
        return cls(
            made.server_name, made.authority, made.master.certificate, made.master.key, agent=agent
        )

    def agent_half(self) -> Credentials:
        """What an agent gets: nothing in it lets its holder pose as the master."""
        return self.agent


def make_credentials(pool: str) -> MasterCredentials:
    """New credentials for the master and the agents of ``pool``, related to no others.

    They are valid for ``fiber_api.certificates.RUN_VALIDITY``: a run that lasts longer cannot take
    new agents.
    """
    try:
        made = make_certificates(
            f"master.{pool}.fiber", f"agent.{pool}.fiber", valid_for=RUN_VALIDITY
        )
    except InvalidName:
        raise ConfigError(
            f"{pool!r} cannot be the name of a pool: use up to 240 lower-case letters, digits, '-' "
            "and '.', with a letter or digit at both ends of each part"
        ) from None
    return MasterCredentials.of(made)


def _write_private(path: Path, text: str) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w") as file:
        file.write(text + "\n")
