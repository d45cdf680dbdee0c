"""An API server with all that ``fiber doctor`` asks for, and no fault."""

from __future__ import annotations

import time
from email.utils import formatdate
from pathlib import Path
from typing import Any

import yaml

from fakes.served import Served
from fiber._cli.doctor_rights import SCHEMA, SCHEMA_NAME
from fiber_api import names
from fiber_api.times import format_micro_time

Body = dict[str, Any]

ROOT = Path(__file__).resolve().parents[2]
NODE = "node-1"
RESOURCES = f"/apis/{names.API_VERSION}"


def schema() -> Body:
    """Return what the API server says of FiberPools' fields, from the definition."""
    definition = yaml.safe_load((ROOT / "crds" / "fiberpools.yaml").read_text())
    fields = definition["spec"]["versions"][0]["schema"]["openAPIV3Schema"]
    return {"components": {"schemas": {SCHEMA_NAME: fields}}}


class DoctorCluster:
    """``server`` with one node, one operator and one namespace, and what a test does to it."""

    def __init__(self, server: Served, namespace: str) -> None:
        self.server = server
        self.api = server.api
        self.namespace = namespace
        self.api.documents[SCHEMA] = schema()
        self.add("namespaces", {"metadata": {"name": namespace}}, "")
        self.add("nodes", {"metadata": {"name": NODE}}, "")
        amounts = {"cpu": "4", "memory": "8Gi", "pods": "110"}
        self.set_node(status={"allocatable": amounts})
        self.add("leases", _lease(time.time()), names.SERVING_NAMESPACE)
        labels = {
            "app.kubernetes.io/component": "operator",
            "app.kubernetes.io/part-of": "fiber",
            "app.kubernetes.io/version": "9.8.7",
        }
        operator = {"metadata": {"name": "fiber-operator", "labels": labels}}
        self.add("deployments", operator, "fiber-system")

    def add(self, plural: str, body: Body, namespace: str | None = None) -> None:
        place = self.namespace if namespace is None else namespace
        self.server.do(self.server.store.create, plural, place, body)

    def remove(self, plural: str, name: str, namespace: str = "") -> None:
        self.server.do(self.server.store.remove, plural, namespace, name)

    def set_node(self, **patch: Any) -> None:
        self.server.do(self.server.store.merge, "nodes", "", NODE, patch)

    def end_operator(self) -> None:
        """Remove the Lease by which it shows that it serves."""
        self.remove("leases", names.SERVING_LEASE, names.SERVING_NAMESPACE)

    def stop_operator(self) -> None:
        """Let the operator's Lease be an hour old."""
        self.renew(time.time() - 3600)

    def renew(self, moment: float) -> None:
        """Let the operator have renewed its Lease at this time."""
        place = ("leases", names.SERVING_NAMESPACE, names.SERVING_LEASE)
        self.server.do(self.server.store.merge, *place, _lease(moment))

    def set_clock(self, ahead: float) -> None:
        """Let the cluster's clocks be ahead of this machine's."""
        self.api.date = formatdate(time.time() + ahead, usegmt=True)
        self.renew(time.time() + ahead)

    def forbid(self, verb: str, resource: str) -> None:
        """Take one right in the namespace from the account."""
        plural, _, subresource = resource.partition("/")
        allows = self.api.allows
        taken = (verb, plural, subresource, self.namespace)
        self.api.allows = lambda call: (
            allows(call) and (call.verb, call.plural, call.subresource, call.namespace) != taken
        )

    def forbid_all(self, *plurals: str) -> None:
        """Take all rights for these resources, in the whole cluster."""
        allows = self.api.allows
        self.api.allows = lambda call: allows(call) and call.plural not in plurals

    def drop_field(self, name: str) -> None:
        """Let the definition be older than a field of the spec."""
        document = schema()
        fields = document["components"]["schemas"][SCHEMA_NAME]["properties"]["spec"]
        del fields["properties"][name]
        self.api.documents[SCHEMA] = document


def _lease(moment: float) -> Body:
    spec = {
        "renewTime": format_micro_time(moment),
        "leaseDurationSeconds": names.SERVING_SECONDS,
    }
    return {"metadata": {"name": names.SERVING_LEASE}, "spec": spec}
