"""The admission policy that bounds the templates of FiberPools."""

from __future__ import annotations

import importlib
from typing import Any

import pytest

from chart.helm import Helm, Manifest, kinds, named
from chart.policy_cases import ALLOWED, FORBIDDEN, Body, of_context, of_pod, with_more
from fiber_operator.planning import relay
from unit.operator_objects import make_pool

cel: Any = importlib.import_module("cel")  # it has no types

POLICY = "ValidatingAdmissionPolicy"
CREATED: Body = {"admissionPolicy": {"create": True}}
TEMPLATE = of_pod(containers=[{"name": "worker", "image": "fiber-worker"}])
PASSED_ON = {
    "another account",
    "a priority class of the system",
    "a type of SELinux",
    "a user of SELinux",
    "nodes with any taint",
    "nodes with any taint of one effect",
    "the control plane",
}
"""Cases that the relay shares, because they say where and as whom a pod may run.  Of an account it
gets the pull secrets, and no token."""
ALICE = "alice"
LAB = "system:serviceaccount:lab:"


def refusals(policy: Manifest, template: Body, user: str = ALICE) -> list[str]:
    """Return the policy's messages about a new pool in namespace ``lab``; empty: it is allowed."""
    request = {"operation": "CREATE", "namespace": "lab", "userInfo": {"username": user}}
    known: Body = {"object": {"spec": {"template": template}}, "request": request, "variables": {}}
    spec = policy["spec"]
    assert all(
        cel.evaluate(condition["expression"], known) for condition in spec["matchConditions"]
    )
    for variable in spec["variables"]:
        known["variables"][variable["name"]] = cel.evaluate(variable["expression"], known)
    return [
        cel.evaluate(validation["messageExpression"], known)
        for validation in spec["validations"]
        if not cel.evaluate(validation["expression"], known)
    ]


@pytest.fixture
def policy(helm: Helm) -> Manifest:
    return named(helm.render(CREATED), POLICY)


def test_the_policy_is_off_by_default(helm: Helm) -> None:
    assert POLICY not in kinds(helm.render())


@pytest.mark.parametrize("case", FORBIDDEN)
def test_a_forbidden_field_is_refused_with_user_reason_and_remedy(
    case: str, policy: Manifest
) -> None:
    more, words = FORBIDDEN[case]
    (said,) = refusals(policy, with_more(TEMPLATE, more))
    assert said.startswith(f"the template of {ALICE} asks for ")
    assert words in said
    assert "ask an administrator" in said


@pytest.mark.parametrize("case", ALLOWED)
def test_the_relay_of_an_allowed_template_asks_for_nothing_else(
    case: str, policy: Manifest
) -> None:
    """The policy does not judge Deployments; those of a cluster may be as strict."""
    pool = make_pool(relay=True, template=with_more(TEMPLATE, ALLOWED[case]))
    made = relay.deployment(pool)["spec"]["template"]
    assert refusals(policy, made) == []


@pytest.mark.parametrize("case", sorted(set(FORBIDDEN) - PASSED_ON))
def test_the_relay_asks_for_nothing_that_the_policy_forbids(case: str, policy: Manifest) -> None:
    pool = make_pool(relay=True, template=with_more(TEMPLATE, FORBIDDEN[case][0]))
    made = relay.deployment(pool)["spec"]["template"]
    assert refusals(policy, made) == []


@pytest.mark.parametrize("case", ALLOWED)
def test_other_fields_pass(case: str, policy: Manifest) -> None:
    assert refusals(policy, with_more(TEMPLATE, ALLOWED[case])) == []


def test_every_rule_refuses_a_template(policy: Manifest) -> None:
    said = {
        line
        for more, _ in FORBIDDEN.values()
        for line in refusals(policy, with_more(TEMPLATE, more))
    }
    assert len(said) == len(policy["spec"]["validations"])


def test_only_the_account_itself_has_its_account(policy: Manifest) -> None:
    template = with_more(TEMPLATE, of_pod(serviceAccountName="master"))
    assert refusals(policy, template, f"{LAB}master") == []
    others = (ALICE, "master", f"{LAB}other", "system:serviceaccount:lab2:master")
    assert all(refusals(policy, template, user) for user in others)


def test_values_allow_accounts_and_capabilities(helm: Helm) -> None:
    values = {"create": True, "serviceAccounts": ["trainer"], "capabilities": ["SYS_PTRACE"]}
    policy = named(helm.render({"admissionPolicy": values}), POLICY)
    allowed = of_context(capabilities={"add": ["SYS_PTRACE"]})
    allowed["spec"]["serviceAccountName"] = "trainer"
    assert refusals(policy, with_more(TEMPLATE, allowed)) == []
    for more in (of_context(capabilities={"add": ["NET_RAW"]}), of_pod(serviceAccountName="other")):
        assert len(refusals(policy, with_more(TEMPLATE, more))) == 1


def test_the_policy_covers_the_operators_namespaces_except_labelled_ones(helm: Helm) -> None:
    values = {"scope": "namespaced", "namespaces": ["lab"], "admissionPolicy": {"create": True}}
    binding = named(helm.render(values), f"{POLICY}Binding")["spec"]
    label, namespace = binding["matchResources"]["namespaceSelector"]["matchExpressions"]
    assert (label["key"], label["operator"]) == ("fiber.dev/unrestricted", "NotIn")
    assert namespace["values"] == ["lab"]
