"""FiberPools and pods as the API shows them, for the tests of the operator's decisions."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import pytest

from fiber_api.names import LABEL_TEMPLATE_HASH
from fiber_api.times import format_time
from fiber_api.v1alpha1 import FiberPool, FiberPoolStatus
from fiber_operator.planning.manifests import spec_hash, template_hash
from fiber_operator.planning.plans import Knowledge, LeaseVerdict, Plan
from fiber_operator.planning.pods import PodView, observe
from fiber_operator.planning.reconcile import plan

NOW = 1_800_000_000.0
UID = "11111111-2222-3333-4444-555555555555"
ADDRESS = "10.96.1.2:7070"
TEMPLATE = {"spec": {"containers": [{"name": "worker", "image": "registry/worker:1"}]}}
MASTER = {"host": "10.0.3.7", "port": 41337, "epoch": 1, "identity": "laptop-7:4711"}
LEASED = {**MASTER, "leaseName": "es", "lostGraceSeconds": 60}
EXPIRED, UNKNOWN = LeaseVerdict(alive=False), LeaseVerdict(alive=None)

Json = dict[str, Any]


def pool_document(status: Mapping[str, Any] | None = None, **spec: Any) -> Json:
    """A pool called ``es``; further arguments are fields of its spec."""
    return {
        "apiVersion": "fiber.dev/v1alpha1",
        "kind": "FiberPool",
        "metadata": {"name": "es", "namespace": "team", "uid": UID, "generation": 7},
        "spec": {"template": copy.deepcopy(TEMPLATE), **spec},
        "status": dict(status or {}),
    }


def make_pool(status: Mapping[str, Any] | None = None, **spec: Any) -> FiberPool:
    """The same, read."""
    return FiberPool.read(pool_document(status, **spec))


def proven(pool: FiberPool, **status: Any) -> Json:
    """Return the status of a pool of whose template a worker was Ready."""
    failures = {"specHash": spec_hash(pool), **status.pop("failures", {})}
    return {"provenTemplateHash": template_hash(pool), "failures": failures, **status}


def tried(status: Mapping[str, Any] | None = None, /, **spec: Any) -> FiberPool:
    """Return a pool whose template is known to work."""
    return make_pool(proven(make_pool(**spec), **(status or {})), **spec)


def lost(ago: float, **spec: Any) -> FiberPool:
    """Return a pool as the operator left it when it found the master's Lease expired."""
    alive = {"type": "MasterAlive", "status": "False", "lastTransitionTime": format_time(NOW - ago)}
    return tried({"conditions": [alive], "masterEpoch": 1}, **{"master": LEASED, **spec})


def edited(pool: FiberPool, **spec: Any) -> FiberPool:
    """Return the pool with these fields in its spec."""
    document = pool.model_dump(mode="json", by_alias=True)
    return FiberPool.read({**document, "spec": {**document["spec"], **spec}})


def with_plan(pool: FiberPool, plan: Plan) -> FiberPool:
    """The pool after the plan's status was written."""
    if plan.status is None:
        return pool
    return FiberPool.read({**pool.model_dump(mode="json", by_alias=True), "status": plan.status})


def knowledge_of(pool: FiberPool, **fields: Any) -> Knowledge:
    """An operator that has made the pool's Service and knows that its template is accepted."""
    known = {"address": ADDRESS, "credentials": True, "accepted": template_hash(pool)}
    return Knowledge(**{**known, **fields})


def name_of(number: int) -> str:
    """The name of a worker."""
    return f"es-{number:010x}"


def names(*numbers: int) -> list[str]:
    """Return the names of workers."""
    return [name_of(number) for number in numbers]


def pod_document(number: int = 1, *, age: float = 0.0, template: str = "", **status: Any) -> Json:
    """A pod that was just created; further arguments are fields of its status."""
    return {
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": {
            "name": name_of(number),
            "uid": f"uid-{number}",
            "resourceVersion": str(1000 + number),
            "creationTimestamp": format_time(NOW - age),
            "labels": {LABEL_TEMPLATE_HASH: template},
            "ownerReferences": [{"uid": UID, "controller": True}],
        },
        "spec": {},
        "status": {"phase": "Pending", **status},
    }


def condition(kind: str, status: str, ago: float = 0.0, **fields: str) -> Json:
    """A condition of a pod."""
    return {
        "type": kind,
        "status": status,
        "lastTransitionTime": format_time(NOW - ago),
        **fields,
    }


