"""Scope of the operator: one switch sets its rights, its watches and the place of its test."""

from __future__ import annotations

from typing import Any

import pytest

from chart.helm import NAMESPACE, Helm, Manifest, allowed, is_hook, kinds, named
from fiber_api.names import SERVING_LEASE, operator_lease_name
from fiber_operator.settings import OperatorSettings

CLUSTER: dict[str, Any] = {"scope": "cluster"}
OWN: dict[str, Any] = {"scope": "namespaced"}
TWO: dict[str, Any] = {"scope": "namespaced", "namespaces": ["team-a", "team-b"]}
CLUSTER_WIDE = {"ClusterRole", "ClusterRoleBinding", "CustomResourceDefinition"}


def environment(manifests: list[Manifest]) -> dict[str, str]:
    """The operator's environment; a value from the pod's fields is "from-the-pod"."""
    pod = named(manifests, "Deployment")["spec"]["template"]["spec"]
    entries = pod["containers"][0]["env"]
    assert len({entry["name"] for entry in entries}) == len(entries)
    return {entry["name"]: entry.get("value", "from-the-pod") for entry in entries}


def watched(manifests: list[Manifest]) -> tuple[str, ...]:
    """The namespaces that the operator will watch, as it reads its settings."""
    return OperatorSettings.from_environment(environment(manifests)).namespaces


def granted(manifests: list[Manifest], account: str = "fiber-fiber-operator") -> dict[str, Any]:
    """Namespace ("" for all) to the rules of the operator's account there, its Lease left out."""
    pod = named(manifests, "Deployment")["spec"]["template"]["spec"]
    assert pod["serviceAccountName"] == account
    bindings = [
        binding["metadata"].get("namespace", "")
        for binding in manifests
        if binding["kind"].endswith("RoleBinding")
        and not is_hook(binding)
        and not binding["roleRef"]["name"].endswith("-lease")
        and binding["subjects"] == [subject(account)]
    ]
    return {namespace: role_of(manifests, namespace)["rules"] for namespace in bindings}


def subject(account: str) -> dict[str, str]:
    return {"kind": "ServiceAccount", "name": account, "namespace": NAMESPACE}


def role_of(manifests: list[Manifest], namespace: str) -> Manifest:
    """Return the roles of the operator's bindings in this namespace ("" for all)."""
    kind = "Role" if namespace else "ClusterRole"
    here = [
        manifest
        for manifest in manifests
        if manifest["metadata"].get("namespace", "") == namespace and not is_hook(manifest)
    ]
    (binding,) = (
        manifest
        for manifest in here
        if manifest["kind"] == f"{kind}Binding"
        and not manifest["roleRef"]["name"].endswith("-lease")
    )
    assert binding["roleRef"]["kind"] == kind
    return named(here, kind, binding["roleRef"]["name"])


@pytest.mark.parametrize(
    ("values", "expected"),
    [(CLUSTER, ()), (OWN, (NAMESPACE,)), (TWO, ("team-a", "team-b"))],
    ids=["cluster", "own", "two"],
)
def test_settings_and_rights_agree(
    helm: Helm, values: dict[str, Any], expected: tuple[str, ...]
) -> None:
    manifests = helm.render(values)
    assert watched(manifests) == expected
    assert set(granted(manifests)) == set(expected or ("",))


def test_the_rights_are_the_same_in_each_scope(helm: Helm) -> None:
    everywhere = granted(helm.render(CLUSTER))[""]
    assert granted(helm.render(TWO)) == {"team-a": everywhere, "team-b": everywhere}


@pytest.mark.parametrize(
    ("values", "places"),
    [(CLUSTER, ["kube-public"]), (OWN, [NAMESPACE]), (TWO, ["team-a", "team-b"])],
    ids=["cluster", "own", "two"],
)
def test_the_operator_may_write_its_serving_lease_where_programs_read_it(
    helm: Helm, values: dict[str, Any], places: list[str]
) -> None:
    manifests = helm.render(values)
    writers = [
        manifest
        for manifest in manifests
        if manifest["kind"] == "RoleBinding"
        and manifest["metadata"]["name"].endswith("-serving-lease")
    ]
    assert [writer["metadata"]["namespace"] for writer in writers] == places
    assert all(writer["subjects"] == [subject("fiber-fiber-operator")] for writer in writers)
    here = [role for role in manifests if role["metadata"].get("namespace") == "kube-public"]
    if places != ["kube-public"]:
        assert not here
        users = [role for role in manifests if role["metadata"]["name"] == "fiber-user"]
        assert [role["metadata"]["namespace"] for role in users] == places
        assert all(("coordination.k8s.io", "leases", "get") in allowed(role) for role in users)
        return
    binding = named(here, "RoleBinding", "fiber-serving-viewer")
    assert [entry["name"] for entry in binding["subjects"]] == ["system:authenticated"]
    role = named(here, "Role", "fiber-serving-viewer")
    assert list(allowed(role)) == [("coordination.k8s.io", "leases", "get")]
    assert [rule["resourceNames"] for rule in role["rules"]] == [[SERVING_LEASE]]


