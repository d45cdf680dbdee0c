"""The policy that bounds what templates of FiberPools ask for."""

from __future__ import annotations

from chart.helm import Helm, kinds, named

POLICY = "ValidatingAdmissionPolicy"


def test_is_off_unless_wanted(helm: Helm) -> None:
    assert POLICY not in kinds(helm.render())


def test_each_refusal_names_the_user_the_reason_and_the_remedy(helm: Helm) -> None:
    manifests = helm.render({"admissionPolicy": {"create": True}})
    for validation in named(manifests, POLICY)["spec"]["validations"]:
        assert validation["messageExpression"].startswith("variables.who + ")
        assert "ask an administrator" in validation["messageExpression"]


def test_values_allow_accounts_and_capabilities(helm: Helm) -> None:
    values = {"create": True, "serviceAccounts": ["trainer"], "capabilities": ["SYS_PTRACE"]}
    text = str(named(helm.render({"admissionPolicy": values}), POLICY)["spec"])
    assert '["trainer"]' in text
    assert '["SYS_PTRACE"]' in text


def test_it_holds_where_the_operator_works_and_no_label_excepts(helm: Helm) -> None:
    values = {"scope": "namespaced", "namespaces": ["lab"], "admissionPolicy": {"create": True}}
    binding = named(helm.render(values), f"{POLICY}Binding")["spec"]
    label, namespace = binding["matchResources"]["namespaceSelector"]["matchExpressions"]
    assert (label["key"], label["operator"]) == ("fiber.dev/unrestricted", "NotIn")
    assert namespace["values"] == ["lab"]
