"""Hashes of what a user asks for: they tell when pods are outdated, and when to try again."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from fiber_api.v1alpha1 import FiberPool

_LENGTH = 16
"""Hexadecimal digits; few enough for a label and enough for the revisions of one pool."""


def template_hash(pool: FiberPool) -> str:
    """Return a hash of the worker: of the template, and of the number of processes in each.

    Nothing that the operator adds is in it, so that a new operator replaces no pod, and nothing
    that the SDK writes.
    """
    return _digest({"template": pool.spec.template, "processes": pool.spec.processes_per_pod})


def spec_hash(pool: FiberPool) -> str:
    """Return a hash of all that a user or a new master changes to revive a failed pool.

    ``replicas`` and ``release`` are not in it: the SDK writes them all the time.
    """
    spec = pool.spec
    return _digest(
        {
            "template": spec.template,
            "processes": spec.processes_per_pod,
            "container": spec.worker_container,
            "failures": spec.failure_policy.model_dump(),
            "update": spec.update.model_dump(),
            "suspend": spec.suspend,
            "epoch": spec.master.epoch if spec.master else None,
        }
    )


def _digest(document: dict[str, Any]) -> str:
    canonical = json.dumps(document, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()[:_LENGTH]
