"""An authority and the two certificates that it signs: one for a master, one for its agents.

An agent checks the name in the master's certificate, not the address that it dialled, so one
certificate serves a master behind any address.  The authority's key is forgotten once both are
signed: nobody can make a third.  Each certificate is good for its own side only: with the agents'
nobody can pose as the master.
"""

from __future__ import annotations

import base64
import binascii
import datetime
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from fiber_api import names

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

RUN_VALIDITY = datetime.timedelta(days=365)
"""For one run of a program.  One that lasts longer cannot take new agents."""

POOL_VALIDITY = datetime.timedelta(days=3650)
"""For a pool on a cluster.  A warm pool lives as long as nobody deletes it, its Secret is made once
and is mounted in pods that nothing restarts, so an end within its life would cut off a pool that
works.  What is given up is little: the Secret dies with the pool, no authority is left that could
sign another, and who wants new certificates deletes the Secret.  The end is not left out, because
a key that leaked from a forgotten backup should be worth nothing one day."""

CLOCK_SKEW = datetime.timedelta(days=1)
"""How far the clock of whoever checks a certificate may be behind."""

_LABEL = r"[a-z0-9]([a-z0-9-]*[a-z0-9])?"
_DNS_NAME = re.compile(rf"(?=.{{1,253}}\Z){_LABEL}(\.{_LABEL})*")


class InvalidCertificates(ValueError):
    """What was read cannot serve; the message says which part and why, and shows no key."""


@dataclass(frozen=True)
class Half:
    """What one side shows to the other: its certificate and the key to it, in PEM."""

    certificate: str = field(repr=False)
    key: str = field(repr=False)


@dataclass(frozen=True)
class Certificates:
    """Both sides' certificates and the authority that each of them trusts, in PEM."""

    server_name: str
    """The name in the master's certificate, which agents ask for."""
    authority: str = field(repr=False)
    master: Half
    agent: Half

    def texts(self) -> dict[str, str]:
        """What the Secret holds, by key, as plain text."""
        return {
            names.KEY_SERVER_NAME: self.server_name,
            names.KEY_AUTHORITY: self.authority,
            names.KEY_MASTER_CERTIFICATE: self.master.certificate,
            names.KEY_MASTER_KEY: self.master.key,
            names.KEY_AGENT_CERTIFICATE: self.agent.certificate,
            names.KEY_AGENT_KEY: self.agent.key,
        }

    @classmethod
    def from_secret(cls, data: Mapping[str, object]) -> Certificates:
        """Read ``data`` of a Secret (values in base64), whatever it holds.

        Raises ``InvalidCertificates`` for a key that is absent or no text.  Whether the
        certificates are any good is what ``check`` says.
        """
        master = Half(
            _decode(data, names.KEY_MASTER_CERTIFICATE), _decode(data, names.KEY_MASTER_KEY)
        )
        agent = Half(_decode(data, names.KEY_AGENT_CERTIFICATE), _decode(data, names.KEY_AGENT_KEY))
        server_name = _decode(data, names.KEY_SERVER_NAME)
        return cls(server_name, _decode(data, names.KEY_AUTHORITY), master, agent)

    def check(self, server_name: str, now: datetime.datetime) -> None:
        """Raise ``InvalidCertificates`` unless both sides could use them, at ``now``."""
        authority = _load(names.KEY_AUTHORITY, self.authority)
        master = _load(names.KEY_MASTER_CERTIFICATE, self.master.certificate)
        agent = _load(names.KEY_AGENT_CERTIFICATE, self.agent.certificate)
        _check_period(names.KEY_AUTHORITY, authority, now)
        for key, certificate in (
            (names.KEY_MASTER_CERTIFICATE, master),
            (names.KEY_AGENT_CERTIFICATE, agent),
        ):
            _check_period(key, certificate, now)
            _check_issuer(key, certificate, authority)
        _check_key(names.KEY_MASTER_KEY, self.master.key, master)
        _check_key(names.KEY_AGENT_KEY, self.agent.key, agent)
        if server_name not in _names_in(master) or self.server_name != server_name:
            raise InvalidCertificates(
                f"{names.KEY_MASTER_CERTIFICATE} and {names.KEY_SERVER_NAME} are not for "
                f"{server_name}"
            )

    def expires(self) -> datetime.datetime:
        """When the first of them ends to be valid."""
        return min(
            _load(names.KEY_AUTHORITY, self.authority).not_valid_after_utc,
            _load(names.KEY_MASTER_CERTIFICATE, self.master.certificate).not_valid_after_utc,
            _load(names.KEY_AGENT_CERTIFICATE, self.agent.certificate).not_valid_after_utc,
        )


def make_certificates(
    server_name: str,
    agent_name: str,
    *,
    valid_for: datetime.timedelta,
    now: datetime.datetime | None = None,
) -> Certificates:
    """New certificates for a master and its agents, related to no others.  Takes a millisecond."""
    for name in (server_name, agent_name):
        if not _DNS_NAME.fullmatch(name):
            raise names.InvalidName(
                f"{name!r} cannot stand in a certificate: it is no DNS name. Use lower-case "
                "letters, digits, '-' and '.'."
            )
    start = now or datetime.datetime.now(datetime.UTC)
    authority = _Authority(start - CLOCK_SKEW, start + valid_for)
    return Certificates(
        server_name,
        authority.certificate,
        master=authority.issue(server_name, server=True),
        agent=authority.issue(agent_name, server=False),
    )


