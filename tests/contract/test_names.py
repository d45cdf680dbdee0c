"""Names of objects, and their limits of length."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fiber_api import names

POOLS = st.from_regex(rf"\A{names.POOL_NAME_PATTERN}\Z").filter(
    lambda name: len(name) <= names.MAX_POOL_NAME
)
LABEL = re.compile(r"[a-z0-9]([-a-z0-9]*[a-z0-9])?")
SERVICE = re.compile(r"[a-z]([-a-z0-9]*[a-z0-9])?")
SUFFIXES = st.text("0123456789abcdef", min_size=10, max_size=10)


@settings(deadline=None)
@given(POOLS, SUFFIXES)
def test_kubernetes_accepts_each_name_made_from_a_pools(pool: str, suffix: str) -> None:
    assert names.check_pool_name(pool) == pool
    for name in (
        names.pod_name(pool, suffix),
        names.endpoint_slice_name(pool),
        names.secret_name(pool),
        names.master_lease_name(pool),
        pool,
    ):
        assert LABEL.fullmatch(name)
        assert len(name) <= 63
    assert SERVICE.fullmatch(names.service_name(pool))
    assert len(names.service_name(pool)) <= 63


def test_the_longest_names() -> None:
    pool = "p" * names.MAX_POOL_NAME
    assert len(names.pod_name(pool, "0" * 10)) == 61
    assert len(names.service_name(pool)) == 56
    assert len(names.secret_name(pool)) == 60


@pytest.mark.parametrize("pool", ["", "E", "3d", "-a", "a-", "a.b", "a_b", "ä", "a\n", "a/b"])
def test_a_name_that_no_service_could_have_is_refused(pool: str) -> None:
    with pytest.raises(names.InvalidName, match="cannot be the name of a pool"):
        names.check_pool_name(pool)


def test_a_name_that_is_too_long_is_refused_with_its_excess() -> None:
    with pytest.raises(names.InvalidName, match="has 51 characters, more than 50"):
        names.check_pool_name("p" * 51)


@pytest.mark.parametrize(
    "suffix", ["", "0" * 9, "0" * 11, "ABCDEF0123", "0123456789\n", "xyzxyzxyzx"]
)
def test_a_pods_name_ends_with_hexadecimal_digits(suffix: str) -> None:
    with pytest.raises(names.InvalidName, match="10 hexadecimal digits"):
        names.pod_name("es", suffix)


def test_pools_of_different_names_share_no_object() -> None:
    # "a" and "a-fiber": neither's pods, Service or Secret is called as one of the other's.
    made = [names.service_name, names.secret_name]
    assert len({make(pool) for pool in ("a", "a-fiber", "a-tls") for make in made}) == 6


@settings(deadline=None)
@given(POOLS, POOLS)
@example("operator", "fiber-operator")
@example("fiber-operator", "fiber-fiber-operator")
def test_no_masters_lease_is_an_operators(pool: str, release: str) -> None:
    operators = {names.operator_lease_name(release), names.SERVING_LEASE}
    assert names.master_lease_name(pool) not in operators
    assert len(operators) == 2


def test_no_secret_is_called_as_cert_managers_usually_are() -> None:
    assert names.secret_name("es") not in ("es-tls", "es-cert", "es")


@pytest.mark.parametrize(
    ("host", "address"),
    [("10.96.1.2", "10.96.1.2:7070"), ("fd00::1", "[fd00::1]:7070")],
)
def test_a_host_and_a_port_make_an_address_and_an_endpoint(host: str, address: str) -> None:
    assert names.address_of(host, names.MASTER_PORT) == address
    assert names.endpoint_of(address) == f"tls+tcp://{address}"


def test_the_version_has_one_spelling() -> None:
    assert f"{names.GROUP}/{names.VERSION}" == names.API_VERSION
    assert f"{names.PLURAL}.{names.GROUP}" == names.CRD_NAME


def test_reasons_are_single_words_in_camel_case() -> None:
    for kind in (names.Reason, names.Phase, names.ConditionType):
        assert all(re.fullmatch(r"[A-Z][A-Za-z]+", member) for member in kind)


def test_names_need_the_standard_library_alone() -> None:
    program = (
        "import sys\n"
        "import fiber_api.names, fiber_api.times, fiber_api.identity\n"
        "heavy = {'pydantic', 'yaml', 'kubernetes', 'kopf', 'cryptography', 'fiber'}\n"
        "print(*heavy & set(sys.modules))\n"
    )
    path = os.pathsep.join(entry for entry in sys.path if entry)
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert (done.stdout, done.stderr) == ("\n", "")


def test_the_documentation_explains_each_condition() -> None:
    page = Path(__file__).parents[2].joinpath("docs", "fiberpools.md").read_text(encoding="utf-8")
    rows = re.search(r"\| condition \| True means \|\n\|---\|---\|\n((?:\|.*\n)+)", page)
    assert rows is not None
    explained = [row.split("|")[1].strip() for row in rows[1].splitlines()]
    assert explained == [str(kind) for kind in names.ConditionType]
