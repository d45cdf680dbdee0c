"""Problems in the status: what happened, why, and what to do."""

from __future__ import annotations

from typing import Any

import pytest

from fiber_api.names import Reason
from fiber_api.v1alpha1 import FiberPool, FiberPoolStatus
from fiber_operator.planning import messages
from fiber_operator.planning.manifests import spec_hash, template_hash
from fiber_operator.planning.plans import LeaseVerdict, Obstacle, PodRefusal
from unit.operator_objects import (
    MASTER,
    NOW,
    condition,
    ended,
    make_pool,
    name_of,
    plan_of,
    pod_document,
    running,
    status_of,
    unschedulable,
    waiting,
    with_plan,
)

Json = dict[str, Any]
POOL = make_pool(replicas=1)
TWO = make_pool(replicas=2)
LEASED = {**MASTER, "leaseName": "es"}
EXPIRED, MISSING = LeaseVerdict(alive=False), LeaseVerdict(missing=True)


def after(pool: FiberPool, *pods: Json, **more: Any) -> FiberPool:
    """Return the pool with the status that the operator wrote for these pods."""
    return with_plan(pool, plan_of(pool, *pods, **more))


def counted(**failures: Any) -> FiberPool:
    """Return the pool with these failures in its status."""
    known = {"failures": {"specHash": spec_hash(POOL), **failures}}
    return POOL.model_copy(update={"status": FiberPoolStatus.model_validate(known)})


def refused(code: int, message: str, *more: Any) -> PodRefusal:
    return PodRefusal(template_hash(POOL), code, message, NOW, *more)


def row(name: str, problem: str, *pods: Json, pool: FiberPool = POOL, **seen: Any) -> Any:
    """Return a pool, its pods, what the operator knows, and the only problem of its status.

    The problem is written as its reason, its severity, and ``terminal`` if it is.  Parts of its
    message follow; those after ``not`` are absent, and ``(end)`` is its end.
    """
    return pytest.param(pool, pods, seen, problem, id=name)


def unready(message: str) -> Json:
    pod = running(1)
    pod["status"]["conditions"] = [condition("Ready", "False", ago=5, message=message)]
    return pod


def never_ready() -> Json:
    pod = running(1, age=902, ready=False)
    pod["status"]["conditions"][0]["message"] = "containers with unready status: [worker]"
    return pod


def init_failed(container: str, reason: str, message: str) -> Json:
    end = {"terminated": {"exitCode": 1, "reason": reason, "message": message}}
    statuses = [{"name": container, "state": end}]
    return pod_document(1, phase="Failed", initContainerStatuses=statuses)


def evicted(message: str) -> Json:
    pod = ended(1, code=137)
    pod["status"] |= {"reason": "Evicted", "message": message}
    return pod


def limited_to(memory: str) -> FiberPool:
    worker = {"name": "worker", "image": "i", "resources": {"limits": {"memory": memory}}}
    return make_pool(replicas=1, template={"spec": {"containers": [worker]}})


TOKEN = 'secret "token" not found'
ROOT = "container has runAsNonRoot and image will run as root"
PULL = 'failed to pull "x": manifest unknown'
PULLS = [waiting(number, "ErrImagePull", PULL) for number in (1, 2)]
WAITS = waiting(1, "ImagePullBackOff", 'Back-off pulling image "x"')
PULLING = after(TWO, *PULLS)
GPU = "0/2 nodes are available: 2 Insufficient nvidia.com/gpu"
HOMELESS = [unschedulable(1, f"{GPU}.", age=9), unschedulable(2, f"{GPU}.", age=8)]
MOUNT = f'FailedMount: MountVolume.SetUp failed for volume "data": {TOKEN}'
PROBE = "Unhealthy: Readiness probe failed: HTTP probe failed with statuscode: 503"
NO_PROGRAM = 'exec: "pyton": executable file not found in $PATH'
DISK = 'Usage of EmptyDir volume "x" exceeds the limit "1Gi"'

