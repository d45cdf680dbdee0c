"""A template is judged before any pod is made of it, misspelt fields included."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from fakes import strict
from fakes.kubernetes_api import Call, Fault
from fakes.store import Body, Failure
from fakes.world import NAMESPACE, TEMPLATE, World, played
from fiber_api.names import Reason
from fiber_api.v1alpha1 import FiberPool
from fiber_operator.planning import messages
from fiber_operator.planning.plans import PodRefusal
from fiber_operator.planning.podspec import pod
from unit.operator_objects import MASTER, NOW, make_pool

WORKER = {"name": "worker", "image": "registry/worker:1"}
CANNOT = 'Pod in version "v1" cannot be handled as a Pod'


def template(container: Body | None = None, metadata: Body | None = None, **spec: Any) -> Body:
    containers = [{**WORKER, **(container or {})}]
    return {"metadata": metadata or {}, "spec": {"containers": containers, **spec}}


def creations(world: World) -> list[bool]:
    """Return for each created pod whether it was a dry run."""
    return [c.dry_run for c in world.api.calls if (c.verb, c.plural) == ("create", "pods")]


async def message_of(world: World, reason: str) -> str:
    await world.until(lambda: reason in world.reasons(), 10)
    (problem,) = (p for p in world.status()["problems"] if p["reason"] == reason)
    return str(problem["message"])


MISSPELT = [
    (template({"imgae": "x"}), "spec.template.spec.containers[0].imgae"),
    (template({"env": [{"name": "A", "valu": "1"}]}), "spec.template.spec.containers[0].env["),
    (template(nodeSelecter={}), "spec.template.spec.nodeSelecter"),
    (template(metadata={"anotations": {}}), "spec.template.metadata.anotations"),
    ({**template(), "metdata": {}}, "spec.template.metdata"),
]


@pytest.mark.parametrize(("wrong", "path"), MISSPELT, ids=lambda value: str(value)[-20:])
def test_a_misspelt_field_is_a_problem_that_names_it(wrong: Body, path: str) -> None:
    @played
    async def test(world: World) -> None:
        world.make_pool(replicas=5, template=wrong)
        message = await message_of(world, "InvalidTemplate")
        (problem,) = world.status()["problems"]
        assert f'unknown field "{path}' in message
        assert "correct the name or place of the field, or remove it" in message
        assert CANNOT not in message
        assert problem["terminal"]
        assert world.status()["phase"] == "Failed"
        await world.settled(60)
        assert set(creations(world)) == {True}, "no pod is made of it"
        right = {"nodeSelecter": None, **TEMPLATE["spec"]}
        world.edit(template={"metadata": None, "metdata": None, "spec": right})
        await world.ready(5)
        assert world.reasons() == []

    test()


@played
async def test_a_template_that_becomes_misspelt_costs_no_worker(world: World) -> None:
    world.make_pool(replicas=3, update={"strategy": "Recreate"})
    await world.ready(3)
    before = world.names()
    world.edit(template=template({"imgae": "x"}))
    await message_of(world, "InvalidTemplate")
    await world.settled(120)
    assert world.names() == before
    world.edit(template=TEMPLATE)
    await world.until(lambda: world.reasons() == [])
    assert world.names() == before


def test_every_field_that_is_added_is_known() -> None:
    safe = {"readOnlyRootFilesystem": True}
    for said in ({}, {"securityContext": safe}, {"securityContext": {"runAsUser": 0}}):
        pool = make_pool(template=template(said, {"labels": {"a": "b"}}), master=MASTER)
        strict.check(pod(pool, "es-0000000001", "10.96.1.2:7070"))


MANIFESTS = sorted((Path(__file__).resolve().parents[2] / "examples/manifests").glob("*.yaml"))


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.stem)
def test_the_templates_that_are_shown_are_spelt_well(path: Path) -> None:
    document = yaml.safe_load(path.read_text())
    strict.check(pod(FiberPool.read(document), "es-0000000001", "10.96.1.2:7070"))


@pytest.mark.parametrize(
    "metadata",
    [{"creationTimestamp": None}, {"name": "x", "finalizers": ["a"]}, {"managedFields": []}],
)
def test_harmless_fields_of_a_template_are_not_refused(metadata: Body) -> None:
    whole = {"apiVersion": "v1", "kind": "Pod", "status": {}, **template(metadata=metadata)}
    body = pod(make_pool(template=whole), "es-0000000001", "10.96.1.2:7070")
    strict.check(body)
    assert "status" not in body


def test_invalid_annotations_are_left_to_the_api_server() -> None:
    pool = make_pool(template=template(metadata={"annotations": "x"}))
    assert pod(pool, "es-0000000001", "10.96.1.2:7070")["metadata"]["annotations"] == "x"


# -- Refusals


DECODING = f'{CANNOT}: strict decoding error: unknown field "spec.containers[0].imgae"'
TYPES = f"{CANNOT}: json: cannot unmarshal string into Go struct field Container.spec.containers"
WEBHOOK = 'admission webhook "images.example" denied the request: not signed yet'


@pytest.mark.parametrize(
    ("status", "message", "dry_run", "reason"),
    [
        (400, DECODING, True, Reason.INVALID_TEMPLATE),
        (400, TYPES, True, Reason.INVALID_TEMPLATE),
        (400, WEBHOOK, True, Reason.INVALID_TEMPLATE),
        (400, WEBHOOK, False, Reason.FORBIDDEN),
        (422, "spec.containers: Required value", True, Reason.INVALID_TEMPLATE),
        (422, "spec.containers: Required value", False, Reason.INVALID_TEMPLATE),
        (403, "exceeded quota: q", True, Reason.QUOTA_EXCEEDED),
        (403, "failed quota: q: must specify cpu for: x", True, Reason.REQUESTS_MISSING),
        (403, "exceeded quota: q", False, Reason.QUOTA_EXCEEDED),
        (403, "no right", True, Reason.FORBIDDEN),
    ],
)
def test_a_400_blames_the_template_only_in_a_dry_run(
    status: int, message: str, dry_run: bool, reason: Reason
) -> None:
    assert PodRefusal("hash", status, message, NOW, dry_run=dry_run).reason == reason


@pytest.mark.parametrize(
    ("status", "message"),
    [
        (
            422,
            'Pod "es-1" is invalid: spec.containers[0].resources.requests: Invalid value: "64Mi": '
            "must be less than or equal to memory limit of 32Mi",
        ),
        (
            403,
            'pods "es-1" is forbidden: minimum cpu usage per Container is 100m, but request is 50m',
        ),
        (
            403,
            'pods "es-1" is forbidden: cpu max limit to request ratio per Container is 2, but '
            "provided ratio is 10.000000",
        ),
    ],
)
def test_a_limit_range_is_reported_with_the_remedy(status: int, message: str) -> None:
    refused = PodRefusal("hash", status, message, NOW, dry_run=True)
    told = messages.refusal(refused.reason, refused)
    assert message.partition(": ")[2] in told
    assert "kubectl get limitranges" in told
    assert "fiber.init(cpu_request=0, memory_request=0)" in told


def test_a_refusal_for_something_else_speaks_of_no_limit_range() -> None:
    refused = PodRefusal("hash", 403, "no right", NOW)
    assert "limitranges" not in messages.refusal(refused.reason, refused)


@played
async def test_a_webhooks_refusal_of_a_good_template_is_tried_again(world: World) -> None:
    """400 is a webhook's usual answer; the dry run was accepted."""
    world.make_pool(replicas=1)
    await world.ready(1)
    world.api.faults.append(
        Fault("create", "pods", status=400, reason="BadRequest", message=WEBHOOK, times=10**6)
    )
    world.edit(replicas=3)
    message = await message_of(world, "Forbidden")
    (problem,) = world.status()["problems"]
    assert "not signed yet" in message
    assert not problem["terminal"]
    assert world.status()["phase"] == "Degraded"
    world.api.faults.clear()
    await world.ready(3)
    assert world.reasons() == []


