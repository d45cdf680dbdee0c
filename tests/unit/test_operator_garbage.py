"""Garbage in a pool or a pod ends neither the operator nor a healthy worker."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from fakes import virtual_time
from fakes.store import Body
from fakes.world import NAMESPACE, World, a_world
from fiber_api.times import format_time
from fiber_api.v1alpha1 import FiberPool, InvalidPool
from fiber_operator.metrics import PoolSample
from fiber_operator.planning import plans, relay
from fiber_operator.planning.manifests import template_hash
from fiber_operator.planning.plans import Knowledge, Plan
from fiber_operator.planning.pods import PodView, observe
from fiber_operator.planning.podspec import pod
from fiber_operator.planning.reconcile import plan, plan_unreadable
from unit.operator_objects import (
    ADDRESS,
    MASTER,
    NOW,
    condition,
    ended,
    name_of,
    of_template,
    pool_document,
    running,
    terminating,
    unschedulable,
    views,
    waiting,
)

Path = tuple[str | int, ...]
pytestmark = pytest.mark.slow

NO_SHRINKING = (Phase.explicit, Phase.reuse, Phase.generate)

LEAVES = st.sampled_from(
    [
        *(None, True, False, 0, -1, 1, 2**31 - 1, 2**31, 2**53 + 1, -(2**63), 0.5, 1e308, -1e308),
        *("", "x", "True", "False", "5", "9" * 5000, "\u2028\x00", "a" * 3000),
        *("9999-12-31T23:59:59Z", "9999-12-31T23:59:59-14:00", "0001-01-01T00:00:00Z"),
        *("0001-01-01T00:00:00+14:00", "2099-01-01T00:00:00Z", "1970-01-01T00:00:00Z", "now"),
    ]
)
KEYS = st.sampled_from(["name", "type", "status", "reason", "uid", "state", "message", "x"])
GARBAGE = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=5,
)


def paths(document: object, above: Path = ()) -> Iterator[Path]:
    """The way to each value in a document."""
    yield above
    inner: Any = ()
    if isinstance(document, dict):
        inner = document.items()
    elif isinstance(document, list):
        inner = enumerate(document)
    for key, value in inner:
        yield from paths(value, (*above, key))


def found(document: Any, path: Path) -> Any:
    for key in path:
        document = document[key]
    return document


def put(document: Any, path: Path, value: Any) -> Any:
    """The document with another value at that place."""
    document = copy.deepcopy(document)
    found(document, path[:-1])[path[-1]] = value
    return document


def spoilt(draw: Any, document: Any, parts: tuple[str, ...], most: int = 3) -> Any:
    """The document with garbage at one place or some, below ``parts``."""
    for _ in range(draw(st.integers(1, most))):
        part = draw(st.sampled_from([part for part in parts if part in document] or [*document]))
        inside = [path for path in paths(document) if path[:1] == (part,)]
        document = put(document, draw(st.sampled_from(inside)), draw(GARBAGE))
    return document


# -- The planner

SPEC: Body = {
    "replicas": 3,
    "minReplicas": 1,
    "maxReplicas": 9,
    "master": {**MASTER, "leaseName": "es"},
    "relay": True,
    "onLost": "Delete",
    "idle": {"timeoutSeconds": 60},
    "scaleDown": {"policy": "ReleasedOnly", "release": [name_of(77)], "idleTimeoutSeconds": 5},
    "scaleUp": {"maxInFlight": 3},
    "failurePolicy": {
        "backoffBaseSeconds": 1,
        "backoffMaxSeconds": 9,
        "backoffLimit": 3,
        "startupTimeoutSeconds": 60,
    },
    "update": {"strategy": "OnIdle"},
    "suspend": False,
    "processesPerPod": 2,
    "workerContainer": "worker",
    "template": {
        "metadata": {"labels": {"a": "b"}, "annotations": {"a": "b"}},
        "spec": {
            "containers": [
                {
                    "name": "worker",
                    "image": "x",
                    "env": [{"name": "A", "value": "b"}],
                    "volumeMounts": [{"name": "v", "mountPath": "/x"}],
                    "securityContext": {"capabilities": {"add": ["X"]}},
                    "resources": {"limits": {"memory": "1Gi"}},
                }
            ],
            "initContainers": [{"name": "i", "image": "i"}],
            "volumes": [{"name": "v"}],
            "tolerations": [{"key": "k"}],
            "securityContext": {"runAsUser": 5},
        },
    },
}


def troubled(**spec: Any) -> Body:
    """A pool of which every field of the status says something."""
    document = pool_document(**{**SPEC, **spec})
    document["metadata"]["creationTimestamp"] = format_time(NOW - 1000)
    pool = FiberPool.read(document)
    pods = views(pool, ended(1, code=3), waiting(2, "ErrImagePull"), running(3), unschedulable(4))
    made = plan(pool, pods, knowledge(pool, alive=False), NOW)
    return {**document, "status": written(made)}


def knowledge(pool: FiberPool, alive: bool | None) -> Knowledge:
    return Knowledge(
        address=ADDRESS, accepted=template_hash(pool), master=plans.LeaseVerdict(alive)
    )


def written(made: Plan) -> Body:
    """The plan's status as the API server has it then."""
    assert made.status is not None
    status: Body = json.loads(json.dumps(made.status))
    return status