DO_NOT_START = [
    *(
        row(
            f"waiting-{reason}",
            f"{found}; of {name_of(1)}; {reason}: {TOKEN}. ; spec.template",
            waiting(1, reason, f"{TOKEN}."),
        )
        for reason, found in [
            ("InvalidImageName", "InvalidImageName Error terminal"),
            ("ErrImageNeverPull", "ErrImageNeverPull Error terminal"),
            ("CreateContainerConfigError", "CreateContainerConfigError Error"),
            ("CreateContainerError", "CreateContainerError Error"),
            ("RunContainerError", "RunContainerError Error"),
            ("PreStartHookError", "CreateContainerError Error"),
        ]
    ),
    row(
        "root",
        "CreateContainerConfigError Error terminal; runAsUser",
        waiting(1, "CreateContainerConfigError", ROOT),
    ),
    row("pull", "ImagePullError Warning; 2 pods; manifest unknown", *PULLS, pool=TWO),
    row("pull-30-s", "ImagePullError Error; manifest unknown", *PULLS, pool=PULLING, now=NOW + 30),
    # The kubelet says that it waits.  The cause is from the status.
    row("pull-waits", "ImagePullError Error; manifest unknown", WAITS, pool=PULLING),
    row("pull-again", "ImagePullError Error", *PULLS, pool=after(PULLING, WAITS)),
    row("no-node", f"Unschedulable Warning; 2 pods; {GPU}", *HOMELESS, pool=TWO),
    row("no-node-900-s", "Unschedulable Error", *HOMELESS, pool=TWO, now=NOW + 900),
    row(
        "event",
        f"FailedMount Warning; {TOKEN}",
        waiting(1, "ContainerCreating", age=8),
        warnings={name_of(1): MOUNT},
    ),
    row("silence", "StartupTimeout Error; 900 s", waiting(1, "ContainerCreating", age=900)),
    row(
        "never-ready",
        "StartupTimeout Error; did not become ready: containers with unready status: [worker]. It "
        "was deleted; kubectl logs --follow --selector fiber.dev/pool=es.; It is not replaced "
        "before; not kubectl describe pod",
        never_ready(),
    ),
    row(
        "never-ready-by-its-probe",
        f"StartupTimeout Error; {PROBE}",
        never_ready(),
        warnings={name_of(1): PROBE},
    ),
    row("no-longer-ready", "NotReady Warning; node silent", unready("node silent")),
]

GONE: list[tuple[str, Json]] = [
    ("", {}),
    (" (Error)", {"lastReason": "Error"}),
    (" (OOMKilled, exit code 137)", {"lastReason": "OOMKilled", "lastExitCode": 137}),
]

FAIL = [
    row(
        "exit-code",
        f"ContainerFailed Error; {name_of(1)} exited with code 3 after 12 s; "
        "Traceback:\nKeyError: 'x' (end)",
        ended(1, code=3, ran=12, message="Traceback:\nKeyError: 'x'"),
    ),
    row(
        "no-fiber",
        f"ContainerFailed Error; The init container fiber-identity of {name_of(1)}; code 1; No "
        "module named fiber; Install Fiber in the image",
        init_failed("fiber-identity", "Error", "No module named fiber"),
    ),
    row(
        "no-python",
        f"RunContainerError Error; The init container fiber-identity of {name_of(1)}; no "
        "such file; Install Fiber in the image",
        init_failed("fiber-identity", "StartError", "no such file"),
    ),
    row(
        "another-init-container",
        "ContainerFailed Error; not fiber-identity",
        init_failed("mine", "Error", "no data"),
    ),
    row("signal", "ContainerFailed Error; code 139 (SIGSEGV)", ended(1, code=139)),
    row(
        "memory",
        "OOMKilled Error; 512Mi; resources.limits.memory",
        ended(1, code=137, reason="OOMKilled"),
        pool=limited_to("512Mi"),
    ),
    row(
        "no-agent",
        "Completed Error; python -m fiber.agent",
        ended(1, code=0, ran=0, reason="Completed"),
    ),
    row(
        "no-program",
        f"RunContainerError Error terminal; {NO_PROGRAM}",
        ended(1, code=128, reason="StartError", message=NO_PROGRAM),
    ),
    row(
        "no-memory-to-start",
        "RunContainerError Error",
        ended(1, code=128, reason="StartError", message="cannot allocate memory"),
    ),
    row(
        "refused-by-its-node",
        "ContainerFailed Error; OutOfcpu; no cpu left",
        pod_document(1, phase="Failed", reason="OutOfcpu", message="no cpu left"),
    ),
    row("disk", f"ContainerFailed Error; failed: Evicted: {DISK}; not last lines", evicted(DISK)),
    row("two", "ContainerFailed Error; 2 pods", ended(1), ended(2), pool=TWO),
    row(
        "a-failure-and-an-end",
        f"ContainerFailed Error; of {name_of(1)}",
        ended(1, ago=5),
        ended(2, code=0, ran=100),
    ),
    *(
        row(
            f"gone-{number}",
            f"ContainerFailed Error; A worker failed{known}, and its pod is gone. See the events "
            "of the pool with kubectl describe fiberpool es. (end)",
            pool=counted(waves=2, **failures),
        )
        for number, (known, failures) in enumerate(GONE)
    ),
]

