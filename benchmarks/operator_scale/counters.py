"""Prometheus' pages: their counters, and by how much these grew. Arithmetic on text."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping

_SAMPLE = re.compile(r"^(\w+)(?:\{(.*)\})? (\S+)$")
_LABEL = re.compile(r'(\w+)="((?:[^"\\]|\\.)*)"')
_OPERATOR_REQUESTS = "fiber_operator_api_requests_total"
_SERVER_REQUESTS = "apiserver_request_total"
_WRITES = {"POST", "PUT", "PATCH", "DELETE", "DELETECOLLECTION", "APPLY"}
# Objects that nodes and components write all the time, independent of the pods.
_HEARTBEATS = {"leases", "nodes"}

STATUS_WRITES = "patch fiberpools/status"

Counts = Mapping[str, float]


def samples(page: str, name: str) -> Iterator[tuple[dict[str, str], float]]:
    """Yield labels and value of each sample of a metric."""
    for line in page.splitlines():
        if line.startswith(name) and (found := _SAMPLE.match(line)) and found[1] == name:
            yield dict(_LABEL.findall(found[2] or "")), float(found[3])


def value(page: str, name: str) -> float:
    """Return the one value of a metric without labels. Raises KeyError if there is none."""
    for _, number in samples(page, name):
        return number
    raise KeyError(name)


def operator_requests(page: str) -> Counts:
    """Return the operator's own requests, as "verb resource"."""
    counts: defaultdict[str, float] = defaultdict(float)
    for labels, number in samples(page, _OPERATOR_REQUESTS):
        counts[f"{labels['verb']} {labels['resource']}"] += number
    return counts


def server_writes(page: str) -> Counts:
    """Return all writes of all clients at the API server, as "VERB resource"."""
    counts: defaultdict[str, float] = defaultdict(float)
    for labels, number in samples(page, _SERVER_REQUESTS):
        if labels["verb"] in _WRITES and labels["resource"] not in _HEARTBEATS:
            part = f"/{labels['subresource']}" if labels.get("subresource") else ""
            counts[f"{labels['verb']} {labels['resource']}{part}"] += number
    return counts


def growth(before: Counts, after: Counts) -> dict[str, float]:
    """Return the growth of each counter, the largest first; counters that did not grow are left
    out."""
    grown = {key: number - before.get(key, 0) for key, number in after.items()}
    ordered = sorted(grown.items(), key=lambda found: (-found[1], found[0]))
    return {key: number for key, number in ordered if number > 0}
