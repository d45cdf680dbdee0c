"""Manifests that break a rule, and the words that the refusal must have.

Two readers refuse them: the models here, and a real API server in ``tests/e2e``.  A change maps
paths to new values, ``ABSENT`` for a field to leave out.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

ABSENT: Final = object()

GOOD: Final[dict[str, Any]] = {
    "apiVersion": "fiber.dev/v1alpha1",
    "kind": "FiberPool",
    "metadata": {"name": "es"},
    "spec": {
        "minReplicas": 0,
        "maxReplicas": 2,
        "template": {"spec": {"containers": [{"name": "worker", "image": "fiber-worker:0"}]}},
    },
}

MASTER: Final = {"host": "10.0.3.7", "port": 41337, "epoch": 3, "identity": "laptop-7:4711"}


@dataclass(frozen=True)
class Bad:
    """Manifest to be refused."""

    name: str
    change: Mapping[str, Any]
    words: tuple[str, ...]
    """Words of kubectl's message: the field, and for a rule of Fiber the remedy."""

    def manifest(self) -> dict[str, Any]:
        return changed(GOOD, self.change)


@dataclass(frozen=True)
class BadUpdate:
    """A valid manifest, and a change that only a rule with access to the old object can refuse."""

    name: str
    before: Mapping[str, Any]
    change: Mapping[str, Any]
    words: tuple[str, ...]

    def first(self) -> dict[str, Any]:
        return changed(GOOD, self.before)

    def second(self) -> dict[str, Any]:
        return changed(self.first(), self.change)


BAD = (
    Bad("no template", {"spec.template": ABSENT}, ("spec.template",)),
    Bad("no spec", {"spec": ABSENT}, ("spec",)),
    Bad(
        "no container",
        {"spec.template.spec.containers": []},
        ("spec.template.spec.containers", "at least 1 item"),
    ),
    Bad(
        "container without a name",
        {"spec.template.spec.containers[0].name": ABSENT},
        ("spec.template.spec.containers[0].name",),
    ),
    Bad(
        "no worker among the containers",
        {"spec.template.spec.containers[0].name": "main"},
        ("spec.workerContainer", "must be the name of a container", "write its name here"),
    ),
    Bad(
        "worker container by another name",
        {"spec.workerContainer": "agent"},
        ("spec.workerContainer", "must be the name of a container", "write its name here"),
    ),
    Bad(
        "restart policy",
        {"spec.template.spec.restartPolicy": "Always"},
        ("spec.template.spec.restartPolicy", "must be Never", "Leave the field out"),
    ),
    Bad(
        "minimum above maximum",
        {"spec.minReplicas": 3},
        ("spec.minReplicas", "must not be above spec.maxReplicas", "raise the other"),
    ),
    Bad(
        "a budget that no drain can keep",
        {"spec.minAvailable": 2, "spec.minReplicas": 2},
        ("spec.minAvailable", "must be below spec.minReplicas", "raise the other"),
    ),
    Bad(
        "negative replicas", {"spec.replicas": -1}, ("spec.replicas", "greater than or equal to 0")
    ),
    Bad("replicas in quotes", {"spec.replicas": "3"}, ("spec.replicas", "integer")),
    Bad("no maximum", {"spec.maxReplicas": 0}, ("spec.maxReplicas", "greater than or equal to 1")),
    Bad("no processes", {"spec.processesPerPod": 0}, ("spec.processesPerPod",)),
    Bad("suspend in words", {"spec.suspend": "yes"}, ("spec.suspend", "boolean")),
    Bad(
        "name too long",
        {"metadata.name": "e" * 51},
        ("metadata.name", "at most 50 characters", "Use a shorter name"),
    ),
    Bad(
        "name that no Service can have",
        {"metadata.name": "3d.walkers"},
        ("metadata.name", "begin with a letter", "Use another name"),
    ),
    Bad(
        "master by name",
        {"spec.master": {**MASTER, "host": "master.example.com"}},
        ("spec.master.host", "must be an IP address", "Write the address"),
    ),
    Bad(
        "master on loopback",
        {"spec.master": {**MASTER, "host": "127.0.0.1"}},
        ("spec.master.host", "must be an IP address that the pods can reach"),
    ),
    Bad("port 0", {"spec.master": {**MASTER, "port": 0}}, ("spec.master.port",)),
    Bad(
        "master without an epoch",
        {"spec.master": {"host": "10.0.3.7", "port": 1, "identity": "a"}},
        ("spec.master.epoch",),
    ),
    Bad(
        "master without an identity",
        {"spec.master": {"host": "10.0.3.7", "port": 1, "epoch": 1}},
        ("spec.master.identity",),
    ),
    Bad(
        "master whose identity is empty",
        {"spec.master": {**MASTER, "identity": ""}},
        ("spec.master.identity", "at least 1"),
    ),
    Bad(
        "lease that expires at once",
        {"spec.master": {**MASTER, "leaseDurationSeconds": 1}},
        ("spec.master.leaseDurationSeconds", "greater than or equal to 5"),
    ),
    Bad("lease name", {"spec.master": {**MASTER, "leaseName": "A b"}}, ("spec.master.leaseName",)),
    Bad(
        "unknown onLost",
        {"spec.onLost": "Explode"},
        ("spec.onLost", "Delete", "ScaleToMin", "Retain"),
    ),
    Bad("idle for no time", {"spec.idle": {"timeoutSeconds": 0}}, ("spec.idle.timeoutSeconds",)),
    Bad("idle for how long", {"spec.idle": {}}, ("spec.idle.timeoutSeconds",)),
    Bad("name of a Secret", {"spec.credentialsSecretName": "A b"}, ("credentialsSecretName",)),
    Bad(
        "unknown policy",
        {"spec.scaleDown": {"policy": "Some"}},
        ("spec.scaleDown.policy", "ReleasedOnly", "Any"),
    ),
    Bad(
        "too many released",
        {"spec.scaleDown": {"release": [f"es-{number:010x}" for number in range(501)]}},
        ("spec.scaleDown.release", "at most 500 items"),
    ),
    Bad(
        "unknown strategy",
        {"spec.update": {"strategy": "Rolling"}},
        ("spec.update.strategy", "OnIdle", "Recreate", "OnDelete"),
    ),
    Bad("nothing in flight", {"spec.scaleUp": {"maxInFlight": 0}}, ("spec.scaleUp.maxInFlight",)),
    Bad(
        "back-off upside down",
        {"spec.failurePolicy": {"backoffBaseSeconds": 10, "backoffMaxSeconds": 5}},
        ("spec.failurePolicy.backoffBaseSeconds", "must not be above backoffMaxSeconds"),
    ),
    Bad("negative limit", {"spec.failurePolicy": {"backoffLimit": -1}}, ("backoffLimit",)),
)