@played
async def test_the_wrong_type_in_a_template_is_a_problem(world: World) -> None:
    def decode(plural: str, body: Body) -> None:
        if plural == "pods" and not isinstance(body["spec"]["containers"][0]["env"], list):
            raise Failure(400, "BadRequest", f"{TYPES}.env of type []v1.EnvVar")

    world.store.admit = decode
    world.make_pool(replicas=1, template=template({"env": "A=1"}))
    message = await message_of(world, "InvalidTemplate")
    assert "Container.spec.containers.env of type []v1.EnvVar. Correct spec.template" in message
    assert world.store.list("pods", NAMESPACE) == []


@played
async def test_a_webhook_that_cannot_do_dry_runs_is_no_verdict(world: World) -> None:
    message = 'admission webhook "old.example" does not support dry run'

    class OfDryRuns(Fault):
        def strikes(self, call: Call) -> bool:
            return call.dry_run and super().strikes(call)

    fault = OfDryRuns("create", "pods", 400, "BadRequest", message, times=10**6)
    world.api.faults.append(fault)
    world.make_pool(replicas=5)
    await world.ready(5)
    assert world.reasons() == []
    assert creations(world).count(True) == 1


@played
async def test_a_full_quota_does_not_judge_a_new_template(world: World) -> None:
    def quota(plural: str, body: Body) -> None:
        if plural == "pods" and len(world.pods()) >= 4:
            raise Failure(403, "Forbidden", 'pods "es-x" is forbidden: exceeded quota: pods')

    world.store.admit = quota
    world.make_pool(replicas=4, update={"strategy": "Recreate"})
    await world.ready(4)
    before = world.names()
    world.edit(template=template({"image": "registry/worker:2"}))
    await world.until(lambda: not set(before) & set(world.names()))
    await world.ready(4)
    assert world.reasons() == []


@played
async def test_a_new_pool_is_pending_until_its_template_is_judged(world: World) -> None:
    world.api.faults.append(Fault("create", "pods", status=500, times=3))
    world.make_pool(replicas=2)
    await world.until(lambda: world.status().get("phase") is not None)
    assert world.status()["phase"] == "Pending"
    (accepted,) = (c for c in world.status()["conditions"] if c["type"] == "Accepted")
    assert (accepted["status"], accepted["reason"]) == ("Unknown", "NotJudged")
    await world.ready(2)
    assert world.status()["phase"] == "Ready"
