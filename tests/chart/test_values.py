"""Values: documented, typed, and refused with a sentence where they make no sense."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from chart import readme
from chart.helm import CHART, Helm, Refused

SCHEMA: dict[str, Any] = json.loads((CHART / "values.schema.json").read_text(encoding="utf-8"))
# Helm passes these to every chart that is part of another one.
OPEN = {"global"}
ALL: dict[str, Any] = {
    "scope": "namespaced",
    "namespaces": ["team-a"],
    "image": {"digest": "sha256:" + "0" * 64},
    "imagePullSecrets": [{"name": "registry"}],
    "commonLabels": {"team": "rl"},
    "serviceAccount": {"name": "own", "annotations": {"a": "b"}},
    "metrics": {
        "service": {"annotations": {"prometheus.io/scrape": "true"}},
        "serviceMonitor": {"create": True, "labels": {"release": "prometheus"}},
        "prometheusRule": {"create": True, "labels": {"release": "prometheus"}},
        "dashboard": {"create": True, "annotations": {"grafana_folder": "Fiber"}},
    },
    "networkPolicy": {
        "create": True,
        "metricsFrom": [{"namespaceSelector": {"matchLabels": {"name": "monitoring"}}}],
        "apiServer": {"cidrs": ["10.0.0.1/32"], "ports": [443]},
    },
    "priorityClassName": "system-cluster-critical",
    "nodeSelector": {"disk": "ssd"},
    "tolerations": [{"key": "dedicated", "operator": "Exists", "effect": "NoSchedule"}],
    "podLabels": {"mesh": "off"},
    "podAnnotations": {"note": "x"},
    "extraEnv": [{"name": "PYTHONASYNCIODEBUG", "value": "1"}],
}


def schemas(schema: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every schema of a value in ``schema``, with a path to find it by."""
    if "$ref" in schema:
        return
    yield path, schema
    inner = {**schema.get("properties", {}), **schema.get("definitions", {})}
    for name, property_schema in inner.items():
        yield from schemas(property_schema, f"{path}.{name}")
    for keyword in ("items", "additionalProperties"):
        if isinstance(schema.get(keyword), dict):
            yield from schemas(schema[keyword], f"{path}.{keyword}")


def test_every_value_is_typed_and_no_other_is_taken() -> None:
    for path, schema in schemas(SCHEMA):
        assert "type" in schema, path
        if schema["type"] == "object" and path.lstrip(".") not in OPEN:
            assert "additionalProperties" in schema, path
            assert schema["additionalProperties"] is not True, path