def running(number: int = 1, *, age: float = 100.0, ready: bool = True, **more: Any) -> Json:
    """A pod whose worker runs since a second after it was created."""
    truth = condition("Ready", "True" if ready else "False", age - 1 if ready else age)
    document = pod_document(
        number,
        age=age,
        phase="Running",
        conditions=[truth],
        containerStatuses=[_container(running={"startedAt": format_time(NOW - age + 1)})],
        **more,
    )
    document["spec"]["nodeName"] = "node-1"
    return document


def waiting(number: int, reason: str, message: str = "", *, age: float = 3.0) -> Json:
    """A pod with a node whose worker container does not run yet."""
    state = {"waiting": {"reason": reason, "message": message}}
    document = pod_document(number, age=age, containerStatuses=[_container(**state)])
    document["spec"]["nodeName"] = "node-1"
    return document


def unschedulable(number: int, message: str = "0/2 nodes are available", age: float = 3.0) -> Json:
    """A pod that no node takes."""
    found = condition("PodScheduled", "False", age, reason="Unschedulable", message=message)
    return pod_document(number, age=age, conditions=[found])


def ended(
    number: int = 1,
    code: int = 1,
    *,
    age: float = 100.0,
    ran: float = 30.0,
    ago: float = 0.0,
    reason: str = "Error",
    message: str = "",
    **status: Any,
) -> Json:
    """A pod whose worker exited ``ago`` seconds ago."""
    terminated = {
        "exitCode": code,
        "reason": reason,
        "message": message,
        "startedAt": format_time(NOW - ago - ran),
        "finishedAt": format_time(NOW - ago),
    }
    phase = "Succeeded" if code == 0 else "Failed"
    fields = {"phase": phase, "containerStatuses": [_container(terminated=terminated)]}
    document = pod_document(number, age=max(age, ago + ran), **{**fields, **status})
    document["spec"]["nodeName"] = "node-1"
    return document


def terminating(document: Json) -> Json:
    """The same pod after somebody asked to delete it."""
    document = copy.deepcopy(document)
    document["metadata"]["deletionTimestamp"] = format_time(NOW + 30)
    return document


def of_template(hash_: str, document: Json) -> Json:
    """The same pod, made of that template."""
    document = copy.deepcopy(document)
    document["metadata"]["labels"][LABEL_TEMPLATE_HASH] = hash_
    return document


def outdated(*documents: Json) -> list[Json]:
    """Return the same pods, made of an older template."""
    return [of_template("older", document) for document in documents]


def views(pool: FiberPool, *documents: Json) -> list[PodView]:
    """Return the operator's view; pods without a template have the pool's."""
    current = template_hash(pool)
    return [
        observe(
            document
            if document["metadata"]["labels"][LABEL_TEMPLATE_HASH]
            else of_template(current, document),
            pool.spec.worker_container,
        )
        for document in documents
    ]


def plan_of(pool: FiberPool, *pods: Json, now: float = NOW, **knowledge: Any) -> Plan:
    """Return the plan for the pool with these pods; further arguments are the operator's memory."""
    return plan(pool, views(pool, *pods), knowledge_of(pool, **knowledge), now)


def work_of(made: Plan) -> str:
    """Return the work of a plan: ``-6* -5* +2 ScaledDown`` deletes two pods and creates two.

    A pod with a star is deleted only if it is unchanged.
    """
    deletions = [
        f"-{int(deletion.name.removeprefix('es-'), 16)}{'*' * bool(deletion.resource_version)}"
        for deletion in made.delete
    ]
    words = [*deletions, f"+{made.create}", *sorted({str(d.reason) for d in made.delete})]
    return " ".join([*words, *["pool"] * made.delete_pool, *["trial"] * made.dry_run])


def row(name: str, work: str, pool: FiberPool, *pods: Json, **known: Any) -> Any:
    """Return the parameters of a test: the pool, its pods, what the operator knows, the work."""
    return pytest.param(pool, pods, known, work, id=name)


def status_of(pool: FiberPool, *pods: Json, **more: Any) -> FiberPoolStatus:
    """The status that ``plan_of`` would have written."""
    return with_plan(pool, plan_of(pool, *pods, **more)).status


def _container(**state: Any) -> Json:
    return {"name": "worker", "state": state}
