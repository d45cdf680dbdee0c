"""Alerts and panels ask for metrics and labels that the operator exports."""

from __future__ import annotations

import dataclasses
import functools
import json
import re
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest
from prometheus_client.core import Metric
from prometheus_client.parser import text_string_to_metric_families

from chart.helm import CHART, NAMESPACE, Helm, Manifest, kinds, named
from fiber._runtime import metrics as program
from fiber_operator.metrics import Metrics, PoolSample
from fiber_operator.workqueue import Key, QueueStatistics

ON: dict[str, Any] = {
    "metrics": {
        "serviceMonitor": {"create": True, "labels": {"release": "prometheus"}},
        "prometheusRule": {"create": True},
        "dashboard": {"create": True},
    }
}
# Labels and metrics that Prometheus adds.
TARGET_LABELS = {"namespace", "job", "instance", "le"}


@functools.cache
def exported() -> dict[str, set[str]]:
    """Each series that an operator exports, with its labels."""
    metrics = Metrics()
    empty = QueueStatistics(**{field.name: 0 for field in dataclasses.fields(QueueStatistics)})
    metrics.watch_queue(lambda: empty, lambda: True)
    metrics.pools[Key("ns", "a")] = PoolSample(1, {"ready": 1}, {"Unschedulable": 1}, 1, 1)
    metrics.reconciled("ok", 0.1)
    metrics.requested("get", "pods", "200", 0.1)
    metrics.created(1)
    metrics.deleted("Released")
    metrics.watched("pods")
    metrics.watch_restarted()
    return series_of(text_string_to_metric_families(metrics.render().decode()))


@functools.cache
def exported_by_programs() -> dict[str, set[str]]:
    """Each series that a program exports, with its labels."""
    sample = program.ProgramSample(
        dict.fromkeys(program._TOTALS, 1),
        dict.fromkeys(program._GAUGES, 1),
        dict.fromkeys(program.STATES, 1),
        [("work", 1, 1, 1.0)],
    )
    return series_of(program.metrics_of(sample, {"backend": "local"}))


def series_of(families: Iterable[Metric]) -> dict[str, set[str]]:
    series: dict[str, set[str]] = {}
    for family in families:
        for sample in family.samples:
            series.setdefault(sample.name, set()).update(sample.labels)
    return series


DASHBOARDS = [("dashboard.json", exported), ("program-dashboard.json", exported_by_programs)]
each_dashboard = pytest.mark.parametrize(
    ("name", "exporter"), DASHBOARDS, ids=["operator", "program"]
)
Exporter = Callable[[], dict[str, set[str]]]


def dashboard(name: str) -> dict[str, Any]:
    text = (CHART / "files" / name).read_text(encoding="utf-8")
    document: dict[str, Any] = json.loads(text)
    return document


def queries(name: str) -> list[str]:
    """Every query of every panel."""
    panels = [panel for panel in dashboard(name)["panels"] if panel["type"] != "row"]
    return [target["expr"] for panel in panels for target in panel["targets"]]


def alerts(manifests: list[Manifest]) -> dict[str, dict[str, Any]]:
    (group,) = named(manifests, "PrometheusRule")["spec"]["groups"]
    return {rule["alert"]: rule for rule in group["rules"]}


def asked(query: str) -> Iterator[tuple[str, str]]:
    """The series of a query, each with the text of its selector."""
    for found in re.finditer(r"\b((?:fiber|process)_\w+)(\{[^}]*\})?", query):
        yield found[1], found[2] or ""


def labels(query: str) -> set[str]:
    """The labels that a query selects or groups by."""
    grouped = re.findall(r"(?:by|on) \(([^)]*)\)", query)
    selected = re.findall(r"(\w+)(?:=~|!~|!=|=)\"", query)
    return {label.strip() for group in grouped for label in group.split(",")} | set(selected)


def check(query: str, series: dict[str, set[str]]) -> None:
    """The series and labels of the query exist."""
    found = [name for name, _ in asked(query)]
    assert found, query
    assert set(found) <= series.keys(), query
    assert labels(query) <= set().union(*(series[name] for name in found)) | TARGET_LABELS, query


@each_dashboard
def test_panels_query_exported_metrics(name: str, exporter: Exporter) -> None:
    for query in queries(name):
        check(query, exporter())


@each_dashboard
def test_everything_that_is_exported_has_a_panel(name: str, exporter: Exporter) -> None:
    shown = {found.removesuffix("_bucket") for query in queries(name) for found, _ in asked(query)}
    # The client adds to each counter when it began.
    ours = {found for found in exporter() if re.match(r"fiber_(?!.*_created$)", found)}
    suffix = re.compile(r"_(bucket|sum|count)$")
    assert {suffix.sub("", name) for name in ours} - shown == set()