def known(schema: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """The paths of the values in the schema, as values.yaml has them."""
    for name, inner in schema["properties"].items():
        if "properties" in inner:
            yield from known(inner, f"{prefix}{name}.")
        elif name not in OPEN:
            yield prefix + name


def test_schema_values_and_readme_have_the_same_values() -> None:
    assert sorted(known(SCHEMA)) == sorted(value.path for value in readme.values())
    written = (CHART / "README.md").read_text(encoding="utf-8")
    assert written == readme.with_table(written), "run python tests/chart/readme.py"


def test_every_value_is_explained() -> None:
    assert [value.path for value in readme.values() if not value.comment.endswith(".")] == []


@pytest.mark.parametrize("values", [{}, ALL], ids=["defaults", "all"])
def test_lint_reports_no_problem(helm: Helm, values: dict[str, Any]) -> None:
    assert "0 chart(s) failed" in helm.lint(values)


def test_the_chart_renders_as_part_of_another_chart(helm: Helm) -> None:
    helm.render({"global": {"anything": {"goes": 1}}})


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"replicas": 2}, "replicas"),
        ({"scope": "node"}, "scope"),
        ({"namespaces": "team-a"}, "namespaces"),
        ({"namespaces": ["Team"], "scope": "namespaced"}, "namespaces"),
        ({"namespaces": ["a", "a"], "scope": "namespaced"}, "namespaces"),
        ({"image": {"pullPolicy": "Sometimes"}}, "pullPolicy"),
        ({"image": {"repository": "Fiber Operator"}}, "repository"),
        ({"image": {"repository": "fiber-operator:1.2"}}, "repository"),
        ({"operator": {"logLevel": "LOUD"}}, "logLevel"),
        ({"operator": {"concurrency": 0}}, "concurrency"),
        ({"metrics": {"port": 80}}, "port"),
        ({"metrics": {"serviceMonitor": {"intervalSeconds": "30s"}}}, "intervalSeconds"),
        ({"networkPolicy": {"create": True, "apiServer": {"ports": []}}}, "ports"),
        ({"networkPolicy": {"create": True, "metricsFrom": [{}]}}, "metricsFrom"),
        ({"resources": {"request": {}}}, "request"),
        ({"affinity": {"nodeAfinity": {}}}, "nodeAfinity"),
        ({"tolerations": [{"effect": "Never"}]}, "tolerations"),
        ({"nodeSelector": {"ssd": True}}, "nodeSelector"),
        ({"commonLabels": {"bad key": "x"}}, "commonLabels.*bad key"),
        ({"commonLabels": {"example.com/team": "x y"}}, "commonLabels.*team"),
        ({"podAnnotations": {"a/b/c": "x"}}, "podAnnotations.*a/b/c"),
    ],
)
def test_a_wrong_value_is_refused_by_name(helm: Helm, values: dict[str, Any], words: str) -> None:
    with pytest.raises(Refused, match=words):
        helm.render(values)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {"namespaces": ["team-a"]},
            "namespaces is set (team-a), but scope is cluster: the operator would watch every "
            "namespace. Set scope=namespaced, or leave namespaces empty.",
        ),
        (
            {"serviceAccount": {"create": False}},
            "Set serviceAccount.name to the one that you made, or let the chart create one.",
        ),
        (
            {"serviceAccount": {"create": False, "name": "own", "annotations": {"a": "b"}}},
            "Annotate it yourself, or set serviceAccount.create=true.",
        ),
        (
            {"metrics": {"service": {"create": False, "annotations": {"a": "b"}}}},
            "Set metrics.service.create=true, or leave them empty.",
        ),
        (
            {"metrics": {"serviceMonitor": {"labels": {"a": "b"}}}},
            "Set metrics.serviceMonitor.create=true, or leave them empty.",
        ),
        (
            {"metrics": {"prometheusRule": {"labels": {"a": "b"}}}},
            "Set metrics.prometheusRule.create=true, or leave them empty.",
        ),
        (
            {"metrics": {"dashboard": {"annotations": {"a": "b"}}}},
            "Set metrics.dashboard.create=true, or leave them empty.",
        ),
        (
            {"userRoles": {"create": False, "aggregate": True}},
            "userRoles.aggregate is true, but there is no ClusterRole fiber-user",
        ),
        (
            {"scope": "namespaced", "userRoles": {"aggregate": True}},
            "userRoles.aggregate is true, but there is no ClusterRole fiber-user",
        ),
        (
            {"resources": {"limits": {"memory": "0.1Gi"}}},
            "resources.limits.memory is 0.1Gi, but resources.requests.memory is 128Mi",
        ),
        (
            {"resources": {"requests": {"cpu": 1}, "limits": {"cpu": "999m"}}},
            "resources.limits.cpu is 999m, but resources.requests.cpu is 1",
        ),
        (
            {"extraEnv": [{"name": "https_proxy", "value": "http://proxy:3128"}]},
            "extraEnv sets https_proxy: the operator calls only the API server",
        ),
        (
            {"extraEnv": [{"name": "A", "value": ""}, {"name": "A", "value": "1"}]},
            "extraEnv sets A twice",
        ),
        (
            {"metrics": {"service": {"create": False}, "serviceMonitor": {"create": True}}},
            "Set metrics.service.create=true, or metrics.serviceMonitor.create=false.",
        ),
        (
            {"metrics": {"prometheusRule": {"create": True}}},
            "Set metrics.serviceMonitor.create=true, or metrics.prometheusRule.create=false.",
        ),
        (
            {"metrics": {"serviceMonitor": {"timeoutSeconds": 60}}},
            "metrics.serviceMonitor.timeoutSeconds is 60, but intervalSeconds is 30",
        ),
        (
            {"networkPolicy": {"apiServer": {"cidrs": ["10.0.0.1/32"]}}},
            "Set networkPolicy.create=true, or leave them empty.",
        ),
        (
            {"podLabels": {"app.kubernetes.io/name": "x"}},
            "podLabels sets app.kubernetes.io/name: the chart sets that label itself",
        ),
        (
            {"extraEnv": [{"name": "FIBER_OPERATOR_NAMESPACES", "value": "x"}]},
            "extraEnv sets FIBER_OPERATOR_NAMESPACES",
        ),
    ],
)
def test_a_contradiction_is_refused_with_a_sentence(
    helm: Helm, values: dict[str, Any], words: str
) -> None:
    with pytest.raises(Refused) as refused:
        helm.render(values)
    assert words in str(refused.value)


@pytest.mark.parametrize(
    ("asked", "limit"),
    [("50m", "0.05"), ("128Mi", "1e9"), (1, 1), ("1k", "1Ki"), (0.5, "500m"), ("1G", "1Gi")],
)
def test_a_limit_may_equal_or_exceed_the_request(helm: Helm, asked: Any, limit: Any) -> None:
    helm.render({"resources": {"requests": {"x": asked}, "limits": {"x": limit}}})


def test_all_contradictions_are_reported_at_once(helm: Helm) -> None:
    values = {"namespaces": ["a"], "serviceAccount": {"create": False}}
    with pytest.raises(Refused, match=r"(?s)namespaces is set.*serviceAccount\.create is false"):
        helm.render(values)