BAD_UPDATES = (
    BadUpdate(
        "worker container changed",
        {"spec.template.spec.containers": [{"name": "worker"}, {"name": "other"}]},
        {"spec.workerContainer": "other"},
        ("spec.workerContainer", "cannot be changed", "Make a new FiberPool"),
    ),
    BadUpdate(
        "epoch falls",
        {"spec.master": MASTER},
        {"spec.master.epoch": 2},
        ("spec.master.epoch", "must never fall", "an epoch above the one that is there"),
    ),
    *(
        BadUpdate(
            f"{field} changed and not the epoch",
            {"spec.master": {**MASTER, "leaseName": "fiber-es"}},
            {f"spec.master.{field}": value},
            ("spec.master.epoch", "must rise where", "Take an epoch above"),
        )
        for field, value in {
            "host": "10.0.3.8",
            "port": 5000,
            "identity": "laptop-8:12",
            "leaseName": "another",
        }.items()
    ),
    BadUpdate(
        "lease given up and not the epoch",
        {"spec.master": {**MASTER, "leaseName": "fiber-es"}},
        {"spec.master.leaseName": ABSENT},
        ("spec.master.epoch", "must rise where"),
    ),
    BadUpdate(
        "other credentials",
        {"spec.credentialsSecretName": "mine"},
        {"spec.credentialsSecretName": "other"},
        ("spec.credentialsSecretName", "cannot be changed", "Make a new FiberPool"),
    ),
    BadUpdate(
        "credentials of its own",
        {},
        {"spec.credentialsSecretName": "other"},
        ("spec.credentialsSecretName", "cannot be changed"),
    ),
)

DUPLICATE_RELEASE = Bad(
    "released twice", {"spec.scaleDown": {"release": ["es-1", "es-1"]}}, ("spec.scaleDown.release",)
)
"""Refused by the API server alone, for which the list is a set; here it does no harm."""


def changed(document: dict[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of ``document`` with ``change`` made to it."""
    result = copy.deepcopy(document)
    for path, value in change.items():
        *parents, last = keys_of(path)
        place: Any = result
        for key in parents:
            place = place[key]
        if value is ABSENT:
            del place[last]
        else:
            place[last] = copy.deepcopy(value)
    return result


def keys_of(path: str) -> list[str | int]:
    """``a.b[0].c`` as ``["a", "b", 0, "c"]``."""
    return [int(key) if key.isdigit() else key for key in re.findall(r"[^.\[\]]+", path)]