ATTACHED, WARM = troubled(), troubled(master=None)
VIEWS = [
    observe(of_template(template_hash(FiberPool.read(ATTACHED)), running(number)), "worker")
    for number in (10, 11, 12)
]


def check_plan(pool: FiberPool, document: Body, pods: list[PodView], alive: bool | None) -> Plan:
    """Check a patch: it can be written, reads back the same, and is stable."""
    known = knowledge(pool, alive)
    made = plan(pool, pods, known, NOW)
    if made.status is not None:
        after = FiberPool.read({**document, "status": written(made)})
        assert not after.unread
        assert plan(after, pods, known, NOW).status is None
    for later in (1, 100, 10**6):
        plan(pool, pods, known, NOW + later)
    return made


@settings(deadline=None, max_examples=200, phases=NO_SHRINKING)
@given(st.sampled_from([ATTACHED, WARM]), st.data(), st.sampled_from([None, True, False]))
def test_garbage_in_the_status_costs_no_worker(
    document: Body, data: st.DataObject, alive: bool | None
) -> None:
    document = spoilt(data.draw, document, ("status",))
    pool = FiberPool.read(document)
    made = check_plan(pool, document, VIEWS, alive)
    assert (made.delete, made.delete_pool) == ((), False)
    status = document["status"]
    PoolSample.of(status if isinstance(status, dict) else {}, VIEWS)


@settings(deadline=None, max_examples=200, phases=NO_SHRINKING)
@given(st.sampled_from([ATTACHED, WARM]), st.data(), st.sampled_from([None, True, False]))
def test_garbage_in_the_spec_can_be_planned_or_is_reported(
    document: Body, data: st.DataObject, alive: bool | None
) -> None:
    document = spoilt(data.draw, document, ("spec", "spec", "status"))
    errors: tuple[str, ...] = ()
    try:
        pool = FiberPool.read(document)
    except InvalidPool as error:
        errors = error.errors
    if not errors:
        check_plan(pool, document, VIEWS, alive)
        json.dumps(pod(pool, name_of(1), ADDRESS))
        json.dumps(relay.deployment(pool))
        return
    made = plan_unreadable(document, VIEWS, errors, NOW)
    assert (made.create, made.delete, made.delete_pool) == (0, (), False)
    told = {**document, "status": written(made)}
    assert plan_unreadable(told, VIEWS, errors, NOW + 9) == Plan()


def marked(document: Body) -> Body:
    """The pod with more that may be spoilt."""
    document = copy.deepcopy(document)
    cost = {"controller.kubernetes.io/pod-deletion-cost": "3"}
    document["metadata"]["annotations"] = cost
    disrupted = condition("DisruptionTarget", "False", 1, reason="a", message="b")
    document["status"].setdefault("conditions", []).append(disrupted)
    end = {"terminated": {"exitCode": 0, "reason": "Completed"}}
    document["status"]["initContainerStatuses"] = [{"name": "i", "state": end}]
    return document


PODS = [
    marked(document)
    for document in (
        running(10),
        ended(11, code=2, ago=5),
        waiting(12, "ErrImagePull"),
        unschedulable(13),
        running(14, ready=False),
        terminating(running(15)),
    )
]


@settings(deadline=None, max_examples=200, phases=NO_SHRINKING)
@given(st.sampled_from([ATTACHED, WARM]), st.data(), st.sampled_from([None, True, False]))
def test_garbage_in_pods_can_be_planned(
    document: Body, data: st.DataObject, alive: bool | None
) -> None:
    number = data.draw(st.integers(0, len(PODS) - 1))
    pods = list(PODS)
    pods[number] = spoilt(data.draw, pods[number], ("metadata", "spec", "status", "status"))
    pool = FiberPool.read(document)
    check_plan(pool, document, views_of(pool, pods), alive)


def views_of(pool: FiberPool, pods: list[Body]) -> list[PodView]:
    return [observe(document, pool.spec.worker_container) for document in pods]


