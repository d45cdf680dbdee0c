"""Choice of a backend for a program that chose none: pods or this machine."""

from __future__ import annotations

import contextlib
import logging
import time

from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.api_errors import ApiError, Body, NotFound
from fiber._backends.kubernetes.resources import LEASES, POOLS
from fiber.errors import ConfigError
from fiber_api import names
from fiber_api.times import parse_time

_REVIEWS = "/apis/authorization.k8s.io/v1/selfsubjectaccessreviews"

_TIMEOUT = 5.0
"""Seconds that a program may wait for an answer before it goes on without a cluster."""


def serves_pools(namespace: str | None) -> bool:
    """Return whether this pod's account may make FiberPools that somebody serves.

    A right without FiberPools, or without an operator, is told by one warning.
    """
    try:
        with contextlib.closing(Api.connect()) as api:
            return _serves(api, namespace or api.namespace)
    except (ConfigError, ApiError):  # no account, no client, no answer
        return False


def _serves(api: Api, namespace: str) -> bool:
    answer = api.create(_REVIEWS, _review(namespace), timeout=_TIMEOUT)
    if not answer.get("status", {}).get("allowed"):
        return False
    try:
        api.get(f"/apis/{names.API_VERSION}", timeout=_TIMEOUT)
    except NotFound:
        return _on_this_machine("the cluster knows no FiberPools. Install the operator's chart")
    if _has_expired(_claim(api, namespace)) and _has_pools(api, namespace):
        return _on_this_machine(
            f"the operator that served the namespace {namespace!r} is gone. Start it again"
        )
    return True


def _on_this_machine(why: str) -> bool:
    logging.getLogger("fiber").warning(
        "processes run on this machine and not in pods: %s, or set backend='local' "
        "(FIBER_BACKEND=local) to have no such warning",
        why,
    )
    return False


def _claim(api: Api, namespace: str) -> Body:
    """Return the Lease of the operator in the namespace; empty where it cannot be read."""
    try:
        lease = api.get(LEASES.path(namespace, names.CRD_NAME), timeout=_TIMEOUT)
    except ApiError:
        return {}  # an operator claims a namespace when it sees the first pool there
    return lease.get("spec") or {}


def _has_expired(claim: Body) -> bool:
    """Return whether the operator neither renewed its Lease nor gave it back."""
    if not claim.get("holderIdentity"):
        return False
    try:
        renewed = parse_time(str(claim.get("renewTime")))
    except ValueError:
        return False
    return renewed + int(claim.get("leaseDurationSeconds") or 0) < time.time()


def _has_pools(api: Api, namespace: str) -> bool:
    """Return whether the namespace has FiberPools; False where they cannot be listed.

    An operator gives up a namespace without pools, and leaves its Lease to expire.
    """
    try:
        found = api.list(POOLS.path(namespace), {"limit": "1"}, timeout=_TIMEOUT)
    except ApiError:
        return False
    return bool(found.get("items"))


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
