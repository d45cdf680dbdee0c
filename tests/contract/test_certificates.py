"""Certificates of a pool: what they are good for, for how long, and what is no use."""

from __future__ import annotations

import base64
import datetime
from dataclasses import replace

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID
from hypothesis import given, settings
from hypothesis import strategies as st

from fiber_api import names
from fiber_api.certificates import (
    CLOCK_SKEW,
    POOL_VALIDITY,
    Certificates,
    InvalidCertificates,
    make_certificates,
    make_pool_certificates,
)

NOW = datetime.datetime(2026, 11, 21, 14, 56, 13, tzinfo=datetime.UTC)
SERVER = "master.es.research.fiber"


@pytest.fixture(scope="module")
def pool() -> Certificates:
    return make_pool_certificates("es", "research", NOW)


def data_of(certificates: Certificates) -> dict[str, object]:
    """The ``data`` of a Secret made of them."""
    return {
        key: base64.b64encode(value.encode()).decode()
        for key, value in certificates.texts().items()
    }


def loaded(pem: str) -> x509.Certificate:
    return x509.load_pem_x509_certificate(pem.encode())


def test_what_a_secret_holds_comes_back(pool: Certificates) -> None:
    assert set(pool.texts()) == {*names.AGENT_FILES, *names.MASTER_FILES}
    assert Certificates.from_secret(data_of(pool)) == pool
    pool.check(SERVER, NOW)


def test_each_certificate_is_good_for_its_own_side_only(pool: Certificates) -> None:
    for half, usage, name in (
        (pool.master, ExtendedKeyUsageOID.SERVER_AUTH, SERVER),
        (pool.agent, ExtendedKeyUsageOID.CLIENT_AUTH, "agent.es.research.fiber"),
    ):
        certificate = loaded(half.certificate)
        extensions = certificate.extensions
        certificate.verify_directly_issued_by(loaded(pool.authority))
        assert list(extensions.get_extension_for_class(x509.ExtendedKeyUsage).value) == [usage]
        assert not extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        san = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        assert san.get_values_for_type(x509.DNSName) == [name]


def test_the_authority_signs_certificates_and_no_other_authorities(pool: Certificates) -> None:
    constraints = loaded(pool.authority).extensions.get_extension_for_class(x509.BasicConstraints)
    assert (constraints.value.ca, constraints.value.path_length) == (True, 0)
    # Its key is nowhere: three keys were made and two are kept.
    assert sum("PRIVATE KEY" in value for value in pool.texts().values()) == 2


def test_they_outlast_a_warm_pool_and_a_slow_clock(pool: Certificates) -> None:
    for pem in (pool.authority, pool.master.certificate, pool.agent.certificate):
        assert loaded(pem).not_valid_before_utc == NOW - CLOCK_SKEW
        assert loaded(pem).not_valid_after_utc == NOW + POOL_VALIDITY
    assert pool.expires() == NOW + POOL_VALIDITY
    assert datetime.timedelta(days=5 * 365) < POOL_VALIDITY


def test_two_pools_have_nothing_in_common(pool: Certificates) -> None:
    other = make_pool_certificates("es", "research", NOW)
    assert {pool.authority, pool.master.key, pool.agent.key}.isdisjoint(other.texts().values())


def test_the_longest_names_fit() -> None:
    pool, namespace = "p" * names.MAX_POOL_NAME, "n" * 63
    certificates = make_pool_certificates(pool, namespace, NOW)
    certificates.check(names.server_name(pool, namespace), NOW)


@pytest.mark.parametrize("name", ["", "a b", "a..b", "-a", "A", "ä", "a\n", f"{'a' * 254}"])
def test_a_name_that_is_none_is_refused(name: str) -> None:
    for pair in ((name, "agent"), ("master", name)):
        with pytest.raises(names.InvalidName, match="no DNS name"):
            make_certificates(*pair, valid_for=POOL_VALIDITY)


def test_no_key_in_a_repr(pool: Certificates) -> None:
    assert repr(pool) == f"Certificates(server_name={SERVER!r}, master=Half(), agent=Half())"


@pytest.mark.parametrize(
    "when", [NOW - 2 * CLOCK_SKEW, NOW + POOL_VALIDITY, NOW + 2 * POOL_VALIDITY]
)
def test_outside_their_time_they_are_no_use(pool: Certificates, when: datetime.datetime) -> None:
    with pytest.raises(InvalidCertificates, match=r"ca.crt is valid from 2026-11-20 .* to 2036-"):
        pool.check(SERVER, when)


def test_another_pools_are_no_use(pool: Certificates) -> None:
    with pytest.raises(InvalidCertificates, match=r"are not for master\.es\.other\.fiber"):
        pool.check("master.es.other.fiber", NOW)
    other = make_pool_certificates("es", "research", NOW)
    for broken, complaint in (
        (replace(pool, authority=other.authority), r"master\.crt is not signed by ca\.crt"),
        (replace(pool, agent=other.agent), r"agent\.crt is not signed by ca\.crt"),
        (
            replace(pool, master=replace(pool.master, key=other.master.key)),
            r"master\.key does not belong to its certificate",
        ),
        (replace(pool, server_name="x"), "are not for"),
        (replace(pool, master=pool.agent), "are not for"),
    ):
        with pytest.raises(InvalidCertificates, match=complaint):
            broken.check(SERVER, NOW)


@pytest.mark.parametrize("key", sorted({*names.AGENT_FILES, *names.MASTER_FILES}))
@pytest.mark.parametrize("value", [None, 3, "", "not base64!", "/w==", "bm9uc2Vuc2U="])
def test_a_damaged_secret_is_an_error_that_names_the_key(
    pool: Certificates, key: str, value: object
) -> None:
    with pytest.raises(InvalidCertificates, match=key.replace(".", r"\.")):
        Certificates.from_secret({**data_of(pool), key: value}).check(SERVER, NOW)


@settings(deadline=None)
@given(key=st.sampled_from(sorted({*names.AGENT_FILES, *names.MASTER_FILES})), text=st.text())
def test_no_text_is_too_odd(pool: Certificates, key: str, text: str) -> None:
    value = base64.b64encode(text.encode()).decode()
    with pytest.raises(InvalidCertificates):
        Certificates.from_secret({**data_of(pool), key: value}).check(SERVER, NOW)


@pytest.mark.parametrize("half", ["master", "agent"])
def test_no_part_of_a_key_is_in_an_error(pool: Certificates, half: str) -> None:
    key = getattr(pool, half).key
    cut = replace(pool, **{half: replace(getattr(pool, half), key=key[: len(key) // 2])})
    with pytest.raises(InvalidCertificates) as caught:
        cut.check(SERVER, NOW)
    assert key.splitlines()[1][:20] not in str(caught.value)
