"""Whether a program that chose no backend runs its processes in pods."""

from __future__ import annotations

import contextlib

from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.api_errors import ApiError, Body
from fiber.errors import ConfigError
from fiber_api import names

_REVIEWS = "/apis/authorization.k8s.io/v1/selfsubjectaccessreviews"

_TIMEOUT = 5.0
"""Seconds that a program may wait for an answer before it goes on without a cluster."""


def may_make_pools(namespace: str | None) -> bool:
    """Whether the account of the pod that this is may make FiberPools."""
    try:
        with contextlib.closing(Api.connect()) as api:
            answer = api.create(_REVIEWS, _review(namespace or api.namespace), timeout=_TIMEOUT)
    except (ConfigError, ApiError):  # no account, no client, no answer
        return False
    return bool(answer.get("status", {}).get("allowed"))


def _review(namespace: str) -> Body:
    attributes = {
        "group": names.GROUP,
        "resource": names.PLURAL,
        "verb": "create",
        "namespace": namespace,
    }
    return {
        "apiVersion": "authorization.k8s.io/v1",
        "kind": "SelfSubjectAccessReview",
        "spec": {"resourceAttributes": attributes},
    }
