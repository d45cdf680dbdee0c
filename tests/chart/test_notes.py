"""Run the notes of the installation: each command in them works as it stands."""

from __future__ import annotations

import re
from typing import Any

import pytest
import yaml

import fiber
from chart.helm import NAMESPACE, Helm, named

TWO: dict[str, Any] = {"scope": "namespaced", "namespaces": ["team-a", "team-b"]}


def pasted(notes: str) -> dict[str, Any]:
    """The manifest between the lines that a shell reads as a document."""
    found = re.search(r"^kubectl apply -f - <<'END'\n(.*?)^END$", notes, re.M | re.S)
    assert found, notes
    manifest: dict[str, Any] = yaml.safe_load(found[1])
    return manifest


@pytest.mark.parametrize(
    ("values", "namespace"), [({}, NAMESPACE), (TWO, "team-a")], ids=["cluster", "two"]
)
def test_the_manifest_is_for_a_namespace_that_is_watched(
    helm: Helm, values: dict[str, Any], namespace: str
) -> None:
    manifest = pasted(helm.notes(values))
    assert (manifest["kind"], manifest["metadata"]["name"]) == ("FiberPool", "first")
    assert manifest["metadata"]["namespace"] == namespace
    (worker,) = manifest["spec"]["template"]["spec"]["containers"]
    assert worker["image"] == f"fiber-worker:{fiber.__version__}"
    assert f"kubectl --namespace {namespace} get fiberpools --watch" in helm.notes(values)


@pytest.mark.parametrize(
    ("values", "image"),
    [
        (
            {"image": {"repository": "r.example:5000/a/fiber-operator"}},
            "r.example:5000/a/fiber-worker",
        ),
        ({"image": {"repository": "r.example/op"}}, "r.example/fiber-worker"),
        ({"workerImage": {"repository": "mine"}}, "mine"),
    ],
)
def test_the_workers_image_is_beside_the_operators(
    helm: Helm, values: dict[str, Any], image: str
) -> None:
    (worker,) = pasted(helm.notes(values))["spec"]["template"]["spec"]["containers"]
    assert worker["image"] == f"{image}:{fiber.__version__}"


def test_the_commands_name_the_installed_objects(helm: Helm) -> None:
    notes = helm.notes()
    name = named(helm.render(), "Deployment")["metadata"]["name"]
    assert f"kubectl --namespace {NAMESPACE} logs deployment/{name}" in notes
    assert f"helm test fiber --namespace {NAMESPACE} --logs" in notes


def test_the_notes_name_the_watched_namespaces(helm: Helm) -> None:
    assert helm.notes().startswith("The Fiber operator watches all namespaces.")
    assert "watches the namespaces team-a, team-b, and no other." in helm.notes(TWO)


def test_the_notes_warn_where_users_of_pools_can_reach_the_operator(helm: Helm) -> None:
    warning = "WARNING: the operator serves the namespace that it runs in."
    advice = f"Give no account the role fiber-user in {NAMESPACE}"
    own, everywhere, apart = helm.notes({"scope": "namespaced"}), helm.notes(), helm.notes(TWO)
    assert (warning in own, advice in own) == (True, False)
    assert (warning in everywhere, advice in everywhere) == (False, True)
    assert (warning in apart, advice in apart) == (False, False)


def test_the_notes_name_the_omitted_parts(helm: Helm) -> None:
    notes = helm.notes({"rbac": {"create": False}, "crds": {"install": False}})
    assert "gives ServiceAccount fiber-fiber-operator the" in notes
    assert "kubectl get crd fiberpools.fiber.dev" in notes
    assert "helm test" not in notes