QUOTA = "pods is forbidden: exceeded quota: team, requested: cpu=1"
POLICY = 'violates PodSecurity "restricted:latest"'
INVALID = "spec.containers[0].image: Required value"
ACCOUNT = 'pods "es-1" is forbidden: error looking up service account team/default: not found'
NO_ACCOUNT = refused(403, ACCOUNT, 5, True)
TAKEN = Obstacle(Reason.NAME_TAKEN, "the Service es-fiber is another's", True)
HAD_A_LEASE = after(make_pool(replicas=1, master=LEASED), master=LeaseVerdict(alive=True))
NO_LEASE = make_pool(replicas=1, master={**MASTER, "leaseName": "se"})
RELEASE = {"release": [name_of(1), "es-web", "other-0000000001"]}

OF_THE_POOL = [
    row("quota", f"QuotaExceeded Error; {QUOTA}", refusal=refused(403, QUOTA)),
    row("policy", f"Forbidden Error terminal; {POLICY}", refusal=refused(403, POLICY)),
    row("template", f"InvalidTemplate Error terminal; {INVALID}", refusal=refused(422, INVALID)),
    row("account", "Forbidden Warning", refusal=NO_ACCOUNT),
    row(
        "account-31-s",
        "Forbidden Error",
        pool=after(POOL, refusal=NO_ACCOUNT),
        refusal=NO_ACCOUNT,
        now=NOW + 31,
    ),
    row("name", f"NameTaken Error terminal; {TAKEN.message}", running(1), obstacles=(TAKEN,)),
    row(
        "lost-master",
        "MasterLost Error; 10.0.3.7:41337; epoch 1; laptop-7:4711; onLost is Delete",
        running(1),
        pool=make_pool(replicas=1, master=LEASED, onLost="Delete"),
        master=LeaseVerdict(alive=False),
    ),
    row(
        "lost-lease",
        "MasterLost Error; The Lease es did not exist for 30 s",
        running(1),
        pool=HAD_A_LEASE,
        master=LeaseVerdict(alive=False, missing=True),
    ),
    row(
        "no-lease",
        "LeaseNotFound Warning; no Lease se in this namespace; 10.0.3.7:41337; correct "
        "spec.master.lease",
        pool=NO_LEASE,
        master=MISSING,
    ),
    row(
        "no-lease-30-s",
        "LeaseNotFound Error",
        running(1),
        pool=after(NO_LEASE, master=MISSING),
        master=MISSING,
        now=NOW + 30,
    ),
    row(
        "address-family",
        "InvalidSpec Error terminal; fd00::7; delete the Service es-fiber",
        running(1),
        pool=make_pool(replicas=1, master={**MASTER, "host": "fd00::7"}),
    ),
    row(
        "release",
        "InvalidRelease Warning; 2 pods; es-web, other-0000000001",
        running(2),
        pool=make_pool(replicas=1, scaleDown=RELEASE),
    ),
]


@pytest.mark.parametrize(("pool", "pods", "seen", "expected"), [*DO_NOT_START, *FAIL, *OF_THE_POOL])
def test_the_status_has_one_problem(
    pool: FiberPool, pods: list[Json], seen: Json, expected: str
) -> None:
    (found,) = status_of(pool, *pods, **seen).problems
    kind, *parts = expected.split("; ")
    assert f"{found.reason} {found.severity}{' terminal' * found.terminal}" == kind
    text = f"{found.count} pods, of {found.pod}: {found.message} (end)"
    for part in parts:
        unsaid = part.startswith("not ")
        assert (part.removeprefix("not ") in text) is not unsaid


TERMINATING = (
    'pods "es-1" is forbidden: unable to create new content in namespace team because it is '
    "being terminated"
)
BOTH_FAMILIES = "10.96.1.2:7070,[fd00:96::2]:7070"


@pytest.mark.parametrize(
    ("pool", "pods", "seen"),
    [
        pytest.param(POOL, [running(1)], {}, id="ready"),
        pytest.param(POOL, [running(1)], {"refusal": refused(403, QUOTA)}, id="full-of-its-own"),
        pytest.param(POOL, [], {"refusal": refused(403, TERMINATING)}, id="terminating-namespace"),
        *(
            (make_pool(replicas=1, master={**MASTER, "host": host}), [], {"address": BOTH_FAMILIES})
            for host in ("10.0.3.7", "fd00::7")
        ),
    ],
)
def test_the_status_has_no_problem(pool: FiberPool, pods: list[Json], seen: Json) -> None:
    assert status_of(pool, *pods, **seen).problems == ()


