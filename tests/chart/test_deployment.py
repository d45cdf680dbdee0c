"""The operator's pod: hardened, probed, one at a time, and set up as its values say."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest

import fiber
from chart.helm import Helm, Manifest, Refused, is_hook, named
from chart.test_scope import environment
from fiber_api.names import check_pool_name
from fiber_operator.settings import OperatorSettings

DNS_LABEL = "[a-z]([-a-z0-9]{0,61}[a-z0-9])?"
"""Pattern of a Service's name."""
SOON_GONE: list[dict[str, Any]] = [
    {
        "key": f"node.kubernetes.io/{taint}",
        "operator": "Exists",
        "effect": "NoExecute",
        "tolerationSeconds": 30,
    }
    for taint in ("not-ready", "unreachable")
]


def pod_spec(manifests: list[Manifest]) -> dict[str, Any]:
    spec: dict[str, Any] = named(manifests, "Deployment")["spec"]["template"]["spec"]
    return spec


def images(manifests: list[Manifest]) -> set[str]:
    """The images of the operator and of the helm test; they are one."""
    test = named([manifest for manifest in manifests if is_hook(manifest)], "Pod")["spec"]
    return {spec["containers"][0]["image"] for spec in (pod_spec(manifests), test)}


def test_two_never_run_at_once(helm: Helm) -> None:
    spec = named(helm.render(), "Deployment")["spec"]
    assert spec["replicas"] == 1
    assert spec["strategy"] == {"type": "Recreate"}


def test_every_pod_passes_the_restricted_standard(helm: Helm) -> None:
    manifests = helm.render()
    for spec in (pod_spec(manifests), named(manifests, "Pod")["spec"]):
        assert spec["securityContext"] == {
            "runAsNonRoot": True,
            "seccompProfile": {"type": "RuntimeDefault"},
        }
        (container,) = spec["containers"]
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
        assert container["volumeMounts"] == [{"name": "tmp", "mountPath": "/tmp"}]
        assert "sizeLimit" in spec["volumes"][0]["emptyDir"]
        assert container["resources"]["limits"]["memory"]


def test_probes_ask_the_port_where_the_operator_listens(helm: Helm) -> None:
    manifests = helm.render({"metrics": {"port": 9000}})
    (container,) = pod_spec(manifests)["containers"]
    assert OperatorSettings.from_environment(environment(manifests)).port == 9000
    assert container["ports"] == [{"name": "metrics", "containerPort": 9000, "protocol": "TCP"}]
    probes = ("startup", "liveness", "readiness")
    paths = {probe: container[f"{probe}Probe"]["httpGet"] for probe in probes}
    assert paths == {
        "startup": {"path": "/healthz", "port": "metrics"},
        "liveness": {"path": "/healthz", "port": "metrics"},
        "readiness": {"path": "/readyz", "port": "metrics"},
    }
    assert named(manifests, "Service")["spec"]["ports"][0]["targetPort"] == "metrics"


def test_the_chart_says_no_other_settings_than_the_operator_would_choose(helm: Helm) -> None:
    """The defaults of the two are written down in two places, and agree."""
    chosen = OperatorSettings.from_environment(environment(helm.render()))
    own = OperatorSettings()
    for name in (
        "namespaces",
        "host",
        "port",
        "lease_seconds",
        "resync_seconds",
        "concurrency",
        "connections",
        "requests",
        "log_level",
        "log_format",
    ):
        assert getattr(chosen, name) == getattr(own, name)


def test_every_setting_arrives(helm: Helm) -> None:
    values = {
        "logLevel": "DEBUG",
        "logFormat": "text",
        "resyncSeconds": 30,
        "concurrency": 3,
        "connections": 5,
        "leaseSeconds": 20,
    }
    workers = {"defaultRequests": {"cpu": 0.1, "memory": ""}}
    rendered = helm.render({"operator": values, "workers": workers})
    settings = OperatorSettings.from_environment(environment(rendered))
    assert settings.requests == {"cpu": "0.1"}
    assert (settings.log_level, settings.log_format) == ("DEBUG", "text")
    assert (settings.resync_seconds, settings.lease_seconds) == (30, 20)
    assert (settings.concurrency, settings.connections) == (3, 5)


def test_the_version_is_the_projects(helm: Helm) -> None:
    assert images(helm.render()) == {f"fiber-operator:{fiber.__version__}"}


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        ({"tag": "1.2"}, "fiber-operator:1.2"),
        ({"repository": "r.example:5000/x/f", "tag": "1"}, "r.example:5000/x/f:1"),
        ({"digest": "sha256:" + "a" * 64, "tag": "1.2"}, "fiber-operator@sha256:" + "a" * 64),
    ],
)
def test_images_by_tag_and_by_digest(helm: Helm, image: dict[str, str], expected: str) -> None:
    assert images(helm.render({"image": image})) == {expected}