def test_scope_namespaced_makes_no_cluster_object_except_the_resource_type(helm: Helm) -> None:
    assert CLUSTER_WIDE & set(kinds(helm.render(TWO))) == {"CustomResourceDefinition"}
    without = helm.render({**TWO, "crds": {"install": False}})
    assert CLUSTER_WIDE & set(kinds(without)) == set()


@pytest.mark.parametrize("values", [CLUSTER, OWN, TWO], ids=["cluster", "own", "two"])
def test_the_lease_is_the_operators_own(helm: Helm, values: dict[str, Any]) -> None:
    manifests = helm.render(values)
    settings = OperatorSettings.from_environment(environment(manifests))
    role = named(manifests, "Role", "fiber-fiber-operator-lease")
    assert role["metadata"]["namespace"] == NAMESPACE
    leases = {rule["resources"][0] for rule in role["rules"]}
    names = [rule["resourceNames"] for rule in role["rules"] if "create" not in rule["verbs"]]
    assert leases == {"leases"}
    assert names == [[operator_lease_name(settings.lease)]]


@pytest.mark.parametrize(
    ("values", "place"),
    [(CLUSTER, NAMESPACE), (OWN, NAMESPACE), (TWO, "team-a")],
    ids=["cluster", "own", "two"],
)
def test_the_test_pool_is_made_where_the_operator_looks(
    helm: Helm, values: dict[str, Any], place: str
) -> None:
    hooks = [manifest for manifest in helm.render(values) if is_hook(manifest)]
    assert named(hooks, "Role")["metadata"]["namespace"] == place
    assert named(hooks, "RoleBinding")["metadata"]["namespace"] == place
    assert named(hooks, "Pod")["metadata"]["namespace"] == NAMESPACE


def test_the_pod_of_the_test_outlives_it_for_its_log(helm: Helm) -> None:
    """`helm test --logs` asks for the log when the hooks that go on success are gone."""
    hooks = [manifest for manifest in helm.render() if is_hook(manifest)]
    policy = "helm.sh/hook-delete-policy"
    assert {hook["kind"]: hook["metadata"]["annotations"][policy] for hook in hooks} == {
        "ServiceAccount": "before-hook-creation,hook-succeeded",
        "Role": "before-hook-creation,hook-succeeded",
        "RoleBinding": "before-hook-creation,hook-succeeded",
        "Pod": "before-hook-creation",
    }


def test_roles_for_people_extend_those_of_kubernetes_only_cluster_wide(helm: Helm) -> None:
    manifests = helm.render(CLUSTER)
    prefix = "rbac.authorization.k8s.io/aggregate-to-"

    def extends(name: str) -> set[str]:
        labels = named(manifests, "ClusterRole", name)["metadata"]["labels"]
        return {label.removeprefix(prefix) for label in labels if label.startswith(prefix)}

    assert extends("fiber-user") == set()
    assert extends("fiber-viewer") == {"view"}
    manifests = helm.render({**CLUSTER, "userRoles": {"aggregate": True}})
    assert extends("fiber-user") == {"edit", "admin"}
    roles = [
        (manifest["metadata"]["name"], manifest["metadata"]["namespace"])
        for manifest in helm.render(TWO)
        if manifest["kind"] == "Role"
        and manifest["metadata"]["name"].startswith("fiber-")
        and manifest["metadata"]["name"] in ("fiber-user", "fiber-viewer")
    ]
    assert sorted(roles) == [
        ("fiber-user", "team-a"),
        ("fiber-user", "team-b"),
        ("fiber-viewer", "team-a"),
        ("fiber-viewer", "team-b"),
    ]


def test_names_that_look_like_numbers_stay_names(helm: Helm) -> None:
    values = {"scope": "namespaced", "namespaces": ["123"], "serviceAccount": {"name": "456"}}
    manifests = helm.render(values)
    assert set(granted(manifests, account="456")) == {"123"}


def test_rights_can_be_left_to_others(helm: Helm) -> None:
    values = {"rbac": {"create": False}, "userRoles": {"create": False}}
    assert not [kind for kind in kinds(helm.render(values)) if "Role" in kind]
    assert not [manifest for manifest in helm.render(values) if is_hook(manifest)]
