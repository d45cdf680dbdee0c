"""Rights that the rules never give, for any call of the operator."""

from __future__ import annotations

import pytest

from chart.helm import Helm, Manifest, allowed, named
from fakes.rights import FIBER_USER


@pytest.fixture
def roles(helm: Helm) -> list[Manifest]:
    return [manifest for manifest in helm.render() if manifest["kind"] in ("Role", "ClusterRole")]


@pytest.fixture
def operator(roles: list[Manifest]) -> set[tuple[str, str, str]]:
    return set(allowed(named(roles, "ClusterRole", "fiber-system:fiber-fiber-operator")))


def test_roles_have_no_wildcards_and_no_repetitions(roles: list[Manifest]) -> None:
    for role in roles:
        rights = list(allowed(role))
        assert not [right for right in rights if "*" in right]
        plain = [right for right in rights if right[1:] != ("leases", "create")]
        assert len(set(plain)) == len(plain)


def test_the_operator_never_writes_a_spec(operator: set[tuple[str, str, str]]) -> None:
    pools = {verb for group, resource, verb in operator if resource == "fiberpools"}
    assert pools.isdisjoint({"create", "update", "patch"})


def test_the_operator_lists_no_secret(operator: set[tuple[str, str, str]]) -> None:
    secrets = {verb for group, resource, verb in operator if resource == "secrets"}
    assert secrets.isdisjoint({"list", "watch"})


def test_the_operator_cannot_grant_rights_or_run_programs_in_pods(
    operator: set[tuple[str, str, str]],
) -> None:
    groups = {group for group, _, _ in operator}
    assert "rbac.authorization.k8s.io" not in groups
    resources = {resource for _, resource, _ in operator}
    assert resources.isdisjoint({"pods/exec", "pods/portforward", "nodes", "serviceaccounts"})


def test_a_viewer_changes_no_object_and_reads_no_secret(roles: list[Manifest]) -> None:
    rights = list(allowed(named(roles, "ClusterRole", "fiber-viewer")))
    assert {verb for _, _, verb in rights} == {"get", "list", "watch"}
    assert "secrets" not in {resource for _, resource, _ in rights}


def test_a_program_has_exactly_the_rights_for_the_sdks_calls(roles: list[Manifest]) -> None:
    rights: dict[str, set[str]] = {}
    for _, resource, verb in allowed(named(roles, "ClusterRole", "fiber-user")):
        rights.setdefault(resource, set()).add(verb)
    assert rights == FIBER_USER


def test_a_person_who_runs_programs_gets_jobs_and_logs_beside_them(roles: list[Manifest]) -> None:
    rights: dict[str, set[str]] = {}
    for _, resource, verb in allowed(named(roles, "ClusterRole", "fiber-runner")):
        rights.setdefault(resource, set()).add(verb)
    assert rights == {
        "events": {"list"},
        "jobs": {"create", "delete", "get", "list"},
        "pods/log": {"get"},
        "serviceaccounts": {"get"},
    }


def test_the_test_touches_its_own_pool_alone(roles: list[Manifest]) -> None:
    rules = named(roles, "Role", "fiber-fiber-operator-test")["rules"]
    free = [rule["verbs"] for rule in rules if "resourceNames" not in rule]
    assert free == [["create"]]
