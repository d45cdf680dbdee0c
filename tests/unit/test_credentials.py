"""Credentials: what each side gets, where it is kept, and who can read it."""

from __future__ import annotations

import datetime
import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, ExtensionOID

from fiber._transport.credentials import (
    Credentials,
    MasterCredentials,
    make_credentials,
)
from fiber.errors import AuthenticationError, ConfigError
from fiber_api.certificates import CLOCK_SKEW


@pytest.fixture(scope="module")
def credentials() -> MasterCredentials:
    return make_credentials("walkers-1")


def certificate_of(half: Credentials) -> x509.Certificate:
    return x509.load_pem_x509_certificate(half.certificate.encode())


def test_both_certificates_are_signed_by_the_authority(credentials: MasterCredentials) -> None:
    authority = x509.load_pem_x509_certificate(credentials.authority.encode())
    for half in (credentials, credentials.agent_half()):
        certificate_of(half).verify_directly_issued_by(authority)


def test_only_the_master_bears_the_servers_name(credentials: MasterCredentials) -> None:
    def names(half: Credentials) -> list[str]:
        extension = certificate_of(half).extensions.get_extension_for_oid(
            ExtensionOID.SUBJECT_ALTERNATIVE_NAME
        )
        assert isinstance(extension.value, x509.SubjectAlternativeName)
        return extension.value.get_values_for_type(x509.DNSName)

    def usage(half: Credentials) -> list[x509.ObjectIdentifier]:
        extension = certificate_of(half).extensions.get_extension_for_class(x509.ExtendedKeyUsage)
        return list(extension.value)

    agent = credentials.agent_half()
    assert names(credentials) == ["master.walkers-1.fiber"] == [agent.server_name]
    assert names(agent) == ["agent.walkers-1.fiber"]
    assert usage(credentials) == [ExtendedKeyUsageOID.SERVER_AUTH]
    assert usage(agent) == [ExtendedKeyUsageOID.CLIENT_AUTH]


def test_the_agents_half_holds_nothing_of_the_masters(credentials: MasterCredentials) -> None:
    agent = credentials.agent_half()
    descriptor = agent.to_descriptor()
    with open(descriptor) as file:
        handed_over = file.read()
    assert json.dumps(agent.key)[1:-1] in handed_over
    assert json.dumps(credentials.key)[1:-1] not in handed_over
    assert credentials.key not in repr(vars(agent))
    assert type(agent) is Credentials


def test_each_run_has_its_own_authority(credentials: MasterCredentials) -> None:
    other = make_credentials("walkers-1")
    assert other.authority != credentials.authority
    assert other.key != credentials.key


def test_a_clock_that_is_behind_does_not_matter(credentials: MasterCredentials) -> None:
    now = datetime.datetime.now(datetime.UTC)
    for half in (credentials, credentials.agent_half()):
        certificate = certificate_of(half)
        assert certificate.not_valid_before_utc < now - CLOCK_SKEW / 2
        assert half.expires() == certificate.not_valid_after_utc > now


def test_a_directory_of_private_files(credentials: MasterCredentials, tmp_path: Path) -> None:
    agent = credentials.agent_half()
    before = os.umask(0)
    try:
        agent.to_directory(tmp_path / "agent")
    finally:
        os.umask(before)
    modes = {
        path.name: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "agent").iterdir()
    }
    assert modes == dict.fromkeys(("ca.crt", "tls.crt", "tls.key", "server-name"), 0o600)
    assert stat.S_IMODE((tmp_path / "agent").stat().st_mode) == 0o700
    assert Credentials.from_directory(tmp_path / "agent") == agent
    with pytest.raises(FileExistsError):
        agent.to_directory(tmp_path / "agent")


def test_a_directory_without_credentials_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no credentials can be read from .*server-name"):
        Credentials.from_directory(tmp_path)


def test_a_descriptor_brings_them_once(credentials: MasterCredentials) -> None:
    agent = credentials.agent_half()
    descriptor = agent.to_descriptor()
    assert not os.get_inheritable(descriptor)
    again = os.dup(descriptor)
    assert Credentials.from_descriptor(descriptor) == agent
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(descriptor)
    with pytest.raises(ConfigError, match="what is cut short"):
        Credentials.from_descriptor(again)


def not_credentials() -> list[bytes]:
    return [b"", b"secret", b"s\xff", b"[]", b"1", json.dumps({"key": "secret"}).encode()]


@pytest.mark.parametrize("value", not_credentials())
def test_what_else_a_descriptor_brings_is_refused_and_not_repeated(value: bytes) -> None:
    reader, writer = os.pipe()
    os.write(writer, value)
    os.close(writer)
    with pytest.raises(ConfigError, match=rf"on descriptor {reader} cannot be read") as caught:
        Credentials.from_descriptor(reader)
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize("descriptor", [-1, 10**6, 10**12])
def test_a_descriptor_that_is_none_is_named(descriptor: int) -> None:
    with pytest.raises(ConfigError, match=f"descriptor {descriptor} cannot be read"):
        Credentials.from_descriptor(descriptor)


def test_no_secret_in_a_repr(credentials: MasterCredentials) -> None:
    assert repr(credentials) == "MasterCredentials(server_name='master.walkers-1.fiber')"
    assert repr(credentials.agent_half()) == "Credentials(server_name='master.walkers-1.fiber')"


def test_a_certificate_that_is_none_is_named() -> None:
    with pytest.raises(AuthenticationError, match=r"master.x.fiber is not a PEM certificate"):
        Credentials("master.x.fiber", "", "nonsense", "").expires()


@pytest.mark.parametrize("pool", ["", "Walkers", "a_b", "-a", "a.", "a" * 241, "a/b", "ä"])
def test_a_name_that_no_certificate_can_bear_is_refused(pool: str) -> None:
    with pytest.raises(ConfigError, match="cannot be the name of a pool"):
        make_credentials(pool)


def test_a_long_name_and_a_namespace_are_fine() -> None:
    pool = f"{'p' * 51}.{'n' * 50}"
    assert make_credentials(pool).server_name == f"master.{pool}.fiber"


def test_importing_the_module_does_not_import_cryptography() -> None:
    statement = (
        "import sys, fiber._transport.credentials; "
        "sys.exit(any(name.startswith('cryptography') for name in sys.modules))"
    )
    path = os.pathsep.join(entry for entry in sys.path if entry)
    environment = {**os.environ, "PYTHONPATH": path}
    assert subprocess.run([sys.executable, "-c", statement], env=environment).returncode == 0