@pytest.mark.parametrize("image", [{}, {"digest": "sha256:" + "0" * 64}], ids=["tag", "digest"])
def test_a_chart_without_an_image_says_what_to_set(helm: Helm, image: dict[str, str]) -> None:
    with pytest.raises(Refused) as refused:
        helm.render({"image": {"repository": "", **image}})
    said = str(refused.value)
    assert "image.repository is empty" in said
    assert "development build" in said
    assert "set image.repository=REGISTRY/fiber-operator" in said


def test_the_pod_of_helm_test_has_the_placement_of_the_operator(helm: Helm) -> None:
    placement = {
        "nodeSelector": {"disk": "ssd"},
        "tolerations": [{"key": "dedicated", "operator": "Exists"}],
        "imagePullSecrets": [{"name": "registry"}],
        "affinity": {
            "nodeAffinity": {
                "requiredDuringSchedulingIgnoredDuringExecution": {
                    "nodeSelectorTerms": [
                        {"matchExpressions": [{"key": "zone", "operator": "In", "values": ["a"]}]}
                    ]
                }
            }
        },
    }
    manifests = helm.render({**placement, "priorityClassName": "high"})
    for spec in (pod_spec(manifests), named(manifests, "Pod")["spec"]):
        spec["tolerations"] = [entry for entry in spec["tolerations"] if entry not in SOON_GONE]
        assert {name: spec[name] for name in placement} == placement
    assert pod_spec(manifests)["priorityClassName"] == "high"


@pytest.mark.parametrize(
    ("tolerations", "added"),
    [
        ([], SOON_GONE),
        ([{"key": "dedicated", "operator": "Exists"}], SOON_GONE),
        ([{"key": "node.kubernetes.io/unreachable", "effect": "NoSchedule"}], SOON_GONE),
        ([{**SOON_GONE[1], "tolerationSeconds": 300}], SOON_GONE[:1]),
        ([{"key": "node.kubernetes.io/not-ready", "operator": "Exists"}], SOON_GONE[1:]),
        ([{"operator": "Exists"}], []),
    ],
)
def test_pods_leave_a_lost_node_soon_by_default(
    helm: Helm, tolerations: list[dict[str, Any]], added: list[dict[str, Any]]
) -> None:
    spec = pod_spec(helm.render({"tolerations": tolerations}))
    assert spec["tolerations"] == [*tolerations, *added]


def test_labels_follow_the_conventions(helm: Helm) -> None:
    manifests = helm.render({"commonLabels": {"team": "rl"}, "podLabels": {"mesh": "off"}})
    for manifest in manifests:
        labels = manifest["metadata"]["labels"]
        assert labels["app.kubernetes.io/instance"] == "fiber"
        assert labels["app.kubernetes.io/managed-by"] == "Helm"
        assert labels["team"] == "rl"
    deployment = named(manifests, "Deployment")["spec"]
    pod_labels = deployment["template"]["metadata"]["labels"]
    assert deployment["selector"]["matchLabels"].items() <= pod_labels.items()
    assert pod_labels["mesh"] == "off"
    test_labels = named(manifests, "Pod")["metadata"]["labels"]
    assert not deployment["selector"]["matchLabels"].items() <= test_labels.items()


@pytest.mark.parametrize(
    ("release", "expected"),
    [
        ("fiber", "fiber-fiber-operator"),
        ("fiber-operator", "fiber-operator"),
        ("x" * 53, "x" * 44),
        ("fiber.v1", "fiber-v1-fiber-operator"),
        ("1.fiber-operator", "fiber-1-fiber-operator"),
        ("9" * 53, "fiber-" + "9" * 38),
    ],
)
def test_long_release_names_give_valid_names(helm: Helm, release: str, expected: str) -> None:
    manifests = helm.render(release=release)
    assert named(manifests, "Deployment")["metadata"]["name"] == expected
    names = [str(manifest["metadata"]["name"]) for manifest in manifests]
    assert max(len(name.rpartition(":")[2]) for name in names) <= 63
    assert re.fullmatch(DNS_LABEL, str(named(manifests, "Service")["metadata"]["name"]))
    pool = json.loads(named(manifests, "Pod")["spec"]["containers"][0]["args"][0])
    assert check_pool_name(pool["metadata"]["name"])
    assert OperatorSettings.from_environment(environment(manifests)).lease == expected


def test_a_name_of_ones_own(helm: Helm) -> None:
    manifests = helm.render({"fullnameOverride": "mine", "nameOverride": "other"})
    deployment = named(manifests, "Deployment")
    assert deployment["metadata"]["name"] == "mine"
    assert deployment["spec"]["selector"]["matchLabels"]["app.kubernetes.io/name"] == "other"