@settings(deadline=None, max_examples=200, phases=NO_SHRINKING)
@given(st.sampled_from([ATTACHED, WARM]), st.data())
def test_a_value_of_the_wrong_type_removes_no_worker(document: Body, data: st.DataObject) -> None:
    pool = FiberPool.read({**document, "status": {}})
    current = template_hash(pool)
    pods = [of_template(current, running(number)) for number in (10, 11, 12)]
    pods[0] = spoilt_in_type(data.draw, pods[0])
    assert plan(pool, views_of(pool, pods), knowledge(pool, None), NOW).delete == ()


def spoilt_in_type(draw: Any, document: Body) -> Body:
    """The document with a value of another type at one place."""
    path = draw(st.sampled_from([path for path in paths(document) if path]))
    before = found(document, path)
    others = [None, True, 7, 0.5, [], {}, [1], {"a": 1}, "x"]
    value = draw(st.sampled_from([x for x in others if type(x) is not type(before)]))
    changed: Body = put(document, path, value)
    return changed


# -- The operator

EXAMPLES = settings(deadline=None, max_examples=15, phases=NO_SHRINKING)


def replaced(world: World, plural: str, name: str, **parts: Any) -> None:
    """Write past the API server's checks."""
    body = {**world.store.get(plural, NAMESPACE, name), **parts}
    world.store._put("MODIFIED", (plural, NAMESPACE, name), body)


def lost(world: World) -> list[str]:
    """Pods that were deleted."""
    changes = world.store.changes
    return [c.place[2] for c in changes if c.type == "DELETED" and c.place[0] == "pods"]


def faults_of_its_own(world: World) -> float | None:
    """Return how many reconciles ended with an exception that is no answer of the API server."""
    registry = world.program.metrics.registry
    return registry.get_sample_value("fiber_operator_reconciles_total", {"outcome": "error"})


async def is_alive(world: World) -> None:
    """The operator serves another pool."""
    assert not world.dead
    world.make_pool("other", replicas=2)
    await world.ready(2, "other", within=60)


def play(spoil: Any, pool: Body) -> None:
    """Three Ready workers, then ``spoil``, then what was spoilt is put right."""

    async def main() -> None:
        async with a_world() as world:
            world.make_pool(**pool)
            await world.ready(3)
            whole = world.store.get("fiberpools", NAMESPACE, "es")
            names = world.names()
            spoil(world)
            await world.settled(90)
            assert lost(world) == []
            assert faults_of_its_own(world) is None
            await is_alive(world)
            replaced(world, "fiberpools", "es", spec=whole["spec"])
            for name in names:
                world.kubelet.ready(NAMESPACE, name)
            await world.until(lambda: world.status()["phase"] == "Ready")
            await world.ready(3)
            assert lost(world) == []

    virtual_time.run(main())


POOL = {**SPEC, "scaleDown": {}, "master": MASTER}


@EXAMPLES
@given(st.data())
def test_an_operator_outlives_garbage_in_the_status(data: st.DataObject) -> None:
    def spoil(world: World) -> None:
        document = {"status": world.status()}
        replaced(world, "fiberpools", "es", **spoilt(data.draw, document, ("status",), 5))

    play(spoil, POOL)


@EXAMPLES
@given(st.data())
def test_an_operator_outlives_garbage_in_the_spec(data: st.DataObject) -> None:
    def spoil(world: World) -> None:
        spec = world.store.get("fiberpools", NAMESPACE, "es")["spec"]
        # A field of the right type is an order, and carried out.
        replaced(world, "fiberpools", "es", spec=spoilt_in_type(data.draw, {"spec": spec})["spec"])

    play(spoil, POOL)


@EXAMPLES
@given(st.data())
def test_an_operator_outlives_garbage_in_a_pod(data: st.DataObject) -> None:
    def spoil(world: World) -> None:
        name = world.names()[0]
        status = {"status": world.store.get("pods", NAMESPACE, name)["status"]}
        replaced(world, "pods", name, **spoilt_in_type(data.draw, status))

    play(spoil, POOL)


@EXAMPLES
@given(st.data(), st.sampled_from(["services", "endpointslices", "secrets", "deployments"]))
def test_an_operator_survives_garbage_in_the_objects_of_a_pool(
    data: st.DataObject, plural: str
) -> None:
    def spoil(world: World) -> None:
        (body,) = world.store.list(plural, NAMESPACE)
        parts = {key: value for key, value in body.items() if key not in ("metadata", "kind")}
        name = body["metadata"]["name"]
        replaced(world, plural, name, **spoilt(data.draw, parts, tuple(parts)))

    async def main() -> None:
        async with a_world() as world:
            world.make_pool(**POOL)
            await world.ready(3)
            spoil(world)
            await world.settled(200)
            assert lost(world) == []
            assert faults_of_its_own(world) is None
            await is_alive(world)

    virtual_time.run(main())
