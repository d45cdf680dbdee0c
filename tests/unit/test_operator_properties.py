"""Properties of every plan, for any pool, pods and status."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import Phase, assume, example, given, settings
from hypothesis import strategies as st

from fiber_api.names import Reason
from fiber_api.times import format_time
from fiber_api.v1alpha1 import FiberPool, InvalidPool
from fiber_operator.planning import plans
from fiber_operator.planning.failures import held_back_until
from fiber_operator.planning.manifests import spec_hash, template_hash
from fiber_operator.planning.plans import Knowledge, Obstacle, Plan, PodRefusal
from fiber_operator.planning.pods import PodState, PodView, Trouble
from fiber_operator.planning.reconcile import CANARIES, PATIENCE, plan, plan_unreadable
from unit.operator_cluster_model import Model, view
from unit.operator_objects import ADDRESS, MASTER, NOW, make_pool, name_of, pool_document
from unit.test_operator_pods import ANYTHING

NO_SHRINKING = (Phase.explicit, Phase.reuse, Phase.generate)
"""Phases of hypothesis for slow tests: a failure is shown as it was found."""

NUMBERS = st.integers(0, 15)
TROUBLES: dict[PodState, list[Trouble | None]] = {
    PodState.PENDING: [None, Trouble.CANNOT_START, Trouble.UNSCHEDULABLE],
    PodState.STARTING: [None],
    PodState.READY: [None],
    PodState.NOT_READY: [None],
    PodState.TERMINATING: [None, Trouble.DISRUPTED],
    PodState.ENDED: [Trouble.APPLICATION, Trouble.COMPLETED, Trouble.DISRUPTED],
}
REASONS = ["", "ErrImagePull", "ImagePullBackOff", "OOMKilled", "Evicted", "InvalidImageName"]


@st.composite
def pods_of(draw: st.DrawFn, hash_: str) -> list[PodView]:
    pods = []
    for number in draw(st.sets(NUMBERS)):
        state = draw(st.sampled_from(PodState))
        age = draw(st.sampled_from([0, 1, 7, 20, 59, 61, 3000]))
        pods.append(
            view(
                number,
                state,
                template_hash=draw(st.sampled_from([hash_, hash_, "older"])),
                trouble=draw(st.sampled_from(TROUBLES[state])),
                reason=draw(st.sampled_from(REASONS)),
                created=NOW - age - draw(st.sampled_from([0, 5])),
                since=NOW - age,
                owner=draw(st.sampled_from([view(0, state).owner] * 5 + ["another", ""])),
                exit_code=draw(st.sampled_from([None, 0, 1, 137])),
                ran=float(draw(st.sampled_from([0, 5, 100]))),
                deletion_cost=draw(st.integers(-2, 2)),
            )
        )
    return pods


SPECS = st.fixed_dictionaries(
    {
        "minReplicas": st.integers(0, 4),
        "maxReplicas": st.integers(4, 12),
        "suspend": st.sampled_from([False, False, False, True]),
        "scaleDown": st.fixed_dictionaries(
            {
                "policy": st.sampled_from(["ReleasedOnly", "ReleasedOnly", "Any"]),
                "release": st.lists(NUMBERS.map(name_of), unique=True, max_size=4),
            }
        ),
        "update": st.fixed_dictionaries(
            {"strategy": st.sampled_from(["OnIdle", "OnIdle", "Recreate", "OnDelete"])}
        ),
    },
    optional={
        "replicas": st.integers(0, 16),
        "onLost": st.sampled_from(["Delete", "ScaleToMin", "Retain"]),
        "idle": st.just({"timeoutSeconds": 60}),
        "master": st.fixed_dictionaries(
            {
                **{key: st.just(value) for key, value in MASTER.items()},
                "lostGraceSeconds": st.sampled_from([0, 60]),
            },
            optional={"leaseName": st.just("es")},
        ),
    },
)


@st.composite
def statuses(draw: st.DrawFn, spec: dict[str, Any]) -> dict[str, Any]:
    pool = make_pool(**spec)
    times = st.sampled_from([-100, -5, 0, 4, 100, 10_000]).map(lambda s: format_time(NOW + s))
    failures = {
        "consecutive": draw(st.sampled_from([0, 0, 1, 3, 8])),
        "waves": draw(st.sampled_from([0, 0, 1, 3])),
        "waiting": draw(st.sampled_from([0, 0, 1, 3, 20])),
        "nextCreateTime": draw(times),
        "counted": draw(st.lists(NUMBERS.map(name_of), max_size=4, unique=True)),
        "specHash": draw(st.sampled_from([spec_hash(pool), spec_hash(pool), "other"])),
    }
    alive = {
        "type": "MasterAlive",
        "status": draw(st.sampled_from(["True", "False", "Unknown"])),
        "lastTransitionTime": draw(times),
    }
    proven = draw(st.sampled_from([template_hash(pool), "older", None]))
    known = {"failures": failures, "conditions": [alive], "provenTemplateHash": proven}
    return {**known, "masterEpoch": draw(st.sampled_from([1, 1, None]))}


@st.composite
def knowledges(draw: st.DrawFn, hash_: str) -> Knowledge:
    refusal = PodRefusal(hash_, draw(st.sampled_from([403, 422])), "no", NOW - 3)
    obstacle = Obstacle(Reason.NAME_TAKEN, "taken")
    return Knowledge(
        address=draw(st.sampled_from([ADDRESS] * 4 + [None])),
        obstacles=draw(st.sampled_from([()] * 4 + [(obstacle,)])),
        accepted=draw(st.sampled_from([hash_, hash_, "older", None])),
        refusal=draw(st.sampled_from([None, None, None, refusal])),
        master=plans.LeaseVerdict(
            draw(st.sampled_from([None, True, False])),
            missing=draw(st.sampled_from([False, False, True])),
            unreadable=draw(st.sampled_from(["", "", "forbidden"])),
        ),
    )


@st.composite
def cases(
    draw: st.DrawFn, specs: st.SearchStrategy[dict[str, Any]] = SPECS
) -> tuple[FiberPool, list[PodView], Knowledge]:
    spec = draw(specs)
    pool = make_pool(draw(statuses(spec)), **spec)
    hash_ = template_hash(pool)
    return pool, draw(pods_of(hash_)), draw(knowledges(hash_))


Case = tuple[FiberPool, list[PodView], Knowledge]


def own(pool: FiberPool, pods: list[PodView]) -> dict[str, PodView]:
    return {pod.name: pod for pod in pods if pod.owner == pool.metadata.uid}


def after(pool: FiberPool, made: Plan) -> FiberPool:
    if made.status is None:
        return pool
    return FiberPool.read({**pool.model_dump(mode="json", by_alias=True), "status": made.status})


def only_pods_of_the_pool_are_deleted_and_each_once(
    made: Plan, pool: FiberPool, pods: list[PodView], knowledge: Knowledge
) -> None:
    names = [deletion.name for deletion in made.delete]
    assert len(set(names)) == len(names)
    known = own(pool, pods)
    for deletion in made.delete:
        assert deletion.uid == known[deletion.name].uid
        assert known[deletion.name].state is not PodState.TERMINATING


def a_pool_is_deleted_for_a_lease_that_this_process_saw_expire_alone(
    made: Plan, pool: FiberPool, pods: list[PodView], knowledge: Knowledge
) -> None:
    if made.delete_pool:
        assert knowledge.master.alive is False
        assert pool.spec.on_lost == "Delete"


def creation_never_passes_what_is_wanted(
    made: Plan, pool: FiberPool, pods: list[PodView], knowledge: Knowledge
) -> None:
    gone = {deletion.name for deletion in made.delete}
    live = [pod for pod in own(pool, pods).values() if pod.live and pod.name not in gone]
    assert made.create >= 0
    if made.create:
        assert len(live) + made.create <= pool.wanted <= pool.spec.max_replicas


def nothing_is_created_where_something_forbids_it(
    made: Plan, pool: FiberPool, pods: list[PodView], knowledge: Knowledge
) -> None:
    if not made.create:
        return
    failures = after(pool, made).status.failures
    assert failures.consecutive <= pool.spec.failure_policy.backoff_limit
    if held_back_until(failures, NOW):
        gone = {deletion.name for deletion in made.delete}
        live = [pod for pod in own(pool, pods).values() if pod.live and pod.name not in gone]
        assert len(live) + made.create + failures.waiting <= pool.wanted
    assert knowledge.address
    assert not knowledge.obstacles
    assert not knowledge.refusal
    assert not pool.spec.suspend
    assert not made.dry_run
    proven = after(pool, made).status.proven_template_hash
    assert template_hash(pool) in (knowledge.accepted, proven)


def a_template_that_never_worked_gets_few_pods(
    made: Plan, pool: FiberPool, pods: list[PodView], knowledge: Knowledge
) -> None:
    status, hash_ = after(pool, made).status, template_hash(pool)
    if not made.create or status.proven_template_hash == hash_:
        return
    gone = {deletion.name for deletion in made.delete}
    known = own(pool, pods).values()
    live = [pod for pod in known if pod.live and pod.name not in gone]
    current = [pod for pod in live if pod.template_hash == hash_]
    homeless = sum(pod.trouble is Trouble.UNSCHEDULABLE for pod in current)
    placed = len(current) - homeless + made.create
    if status.failures.waves or Trouble.CANNOT_START in {pod.trouble for pod in current}:
        held_back = status.failures.waiting if held_back_until(status.failures, NOW) else 0
        assert len(current) + made.create + held_back <= CANARIES
    elif all(pod.created > NOW - PATIENCE for pod in current):
        assert placed <= max(CANARIES, homeless)
    else:
        assert placed <= max(CANARIES, homeless, 2 * len(current))


def the_order_of_the_list_makes_no_difference(
    made: Plan, pool: FiberPool, pods: list[PodView], knowledge: Knowledge
) -> None:
    assert plan(pool, pods[::-1], knowledge, NOW) == made
    assert plan(pool, sorted(pods, key=lambda pod: pod.resource_version), knowledge, NOW) == made


def a_plan_whose_status_is_written_stays_the_plan(
    made: Plan, pool: FiberPool, pods: list[PodView], knowledge: Knowledge
) -> None:
    """The operator died after writing the status: the next one does the rest."""
    second = plan(after(pool, made), pods, knowledge, NOW)
    if made.status is None and not made.dry_run:
        assert second == made
    else:
        assert (second.create, second.delete) == (made.create, made.delete)
        assert second.status is None


def nothing_is_planned_twice(
    made: Plan, pool: FiberPool, pods: list[PodView], knowledge: Knowledge
) -> None:
    model = Model(
        document=pool.model_dump(mode="json", by_alias=True),
        pods={pod.name: pod for pod in pods},
        knowledge=knowledge,
    )
    model.act()
    if made.dry_run or made.delete_pool:
        return
    second = model.plan()
    assert second.create == 0
    assert {d.name for d in second.delete}.isdisjoint(d.name for d in made.delete)
    assert not any(event.reason == "ScaledUp" for event in second.events)


@pytest.mark.slow
@settings(max_examples=250, deadline=None)
@given(cases())
def test_every_plan_has_all_properties(case: Case) -> None:
    """Check all properties of one plan: to draw a case takes longer than to check it."""
    made = plan(*case, NOW)
    only_pods_of_the_pool_are_deleted_and_each_once(made, *case)
    a_pool_is_deleted_for_a_lease_that_this_process_saw_expire_alone(made, *case)
    creation_never_passes_what_is_wanted(made, *case)
    nothing_is_created_where_something_forbids_it(made, *case)
    a_template_that_never_worked_gets_few_pods(made, *case)
    the_order_of_the_list_makes_no_difference(made, *case)
    a_plan_whose_status_is_written_stays_the_plan(made, *case)
    nothing_is_planned_twice(made, *case)


def at_work(spec: dict[str, Any]) -> dict[str, Any]:
    """Return the spec with a master, which owns its workers."""
    strategy = spec["update"]["strategy"].replace("Recreate", "OnIdle")
    scale_down = {**spec["scaleDown"], "policy": "ReleasedOnly"}
    changed = {"master": MASTER, "suspend": False, "scaleDown": scale_down}
    return {**spec, **changed, "update": {"strategy": strategy}}


@given(cases(SPECS.map(at_work)))
def test_a_ready_worker_of_a_master_goes_only_when_released(case: Case) -> None:
    pool, pods, knowledge = case
    spec = pool.spec
    made = plan(pool, pods, knowledge, NOW)
    known = own(pool, pods)
    for deletion in made.delete:
        pod = known[deletion.name]
        if pod.live and pod.name not in spec.scale_down.release:
            late = deletion.reason == Reason.STARTUP_TIMEOUT
            assert pod.state is (PodState.STARTING if late else PodState.PENDING)
            assert deletion.resource_version == pod.resource_version
    assert not made.delete_pool


@pytest.mark.slow
@settings(max_examples=30, deadline=None, phases=NO_SHRINKING)
@given(cases())
def test_every_state_settles(case: Case) -> None:
    pool, pods, knowledge = case
    assume(not (pool.spec.master and pool.spec.master.lease_name))
    model = Model(
        document=pool.model_dump(mode="json", by_alias=True),
        pods={pod.name: pod for pod in pods},
        knowledge=replace(knowledge, address=ADDRESS, obstacles=(), refusal=None),
    )
    model.document["spec"]["suspend"] = False
    if model.plan().status and model.pool.status.failures.consecutive > 6:
        model.document["status"]["failures"]["specHash"] = "the user has corrected something"
    for _ in range(120):
        model.act()
        if pool.spec.master:
            model.release_what_the_operator_may_not_take()
        model.pass_time(5)
    model.document["spec"]["scaleDown"]["release"] = []
    model.act()
    settled = model.plan()
    assert (settled.create, settled.delete, settled.status) == (0, (), None)
    mine = [pod for pod in model.live if pod.owner == pool.metadata.uid]
    forgotten = pool.spec.idle and pool.spec.master and not pool.spec.replicas
    wanted = 0 if forgotten else pool.wanted
    assert len(mine) == wanted
    assert all(pod.state is PodState.READY for pod in mine)
    status = model.pool.status
    assert (status.ready_replicas, status.desired_replicas) == (wanted, wanted)
    if pool.spec.update.strategy != "OnDelete":
        assert status.updated_replicas == wanted
        assert status.phase == "Ready"


@settings(max_examples=50, deadline=None)
@given(
    failing=st.integers(1, 6),
    kills=st.lists(st.sampled_from(["", "before", "status", "delete", "create"]), max_size=40),
    completes=st.booleans(),
)
@example(failing=6, kills=["status"] * 40, completes=False)
@example(failing=6, kills=["status"] * 40, completes=True)
def test_each_end_is_counted_once_though_the_operator_dies(
    failing: int, kills: list[str], completes: bool
) -> None:
    model = Model(pool_document(replicas=failing), fails=not completes, completes=completes)
    failed: set[str] = set()
    for kill in [*kills, "", "", ""]:
        made = model.plan()
        steps = {"before": 0, "status": 1, "delete": 2, "create": 3}.get(kill, 3)
        for step in (model.write_status, model.delete, model.create)[:steps]:
            step(made)
        if kill:
            model.restart()
        model.pass_time()
        failed |= {pod.name for pod in model.pods.values() if pod.state is PodState.ENDED}
    model.write_status(model.plan())
    assert model.pool.status.failures.total == len(failed)


LIVES = st.lists(
    st.tuples(
        st.sampled_from(["replicas", "suspend", "template", "fails", "evict", "restart", "killed"]),
        NUMBERS,
        st.sampled_from([1, 1, 2, 5, 30]),
    ),
    max_size=30,
)


@settings(max_examples=100, deadline=None, phases=NO_SHRINKING)
@given(LIVES, st.sampled_from(["OnIdle", "Recreate"]))
def test_only_pods_that_the_cluster_ends_are_disrupted(
    life: list[tuple[str, int, int]], strategy: str
) -> None:
    model, evicted = Model(pool_document(replicas=4, update={"strategy": strategy})), 0
    for what, number, seconds in life:
        spec = model.document["spec"]
        if what == "replicas":
            spec["replicas"] = number
        elif what == "suspend":
            spec["suspend"] = not spec.get("suspend", False)
        elif what == "template":
            spec["template"]["metadata"] = {"labels": {"version": str(number)}}
        elif what == "fails":
            model.fails = not model.fails
        elif what == "restart":
            model.restart()
        elif what == "killed":
            made = model.plan()
            model.write_status(made)
            model.delete(made)
            model.restart()
        elif not spec.get("suspend", False):
            evicted += model.evict(number)
        model.act()
        model.pass_time(seconds)
    assert model.pool.status.failures.disrupted == evicted


@settings(max_examples=20, deadline=None)
@given(replicas=st.integers(1, 12), limit=st.integers(0, 4))
def test_a_failing_template_is_given_up_and_a_corrected_one_works(
    replicas: int, limit: int
) -> None:
    policy = {"backoffBaseSeconds": 1, "backoffMaxSeconds": 8, "backoffLimit": limit}
    model = Model(pool_document(replicas=replicas, failurePolicy=policy), fails=True)
    for _ in range(80):
        model.act()
        model.pass_time()
    assert not model.live
    assert model.created == min(3, replicas) * (limit + 1)
    assert model.pool.status.problems[0].reason == "BackoffLimitExceeded"
    assert len(model.pods) <= 3  # kept for their logs
    model.document["spec"]["template"]["metadata"] = {"labels": {"corrected": "yes"}}
    model.fails = False
    for _ in range(40):
        model.act()
        model.pass_time()
    assert model.pool.status.ready_replicas == replicas
    failures = model.pool.status.failures
    assert (failures.consecutive, failures.waves, failures.waiting) == (0, 0, 0)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(replicas=st.integers(1, 12))
def test_workers_that_always_complete_are_replaced_at_growing_delays(replicas: int) -> None:
    model = Model(pool_document(replicas=replicas, master=MASTER), completes=True)
    for _ in range(300):
        model.act()
        model.pass_time()
    status = model.pool.status
    # At once, and after 5, 10, 20, 40, 80 and 160 seconds; a tenth more at most.
    assert model.created <= 7 * replicas
    assert status.failures.total >= 5 * min(3, replicas)
    assert status.failures.consecutive == 0
    (found,) = status.problems
    assert (found.reason, found.severity, found.terminal) == ("Completed", "Warning", False)
    assert status.phase != "Failed"
    model.completes = False
    for _ in range(200):
        model.act()
        model.pass_time(10)
    status = model.pool.status
    assert (status.ready_replicas, status.failures.waves) == (replicas, 0)
    assert (status.problems, status.phase) == ((), "Ready")


@given(
    junk=ANYTHING,
    fields=st.dictionaries(
        st.sampled_from(
            [
                "failures",
                "problems",
                "conditions",
                "provenTemplateHash",
                "endpoint",
                "masterEpoch",
                "phase",
            ]
        ),
        ANYTHING,
    ),
)
def test_junk_in_the_status_is_written_over(junk: Any, fields: dict[str, Any]) -> None:
    for status in (junk, fields, {"failures": fields}, {"conditions": [fields]}):
        pool = FiberPool.read({**pool_document(replicas=2), "status": status})
        knowledge = Knowledge(address=ADDRESS, accepted=template_hash(pool))
        made = plan(pool, [], knowledge, NOW)
        assert made.status is not None
        again = plan(after(pool, made), [], knowledge, NOW)
        assert again.status is None


@given(
    key=st.sampled_from(["spec", "status", "metadata"]),
    field=st.sampled_from(["replicas", "template", "master", "update", "generation", "problems"]),
    junk=ANYTHING,
)
def test_junk_in_the_spec_deletes_no_pod(key: str, field: str, junk: Any) -> None:
    document = pool_document(replicas=2)
    document[key][field] = junk
    pods = [view(number, PodState.READY) for number in range(4)]
    errors: tuple[str, ...] = ()
    try:
        pool = FiberPool.read(document)
    except InvalidPool as error:
        errors = error.errors
    if not errors:
        plan(pool, pods, Knowledge(address=ADDRESS), NOW)
        return
    made = plan_unreadable(document, pods, errors, NOW)
    assert (made.create, made.delete) == (0, ())
    assert made.status is not None
    assert made.status["problems"][0]["reason"] == "InvalidSpec"
    document["status"] = made.status
    assert plan_unreadable(document, pods, errors, NOW + 5) == Plan()


@given(ANYTHING)
def test_a_document_of_junk_is_unreadable_and_no_more(junk: Any) -> None:
    document = junk if isinstance(junk, dict) else {"metadata": junk, "status": junk}
    assert plan_unreadable(document, [], ["all: is wrong"], NOW).delete == ()
