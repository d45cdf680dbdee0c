"""Room for one more worker: quotas, limit ranges and nodes.  Pure functions over documents."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from decimal import Decimal
from typing import Any, NamedTuple

from fiber.resources import GPU
from fiber_api import names
from fiber_api.rest import Body

_UNITS = {
    "n": Decimal("1e-9"),
    "u": Decimal("1e-6"),
    "m": Decimal("1e-3"),
    "": Decimal(1),
    **{unit: Decimal(1000) ** power for power, unit in enumerate("kMGTPE", 1)},
    **{f"{unit}i": Decimal(1024) ** power for power, unit in enumerate("KMGTPE", 1)},
}
_QUANTITY = re.compile(r"([+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?)([numkKMGTPE]?i?)")

Amounts = dict[str, Decimal]


def amount(text: object) -> Decimal:
    """Return a quantity of Kubernetes, such as ``500m`` or ``2Gi``; 0 if it is none."""
    found = _QUANTITY.fullmatch(str(text))
    if found is None or found[2] not in _UNITS:
        return Decimal(0)
    return Decimal(found[1]) * _UNITS[found[2]]


class Container(NamedTuple):
    """Resources of one container."""

    requests: Amounts
    limits: Amounts


def containers_of(pod: Body, ranges: Iterable[Body] = ()) -> list[Container]:
    """Return the containers of a pod or a template, with the defaults of LimitRanges."""
    found = [_container(each) for each in (pod.get("spec") or {}).get("containers") or ()]
    for item in _items(ranges, "Container"):
        for container in found:
            for name, value in (item.get("default") or {}).items():
                container.limits.setdefault(name, amount(value))
            for name, value in (item.get("defaultRequest") or {}).items():
                container.requests.setdefault(name, amount(value))
    return found


def _container(body: Body) -> Container:
    resources = body.get("resources") or {}
    limits = {name: amount(value) for name, value in (resources.get("limits") or {}).items()}
    requests = {name: amount(value) for name, value in (resources.get("requests") or {}).items()}
    return Container({**limits, **requests}, limits)  # a limit without a request is also that


def total(each: Iterable[Mapping[str, Decimal]]) -> Amounts:
    """Return the sums by resource."""
    sums: Amounts = defaultdict(Decimal)
    for amounts in each:
        for name, value in amounts.items():
            sums[name] += value
    return dict(sums)


def requests_of(pod: Body, ranges: Iterable[Body] = ()) -> Amounts:
    """Return what a pod requests of its node."""
    return total(container.requests for container in containers_of(pod, ranges))


# ---- quotas ---------------------------------------------------------------------------------


_OBJECTS: Mapping[str, Decimal] = {
    name: Decimal(1)
    for name in (
        "pods",
        "secrets",
        "services",
        "count/pods",
        "count/secrets",
        "count/services",
        f"count/{names.CRD_NAME}",
        "count/leases.coordination.k8s.io",
    )
}
"""Objects that a FiberPool of one worker makes."""

_OF_PODS = re.compile("cpu|memory|(requests|limits)[.].+")


def refusing_quota(quotas: Iterable[Body], template: Body, ranges: Iterable[Body]) -> str:
    """Return why a quota refuses a worker; empty if none does.  Quotas with scopes are left out."""
    wanted = _charges(template, ranges)
    for quota in quotas:
        spec, status = quota.get("spec") or {}, quota.get("status") or {}
        if spec.get("scopes") or spec.get("scopeSelector"):
            continue
        hard, used = status.get("hard") or spec.get("hard") or {}, status.get("used") or {}
        for name, limit in hard.items():
            why = _refusal(str(name), limit, used.get(name, 0), wanted)
            if why:
                return f"the ResourceQuota {quota['metadata']['name']!r} {why}"
    return ""


def _charges(template: Body, ranges: Iterable[Body]) -> Amounts:
    each = containers_of(template, ranges)
    requests, limits = total(c.requests for c in each), total(c.limits for c in each)
    plain = {name: value for name, value in requests.items() if name in ("cpu", "memory")}
    return {
        **_OBJECTS,
        **plain,
        **{f"requests.{name}": value for name, value in requests.items()},
        **{f"limits.{name}": value for name, value in limits.items()},
    }


def _refusal(name: str, limit: object, used: object, wanted: Amounts) -> str:
    if name not in wanted:
        # A quota on an extended resource concerns only pods that ask for it.
        counts = _OF_PODS.fullmatch(name) and re.search("(cpu|memory)$", name)
        return f"counts {name}, which a worker does not set" if counts else ""
    if amount(used) + wanted[name] <= amount(limit):
        return ""
    return f"is full: {used} of {limit} {name} are used, and a worker needs {_short(wanted[name])}"


def _short(value: Decimal) -> str:
    return f"{value.normalize():f}"


# ---- limit ranges ---------------------------------------------------------------------------


def refusing_range(ranges: Iterable[Body], template: Body) -> str:
    """Return why a LimitRange refuses a worker; empty if none does."""
    ranges = list(ranges)
    each = containers_of(template, ranges)
    whole = Container(total(c.requests for c in each), total(c.limits for c in each))
    for container in each:
        for name, limit in container.limits.items():
            if container.requests.get(name, Decimal(0)) > limit:
                return f"a worker requests more {name} than the default limit, {_short(limit)}"
    for found in ranges:
        for kind, checked in (("Container", each), ("Pod", [whole])):
            for item in _items([found], kind):
                why = next(filter(None, (_outside(item, one) for one in checked)), "")
                if why:
                    return f"the LimitRange {found['metadata']['name']!r} {why}"
    return ""


def _outside(item: Body, container: Container) -> str:
    """Return in which way a container is outside of the bounds."""
    for name, bound in (item.get("max") or {}).items():
        asked = container.limits.get(name, container.requests.get(name))
        if asked is not None and asked > amount(bound):
            return f"allows {bound} {name}, and a worker has {_short(asked)}"
    for name, bound in (item.get("min") or {}).items():
        asked = container.requests.get(name)
        if asked is not None and asked < amount(bound):
            return f"wants at least {bound} {name}, and a worker requests {_short(asked)}"
    return ""


def _items(ranges: Iterable[Body], kind: str) -> Iterator[Body]:
    for found in ranges:
        for item in (found.get("spec") or {}).get("limits") or ():
            if item.get("type") == kind:
                yield item


# ---- nodes ----------------------------------------------------------------------------------


class Room(NamedTuple):
    """Room of the nodes for one worker."""

    nodes: int
    fit: int
    """Nodes that have room."""
    gpus: Decimal
    free_gpus: Decimal
    why: str
    """Reasons of the nodes that have none."""


def room(nodes: Iterable[Body], pods: Iterable[Body], template: Body, ranges: list[Body]) -> Room:
    """Return which nodes have room for a worker.  Affinities are left out."""
    used: dict[str, list[Body]] = defaultdict(list)
    for pod in pods:
        if (pod.get("status") or {}).get("phase") not in ("Succeeded", "Failed"):
            used[str((pod.get("spec") or {}).get("nodeName"))].append(pod)
    wanted = requests_of(template, ranges)
    reasons: dict[str, int] = defaultdict(int)
    number = fit = 0
    gpus = free_gpus = Decimal(0)
    for node in nodes:
        free = _free(node, used[str(node["metadata"]["name"])])
        number += 1
        gpus += amount(((node.get("status") or {}).get("allocatable") or {}).get(GPU, 0))
        free_gpus += free.get(GPU, Decimal(0))
        why = _keeps_out(node, template) or _lacks(free, wanted)
        fit += not why
        if why:
            reasons[why] += 1
    said = ", ".join(f"{count} {why}" for why, count in reasons.items())
    return Room(number, fit, gpus, free_gpus, said)


def _free(node: Body, pods: list[Body]) -> Amounts:
    status = node.get("status") or {}
    free = {name: amount(value) for name, value in (status.get("allocatable") or {}).items()}
    taken = total(requests_of(pod) for pod in pods)
    taken["pods"] = Decimal(len(pods))
    return {name: value - taken.get(name, Decimal(0)) for name, value in free.items()}


def _lacks(free: Amounts, wanted: Amounts) -> str:
    if free.get("pods", Decimal(1)) < 1:
        return "may have no more pods"
    for name, value in wanted.items():
        if value and free.get(name, Decimal(0)) < value:
            return f"lack {name}"
    return ""


def _keeps_out(node: Body, template: Body) -> str:
    """Return why a node takes no such pod, even with room."""
    spec, status = node.get("spec") or {}, node.get("status") or {}
    pod = template.get("spec") or {}
    ready = {c.get("type"): c.get("status") for c in status.get("conditions") or ()}
    if ready.get("Ready", "True") != "True":
        return "are not ready"
    if spec.get("unschedulable"):
        return "are cordoned"
    labels = node["metadata"].get("labels") or {}
    if any(labels.get(name) != value for name, value in (pod.get("nodeSelector") or {}).items()):
        return "do not have the labels of the node selector"
    for taint in spec.get("taints") or ():
        tolerated = any(_tolerates(each, taint) for each in pod.get("tolerations") or ())
        if taint.get("effect") in ("NoSchedule", "NoExecute") and not tolerated:
            return f"have the taint {taint.get('key')}"
    return ""


def _tolerates(toleration: Mapping[str, Any], taint: Mapping[str, Any]) -> bool:
    if toleration.get("effect") not in (None, "", taint.get("effect")):
        return False
    if toleration.get("operator", "Equal") == "Exists":
        return toleration.get("key") in (None, "", taint.get("key"))
    same = toleration.get("key") == taint.get("key")
    return same and (toleration.get("value") or "") == (taint.get("value") or "")