def make_pool_certificates(
    pool: str, namespace: str, now: datetime.datetime | None = None
) -> Certificates:
    """What the Secret of a FiberPool holds."""
    return make_certificates(
        names.server_name(pool, namespace),
        names.agent_server_name(pool, namespace),
        valid_for=POOL_VALIDITY,
        now=now,
    )


class _Authority:
    """A certificate authority that exists for one ``make_certificates``."""

    def __init__(self, start: datetime.datetime, end: datetime.datetime) -> None:
        from cryptography import x509
        from cryptography.hazmat.primitives.asymmetric import ec
        from cryptography.x509.oid import NameOID

        self._period = start, end
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Fiber authority")])
        builder = (
            self._builder(self._name, self._key.public_key())
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(key_cert_sign=True), critical=True)
        )
        self.certificate = self._sign(builder)

    def issue(self, name: str, *, server: bool) -> Half:
        """A certificate for ``name`` and its key."""
        from cryptography import x509
        from cryptography.hazmat.primitives.asymmetric import ec
        from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

        key = ec.generate_private_key(ec.SECP256R1())
        side = ExtendedKeyUsageOID.SERVER_AUTH if server else ExtendedKeyUsageOID.CLIENT_AUTH
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Fiber")])
        issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key())
        builder = (
            self._builder(subject, key.public_key())
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(digital_signature=True), critical=True)
            .add_extension(x509.ExtendedKeyUsage([side]), critical=False)
            .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
            .add_extension(issuer, critical=False)
        )
        return Half(self._sign(builder), _pem(key))

    def _builder(
        self, subject: x509.Name, key: ec.EllipticCurvePublicKey
    ) -> x509.CertificateBuilder:
        from cryptography import x509

        start, end = self._period
        return (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(self._name)
            .public_key(key)
            .serial_number(x509.random_serial_number())
            .not_valid_before(start)
            .not_valid_after(end)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        )

    def _sign(self, builder: x509.CertificateBuilder) -> str:
        from cryptography.hazmat.primitives import hashes, serialization

        signed = builder.sign(self._key, hashes.SHA256())
        return signed.public_bytes(serialization.Encoding.PEM).decode().strip()


def _usage(*, digital_signature: bool = False, key_cert_sign: bool = False) -> x509.KeyUsage:
    from cryptography import x509

    return x509.KeyUsage(
        digital_signature=digital_signature,
        key_cert_sign=key_cert_sign,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        crl_sign=False,
        encipher_only=False,
        decipher_only=False,
    )


def _pem(key: ec.EllipticCurvePrivateKey) -> str:
    from cryptography.hazmat.primitives import serialization

    pem = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    return pem.decode().strip()


def _decode(data: Mapping[str, object], key: str) -> str:
    value = data.get(key)
    if not isinstance(value, str) or not value:
        raise InvalidCertificates(f"{key} is absent")
    try:
        return base64.b64decode(value, validate=True).decode().strip()
    except (binascii.Error, ValueError):
        raise InvalidCertificates(f"{key} is no text in base64") from None


def _load(key: str, pem: str) -> x509.Certificate:
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificate(pem.encode())
    except ValueError as error:
        raise InvalidCertificates(f"{key} is not a PEM certificate: {error}") from None


def _names_in(certificate: x509.Certificate) -> list[str]:
    from cryptography import x509

    try:
        san = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)
        return san.value.get_values_for_type(x509.DNSName)
    except (x509.ExtensionNotFound, x509.DuplicateExtension, ValueError):
        # Somebody else's certificate, perhaps one that cannot even be read to its end.
        return []


def _check_period(key: str, certificate: x509.Certificate, now: datetime.datetime) -> None:
    start, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if not start <= now < end:
        raise InvalidCertificates(
            f"{key} is valid from {start:%Y-%m-%d %H:%M} to {end:%Y-%m-%d %H:%M} UTC, and not at "
            f"{now:%Y-%m-%d %H:%M}"
        )


def _check_issuer(key: str, certificate: x509.Certificate, authority: x509.Certificate) -> None:
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm

    try:
        certificate.verify_directly_issued_by(authority)
    except (InvalidSignature, UnsupportedAlgorithm, ValueError, TypeError):
        raise InvalidCertificates(f"{key} is not signed by {names.KEY_AUTHORITY}") from None


def _check_key(key: str, pem: str, certificate: x509.Certificate) -> None:
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives import serialization

    try:
        private = serialization.load_pem_private_key(pem.encode(), password=None)
        belongs = private.public_key() == certificate.public_key()
    except (ValueError, TypeError, UnsupportedAlgorithm):
        # The error's text is not repeated: it may quote what it could not read.
        raise InvalidCertificates(f"{key} is not a PEM private key") from None
    if not belongs:
        raise InvalidCertificates(f"{key} does not belong to its certificate")