@each_dashboard
def test_panels_are_laid_out_and_numbered(name: str, exporter: Exporter) -> None:
    panels = dashboard(name)["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    cells = [
        (x, y)
        for panel in panels
        for x in range(panel["gridPos"]["x"], panel["gridPos"]["x"] + panel["gridPos"]["w"])
        for y in range(panel["gridPos"]["y"], panel["gridPos"]["y"] + panel["gridPos"]["h"])
    ]
    assert len(set(cells)) == len(cells)
    assert max(x for x, _ in cells) < 24
    assert all(panel.get("description") for panel in panels if panel["type"] != "row")


def test_programs_and_the_operator_share_no_metric() -> None:
    assert exported().keys().isdisjoint(exported_by_programs())


def test_the_config_map_holds_the_dashboards(helm: Helm) -> None:
    config = named(helm.render(ON), "ConfigMap")
    assert config["metadata"]["labels"]["grafana_dashboard"] == "1"
    assert json.loads(config["data"]["fiber-operator.json"]) == dashboard("dashboard.json")
    assert json.loads(config["data"]["fiber-program.json"]) == dashboard("program-dashboard.json")


def test_alerts_query_exported_metrics(helm: Helm) -> None:
    for rule in alerts(helm.render(ON)).values():
        check(rule["expr"], exported())


def test_alerts_look_where_the_service_monitor_puts_the_metrics(helm: Helm) -> None:
    manifests = helm.render(ON)
    job = named(manifests, "Service")["metadata"]["name"]
    for rule in alerts(manifests).values():
        assert all(f'job="{job}"' in selector for _, selector in asked(rule["expr"]))
    down = alerts(manifests)["FiberOperatorDown"]["expr"]
    selector = f'namespace="{NAMESPACE}",job="{job}"'
    assert down == f"absent(fiber_operator_lease_held{{{selector}}} == 1)"


def test_alerts_name_a_remedy_and_are_explained(helm: Helm) -> None:
    readme = (CHART / "README.md").read_text(encoding="utf-8")
    for name, rule in alerts(helm.render(ON)).items():
        assert "kubectl --namespace" in rule["annotations"]["description"]
        assert rule["labels"]["severity"] in ("warning", "critical")
        assert rule["for"]
        assert f"`{name}`" in readme


def test_the_pool_alert_names_the_pool(helm: Helm) -> None:
    rule = alerts(helm.render(ON))["FiberPoolDegraded"]
    assert (
        "{{ $labels.namespace }} describe fiberpool {{ $labels.pool }}"
        in (rule["annotations"]["description"])
    )


def test_the_service_monitor_finds_the_service(helm: Helm) -> None:
    manifests = helm.render(ON)
    monitor = named(manifests, "ServiceMonitor")
    service = named(manifests, "Service")
    assert monitor["metadata"]["labels"]["release"] == "prometheus"
    wanted = monitor["spec"]["selector"]["matchLabels"].items()
    assert wanted <= service["metadata"]["labels"].items()
    (endpoint,) = monitor["spec"]["endpoints"]
    assert endpoint["port"] == service["spec"]["ports"][0]["name"]
    assert endpoint["honorLabels"] is True


def test_the_service_finds_the_operator_and_not_the_test(helm: Helm) -> None:
    manifests = helm.render()
    selector = named(manifests, "Service")["spec"]["selector"].items()
    operator = named(manifests, "Deployment")["spec"]["template"]["metadata"]["labels"]
    assert selector <= operator.items()
    assert not selector <= named(manifests, "Pod")["metadata"]["labels"].items()


def test_monitoring_is_rendered_only_on_request(helm: Helm) -> None:
    usual = kinds(helm.render())
    assert set(usual).isdisjoint({"ServiceMonitor", "PrometheusRule", "ConfigMap"})
    assert "Service" not in kinds(helm.render({"metrics": {"service": {"create": False}}}))


@pytest.mark.parametrize("peers", [[], [{"podSelector": {"matchLabels": {"app": "prometheus"}}}]])
def test_the_network_policy_allows_only_the_operators_traffic(
    helm: Helm, peers: list[dict[str, Any]]
) -> None:
    api = {"cidrs": ["10.0.0.1/32"], "ports": [6443]}
    values = {"networkPolicy": {"create": True, "metricsFrom": peers, "apiServer": api}}
    manifests = helm.render(values)
    spec = named(manifests, "NetworkPolicy")["spec"]
    operator = named(manifests, "Deployment")["spec"]["template"]["metadata"]["labels"]
    assert spec["podSelector"]["matchLabels"].items() <= operator.items()
    assert sorted(spec["policyTypes"]) == ["Egress", "Ingress"]
    (incoming,) = spec["ingress"]
    assert incoming["ports"] == [{"port": "metrics", "protocol": "TCP"}]
    assert incoming.get("from", []) == peers
    to_api, to_dns = spec["egress"]
    assert to_api == {
        "ports": [{"port": 6443, "protocol": "TCP"}],
        "to": [{"ipBlock": {"cidr": "10.0.0.1/32"}}],
    }
    assert {entry["port"] for entry in to_dns["ports"]} == {53}