# -- Problems in the course of time


def test_workers_that_end_well_again_and_again_are_a_warning() -> None:
    pool, now = make_pool(replicas=1, master=MASTER), NOW
    for number in (1, 2):
        pool = after(
            pool, ended(number, code=0, age=20 + NOW - now, ran=12, ago=NOW - now), now=now
        )
        assert bool(pool.status.problems) is (number == 2)
        now += 40
    (found,) = pool.status.problems
    assert (found.severity, found.count, found.pod) == ("Warning", 2, name_of(2))
    for said in ("exit code 0 after 12 s", "python -m fiber.agent", "lostGraceSeconds", "before"):
        assert said in found.message
    assert status_of(pool, now=now).problems == (found,)
    assert status_of(pool, running(3, age=-900), now=now + 970).problems == ()


def test_failures_are_summed_up_while_they_last() -> None:
    first = after(TWO, ended(1), ended(2))
    for pods in ([ended(1), ended(2)], []):
        assert status_of(first, *pods, now=NOW + 3).problems == first.status.problems
    (more,) = status_of(first, ended(1), ended(2), ended(3, ago=-2), now=NOW + 5).problems
    assert (more.count, more.pod) == (3, name_of(3))
    both = ended(1, ago=5), ended(2, code=0, ran=100)
    mixed = after(POOL, *both)
    assert mixed.status.failures.last_reason == "Error"
    assert status_of(mixed, *both) == mixed.status


def test_a_problem_keeps_its_time_and_none_is_in_the_future() -> None:
    pod = waiting(1, "ErrImagePull", "no such image")
    pool = after(POOL, pod)
    (told,) = pool.status.problems
    assert status_of(pool, WAITS, now=NOW + 2).problems[0].since == told.since
    (ready,) = (c for c in pool.status.conditions if c.type == "Ready")
    future = NOW + 10**9
    edited = {
        "problems": (told.model_copy(update={"since": future}),),
        "conditions": (ready.model_copy(update={"last_transition_time": future}),),
    }
    pool = pool.model_copy(update={"status": pool.status.model_copy(update=edited)})
    pool = after(pool, pod, now=NOW + 5)
    assert pool.status.problems[0].since == NOW + 5
    assert {c.last_transition_time for c in pool.status.conditions} == {NOW + 5}
    third = status_of(pool, pod, now=NOW + 35)
    assert third.problems[0].severity == "Error", "it was a warning for half a minute"


def test_a_wait_that_is_too_long_is_not_shown() -> None:
    pool = counted(waves=1, nextCreateTime="2099-01-01T00:00:00Z")
    status = status_of(pool, ended(1))
    assert status.failures.next_create_time is None or status.failures.next_create_time < NOW + 999
    assert "2099" not in str(status.model_dump(mode="json"))
    assert status_of(pool).failures.next_create_time is None


def test_a_pool_that_is_given_up_names_the_remedy_first() -> None:
    status = status_of(make_pool(replicas=1, failurePolicy={"backoffLimit": 0}), ended(1, code=7))
    limit, cause = status.problems
    assert (limit.reason, limit.terminal) == ("BackoffLimitExceeded", True)
    assert (cause.reason, status.phase) == ("ContainerFailed", "Failed")
    assert "exited with code 7" in limit.message
    fields = ("template", "processesPerPod", "failurePolicy", "update", "a new epoch")
    for named in ("spec.suspend", *fields):
        assert named in limit.message


def test_at_most_ten_problems_are_reported_the_worst_first() -> None:
    reasons = ["ErrImagePull", "InvalidImageName", "CreateContainerError", "RunContainerError"]
    pods = [waiting(number, reason) for number, reason in enumerate(reasons)]
    warnings = {name_of(number): f"Failed{number}: x" for number in range(20, 30)}
    silent = [waiting(number, "ContainerCreating", age=8) for number in range(20, 30)]
    status = status_of(make_pool(replicas=30), *pods, unschedulable(10), *silent, warnings=warnings)
    assert len(status.problems) == 10
    found = [problem.reason for problem in status.problems]
    assert found[:3] == ["InvalidImageName", "CreateContainerError", "RunContainerError"]


@pytest.mark.parametrize(
    ("said", "ending"),
    [
        ("Readiness probe failed: ", ": Readiness probe failed"),
        ("no such file.", ": no such file"),
        ("  ", ""),
        ("", ""),
    ],
)
def test_the_words_of_the_cluster_end_a_clause(said: str, ending: str) -> None:
    assert messages.quoted(said) == ending
