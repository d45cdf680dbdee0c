"""Rights of the chart's role ``fiber-user``, which the API asks of those who send a token."""

from __future__ import annotations

from dataclasses import dataclass

from fakes.kubernetes_api import Call
from fiber_api import names

FIBER_USER = {
    "fiberpools": {"create", "delete", "get", "list", "patch", "watch"},
    "secrets": {"create"},
    "leases": {"create", "get", "patch", "update"},
    "pods": {"get", "list", "watch"},
    "pods/portforward": {"create", "get"},
    "persistentvolumeclaims": {"get"},
}
"""Verbs by resource; ``tests/chart`` compares them with the chart."""


@dataclass(frozen=True)
class FiberUser:
    """Rights of an account that has the role in one namespace."""

    namespace: str
    sees_operators: bool = True
    """True if it may read the Lease of operators that serve all namespaces."""

    def allow(self, call: Call) -> bool:
        """Return True if the account may make this call."""
        if call.namespace == self.namespace:
            resource = f"{call.plural}/{call.subresource}" if call.subresource else call.plural
            return call.verb in FIBER_USER.get(resource, ())
        sees = (call.namespace, call.plural, call.verb, call.name)
        return self.sees_operators and sees == (
            names.SERVING_NAMESPACE,
            "leases",
            "get",
            names.SERVING_LEASE,
        )
