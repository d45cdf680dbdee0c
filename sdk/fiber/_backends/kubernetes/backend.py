"""Backend whose agents are pods: one FiberPool for each shape of pod that a program asks for.

``serves_pools`` decides for ``backend="auto"`` whether this backend can be used.
"""

from __future__ import annotations

import contextlib
import logging
import time
from functools import partial

from fiber._agent.interface import ChildObserver, ChildSpec
from fiber._backends.kubernetes.api import LEASES, Api
from fiber._backends.kubernetes.api_errors import ApiError, Body, Forbidden, NotFound
from fiber._backends.kubernetes.pods import Pods
from fiber._backends.kubernetes.program import Program
from fiber._backends.kubernetes.template import Shape
from fiber._backends.output import Output
from fiber._backends.remote import RemoteChild
from fiber._hub.hub import Hub
from fiber._transport.loop import Loop
from fiber.config import Config
from fiber.errors import ConfigError
from fiber_api import names
from fiber_api.times import format_time, parse_time


class KubernetesBackend:
    """Shares the pods of each shape among all of the program's pools and processes."""

    name = "kubernetes"
    same_host = False
    same_pids = False
    elastic = True
    sends_program = True

    def __init__(self, loop: Loop, hub: Hub, config: Config) -> None:
        self._loop = loop
        self._hub = hub
        self._config = config
        self._output = Output()
        self._shape = Shape.of(config)
        self._program = Program(config)
        self._pods: dict[tuple[Shape | str, int], Pods] = {}
        """Pods by their shape or pool, and by the number of such pods before them."""
        self._closing = False

    def child(self, spec: ChildSpec, observer: ChildObserver) -> RemoteChild:
        """A child in a pod that has what it wishes."""
        pool = spec.resources.pool or self._config.pool
        key = pool or self._shape.with_resources(spec.resources)
        return self._find(key).agents.child(spec, observer)

    def _find(self, key: Shape | str) -> Pods:
        """Return the pods in use, or new ones.  There is no lock: a finalizer may call this too."""
        before = 0
        while True:
            pods = self._pods.get((key, before))
            if pods is None:  # one that another thread makes meanwhile has had no effect yet
                pods = self._pods.setdefault((key, before), self._make(key))
                if self._closing:  # which may have looked before
                    pods.begin_close()
            if not pods.over:
                return pods
            before += 1

    def _make(self, key: Shape | str) -> Pods:
        make = partial(Pods, self._loop, self._hub, self._output, self._config, self._program.api)
        if isinstance(key, str):
            return make(partial(self._program.prepare_warm, key, self._loop))
        prepare = partial(self._program.prepare_own, key, self._loop)
        return make(prepare, successor=lambda: self._find(key).agents)

    def close(self) -> None:
        """End the pods, and the pools or their use."""
        self._closing = True
        with contextlib.ExitStack() as rest:  # of which nothing is left out if it is interrupted
            rest.callback(self._output.close)
            rest.callback(self._program.close)
            for pods in list(self._pods.values()):
                pods.begin_close()
                rest.callback(pods.close)


_REVIEWS = "/apis/authorization.k8s.io/v1/selfsubjectaccessreviews"

_TIMEOUT = 5.0
"""Seconds that a program may wait for an answer before it goes on without a cluster."""


def serves_pools(namespace: str | None) -> bool:
    """Return True if this pod's account may make FiberPools and an operator serves them.

    If the account has the right and an operator does not show that it lives, a warning says so.
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
    missing = []
    try:
        for place in dict.fromkeys((names.SERVING_NAMESPACE, namespace)):
            why = _why_not_served(api, place)
            if why is None:
                return True
            missing.append(f"{why} in the namespace {place!r}")
        api.get(f"/apis/{names.API_VERSION}", timeout=_TIMEOUT)
    except NotFound:
        return _on_this_machine("the cluster knows no FiberPools. Install the operator's chart")
    except ApiError as error:
        return _on_this_machine(
            f"the API server does not say whether an operator serves the namespace {namespace!r} "
            f"({error.message}). Set backend='kubernetes' to try again"
        )
    return _on_this_machine(
        f"no operator shows that it serves the namespace {namespace!r}: its Lease "
        f"{names.SERVING_LEASE} {' and '.join(missing)}. Start or install the operator"
    )


def _on_this_machine(why: str) -> bool:
    logging.getLogger("fiber").warning(
        "processes run on this machine and not in pods: %s, or set backend='local' "
        "(FIBER_BACKEND=local) to have no such warning",
        why,
    )
    return False


def _why_not_served(api: Api, place: str) -> str | None:
    """Return why the Lease there does not show a living operator; None if it does."""
    try:
        lease = api.get(LEASES.path(place, names.SERVING_LEASE), timeout=_TIMEOUT)
    except NotFound:
        return "does not exist"
    except Forbidden:
        return "may not be read"
    spec = lease.get("spec") or {}
    try:
        renewed = parse_time(str(spec.get("renewTime")))
        fresh_until = renewed + int(spec.get("leaseDurationSeconds") or 0)
    except (TypeError, ValueError):
        return "has no time"
    # The clocks of two machines: they differ by less than an operator's restart takes.
    return None if time.time() < fresh_until else f"was last renewed at {format_time(renewed)}"


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
