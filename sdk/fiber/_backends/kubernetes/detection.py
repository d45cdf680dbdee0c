"""Choice of a backend for a program that chose none: pods or this machine."""

from __future__ import annotations

import contextlib
import logging
import time

from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.api_errors import ApiError, Body, NotFound
from fiber._backends.kubernetes.resources import POOLS
from fiber.errors import ConfigError
from fiber_api import names
from fiber_api.times import parse_time

_REVIEWS = "/apis/authorization.k8s.io/v1/selfsubjectaccessreviews"

_TIMEOUT = 5.0
"""Seconds that a program may wait for an answer before it goes on without a cluster."""
_PATIENCE = 60.0
"""Seconds in which an operator reports on a new pool.  Clocks of two machines may differ."""
_EXAMINED = 20
"""Number of pools that are looked at."""


def serves_pools(namespace: str | None) -> bool:
    """Return True if this pod's account may make FiberPools and an operator serves them.

    If the account has the right and FiberPools or an operator are missing, a warning says so.
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
    if _is_unserved(api, namespace):
        return _on_this_machine(
            f"no operator serves the FiberPools of the namespace {namespace!r}. Start the operator"
        )
    return True


def _on_this_machine(why: str) -> bool:
    logging.getLogger("fiber").warning(
        "processes run on this machine and not in pods: %s, or set backend='local' "
        "(FIBER_BACKEND=local) to have no such warning",
        why,
    )
    return False


def _is_unserved(api: Api, namespace: str) -> bool:
    """Return True if the namespace's oldest FiberPools have waited in vain for an operator.

    An operator reports in a pool's status which generation of the spec it has seen.  A namespace
    without pools, or one whose pools may not be listed, tells nothing.
    """
    try:
        found = api.list(POOLS.path(namespace), {"limit": str(_EXAMINED)}, timeout=_TIMEOUT)
    except ApiError:
        return False
    waiting = [_has_waited(pool) for pool in found.get("items") or []]
    return bool(waiting) and all(waiting)


def _has_waited(pool: Body) -> bool:
    """Return True if no operator has ever reported on the pool, though it had time to."""
    if "observedGeneration" in (pool.get("status") or {}):
        return False
    try:
        created = parse_time(str(pool["metadata"].get("creationTimestamp")))
    except ValueError:
        return False
    return created + _PATIENCE < time.time()


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
