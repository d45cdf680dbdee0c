"""The kinds of objects that a program deals with, as the API's paths name them."""

from __future__ import annotations

from typing import NamedTuple

from fiber_api import names


class Resource(NamedTuple):
    """A kind of object."""

    api_version: str
    kind: str
    plural: str

    def path(self, namespace: str | None = None, name: str = "") -> str:
        """The path of one object or, without a name, of all that are there."""
        group = "/apis" if "/" in self.api_version else "/api"
        scope = f"namespaces/{namespace}" if namespace is not None else ""
        return "/".join(filter(None, (group, self.api_version, scope, self.plural, name)))


POOLS = Resource(names.API_VERSION, names.KIND, names.PLURAL)
PODS = Resource("v1", "Pod", "pods")
NODES = Resource("v1", "Node", "nodes")
CLAIMS = Resource("v1", "PersistentVolumeClaim", "persistentvolumeclaims")
SECRETS = Resource("v1", "Secret", "secrets")
LEASES = Resource("coordination.k8s.io/v1", "Lease", "leases")
