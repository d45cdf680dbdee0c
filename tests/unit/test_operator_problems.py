"""Problems as a person reads them: what, why, what to do."""

from __future__ import annotations

from typing import Any

import pytest

from fiber_api.names import Reason
from fiber_api.v1alpha1 import FiberPool, FiberPoolStatus, Problem
from fiber_operator.planning import messages, plans
from fiber_operator.planning.manifests import spec_hash, template_hash
from fiber_operator.planning.plans import Obstacle, PodRefusal
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
)

Json = dict[str, Any]


def problem(pool: FiberPool, *pods: Json, **more: Any) -> Problem:
    """The only problem."""
    (found,) = status_of(pool, *pods, **more).problems
    return found


def then(pool: FiberPool, status: FiberPoolStatus) -> FiberPool:
    return pool.model_copy(update={"status": status})


POOL = make_pool(replicas=1)


def test_a_pool_without_problems_says_so() -> None:
    status = status_of(POOL, running(1))
    assert status.problems == ()
    assert status.phase == "Ready"


# -- Pods that do not start


@pytest.mark.parametrize(
    ("reason", "named", "terminal"),
    [
        ("InvalidImageName", "InvalidImageName", True),
        ("ErrImageNeverPull", "ErrImageNeverPull", True),
        ("CreateContainerConfigError", "CreateContainerConfigError", False),
        ("CreateContainerError", "CreateContainerError", False),
        ("RunContainerError", "RunContainerError", False),
        ("PreStartHookError", "CreateContainerError", False),
    ],
)
def test_a_problem_that_waiting_does_not_mend_is_an_error_at_once(
    reason: str, named: str, terminal: bool
) -> None:
    found = problem(POOL, waiting(1, reason, 'secret "token" not found.'))
    assert (found.reason, found.severity, found.terminal) == (named, "Error", terminal)
    assert found.pod == name_of(1)
    assert f'{reason}: secret "token" not found. ' in found.message
    assert "spec.template" in found.message


def test_an_image_that_would_run_as_root_is_reported_with_the_remedy() -> None:
    kubelet = "container has runAsNonRoot and image will run as root"
    found = problem(POOL, waiting(1, "CreateContainerConfigError", kubelet))
    assert found.terminal
    assert "runAsUser" in found.message


def test_an_image_that_cannot_be_pulled_is_a_warning_first() -> None:
    pull = 'failed to pull "x": manifest unknown'
    pods = [waiting(1, "ErrImagePull", pull), waiting(2, "ErrImagePull", pull)]
    pool = make_pool(replicas=3)
    first = status_of(pool, *pods)
    (found,) = first.problems
    assert (found.reason, found.severity, found.count) == ("ImagePullError", "Warning", 2)
    assert not found.terminal
    assert "manifest unknown" in found.message
    second = status_of(then(pool, first), waiting(1, "ImagePullBackOff", "Back-off: " + pull))
    assert second.problems[0].severity == "Error"
    assert second.problems[0].since == found.since
    assert second.phase == "Degraded"
    lasting = status_of(then(pool, first), *pods, now=NOW + 30)
    assert lasting.problems[0].severity == "Error"
    assert status_of(then(pool, second), *pods).problems[0].severity == "Error"


def test_the_cause_is_kept_when_the_kubelet_only_says_that_it_waits() -> None:
    first = status_of(POOL, waiting(1, "ErrImagePull", "manifest unknown"))
    found = problem(then(POOL, first), waiting(1, "ImagePullBackOff", 'Back-off pulling image "x"'))
    assert "manifest unknown" in found.message


def test_unschedulable_is_a_warning_in_the_schedulers_words_until_it_takes_too_long() -> None:
    said = "0/2 nodes are available: 2 Insufficient nvidia.com/gpu."
    pods = [unschedulable(1, said, age=9), unschedulable(2, said, age=8)]
    pool = make_pool(replicas=2)
    found = problem(pool, *pods)
    assert (found.reason, found.severity, found.count) == ("Unschedulable", "Warning", 2)
    assert said.rstrip(".") in found.message
    late = problem(pool, *pods, now=NOW + 900)
    assert (late.severity, late.terminal) == ("Error", False)


def test_problems_that_only_events_show_are_reported() -> None:
    mount = 'FailedMount: MountVolume.SetUp failed for volume "data": secret "token" not found'
    pod = waiting(1, "ContainerCreating", age=8)
    found = problem(POOL, pod, warnings={name_of(1): mount})
    assert (found.reason, found.severity) == ("FailedMount", "Warning")
    assert 'secret "token" not found' in found.message


def test_a_pod_that_takes_too_long_is_an_error() -> None:
    found = problem(POOL, waiting(1, "ContainerCreating", age=900))
    assert (found.reason, found.severity) == ("StartupTimeout", "Error")
    assert "900 s" in found.message


def test_a_worker_that_ran_and_was_never_ready_is_reported_with_all_details() -> None:
    pod = running(1, age=902, ready=False)
    pod["status"]["conditions"][0]["message"] = "containers with unready status: [worker]"
    found = problem(POOL, pod)
    assert (found.reason, found.severity) == ("StartupTimeout", "Error")
    said = "did not become ready: containers with unready status: [worker]. It was deleted"
    assert said in found.message
    assert "kubectl describe pod" not in found.message
    assert "kubectl logs --follow --selector fiber.dev/pool=es." in found.message
    assert "It is not replaced before" in found.message
    probe = "Unhealthy: Readiness probe failed: HTTP probe failed with statuscode: 503"
    assert probe in problem(POOL, pod, warnings={name_of(1): probe}).message


def test_a_worker_that_lost_its_readiness_is_a_warning() -> None:
    pod = running(1)
    pod["status"]["conditions"] = [condition("Ready", "False", ago=5, message="node silent")]
    found = problem(POOL, pod)
    assert (found.reason, found.severity) == ("NotReady", "Warning")
    assert "node silent" in found.message


# -- Pods that fail


def test_a_failed_worker_shows_its_exit_code_and_its_last_lines() -> None:
    found = problem(POOL, ended(1, code=3, ran=12, message="Traceback:\nKeyError: 'x'"))
    assert (found.reason, found.severity, found.terminal) == ("ContainerFailed", "Error", False)
    assert f"{name_of(1)} exited with code 3 after 12 s" in found.message
    assert found.message.endswith("Traceback:\nKeyError: 'x'")


@pytest.mark.parametrize(
    ("end", "reason", "said"),
    [
        ({"reason": "Error", "message": "No module named fiber"}, "ContainerFailed", "code 1"),
        ({"reason": "StartError", "message": "no such file"}, "RunContainerError", "no such file"),
    ],
)
def test_a_failed_init_container_is_named_with_the_advice_to_install_fiber(
    end: Json, reason: str, said: str
) -> None:
    pod = pod_document(1, phase="Failed")
    state = {"terminated": {"exitCode": 1, **end}}
    pod["status"]["initContainerStatuses"] = [{"name": "fiber-identity", "state": state}]
    found = problem(POOL, pod)
    assert found.reason == reason
    assert f"The init container fiber-identity of {name_of(1)}" in found.message
    assert said in found.message
    assert end["message"] in found.message
    assert "Install Fiber in the image" in found.message
    pod["status"]["initContainerStatuses"][0]["name"] = "mine"
    assert "fiber-identity" not in problem(POOL, pod).message


def test_a_signal_is_named() -> None:
    assert "code 139 (SIGSEGV)" in problem(POOL, ended(1, code=139)).message


def test_out_of_memory_names_the_limit() -> None:
    worker = {"name": "worker", "image": "i", "resources": {"limits": {"memory": "512Mi"}}}
    pool = make_pool(replicas=1, template={"spec": {"containers": [worker]}})
    found = problem(pool, ended(1, code=137, reason="OOMKilled"))
    assert found.reason == "OOMKilled"
    assert "512Mi" in found.message
    assert "resources.limits.memory" in found.message


def test_a_command_that_is_no_agent_is_recognized() -> None:
    found = problem(POOL, ended(1, code=0, ran=0, reason="Completed"))
    assert found.reason == "Completed"
    assert "python -m fiber.agent" in found.message


def test_workers_that_exit_with_0_repeatedly_cause_one_warning_with_advice() -> None:
    pool, now = make_pool(replicas=1, master=MASTER), NOW
    for number in (1, 2):
        pod = ended(number, code=0, age=20 + NOW - now, ran=12, ago=NOW - now)
        status = status_of(pool, pod, now=now)
        pool, now = then(pool, status), now + 40
        assert bool(status.problems) is (number == 2)
    (found,) = status.problems
    assert (found.severity, found.count, found.pod) == ("Warning", 2, name_of(2))
    for said in ("exit code 0 after 12 s", "python -m fiber.agent", "lostGraceSeconds", "before"):
        assert said in found.message
    assert status_of(pool, now=now).problems == (found,)
    assert status_of(pool, running(3, age=-900), now=now + 970).problems == ()


def test_a_failure_is_reported_before_a_completion_in_the_same_wave() -> None:
    pods = ended(1, ago=5), ended(2, code=0, ran=100)
    first = status_of(POOL, *pods)
    (found,) = first.problems
    assert (found.reason, found.pod) == ("ContainerFailed", name_of(1))
    assert first.failures.last_reason == "Error"
    assert status_of(then(POOL, first), *pods) == first


def test_a_program_that_is_not_in_the_image_is_hopeless() -> None:
    said = 'exec: "pyton": executable file not found in $PATH'
    found = problem(POOL, ended(1, code=128, reason="StartError", message=said))
    assert (found.reason, found.terminal) == ("RunContainerError", True)
    assert said in found.message
    busy = problem(POOL, ended(1, code=128, reason="StartError", message="cannot allocate memory"))
    assert not busy.terminal


def test_a_pod_that_a_node_turned_away_shows_the_nodes_words() -> None:
    found = problem(POOL, pod_document(1, phase="Failed", reason="OutOfcpu", message="no cpu left"))
    assert "OutOfcpu" in found.message
    assert "no cpu left" in found.message


def test_a_worker_that_took_too_much_disk_shows_the_nodes_words() -> None:
    evicted = ended(1, code=137)
    said = 'Usage of EmptyDir volume "x" exceeds the limit "1Gi"'
    evicted["status"] |= {"reason": "Evicted", "message": said}
    found = problem(POOL, evicted)
    assert f"failed: Evicted: {said}" in found.message
    assert "last lines" not in found.message


def test_failures_are_summed_up_while_they_last() -> None:
    pool = make_pool(replicas=2)
    first = status_of(pool, ended(1), ended(2))
    assert first.problems[0].count == 2
    unchanged = status_of(then(pool, first), ended(1), ended(2), now=NOW + 3)
    assert unchanged.problems == first.problems
    gone = status_of(then(pool, first), now=NOW + 3)
    assert gone.problems == first.problems
    more = status_of(then(pool, first), ended(1), ended(2), ended(3, ago=-2), now=NOW + 5)
    assert (more.problems[0].count, more.problems[0].pod) == (3, name_of(3))


@pytest.mark.parametrize(
    ("known", "said"),
    [
        ({}, "A worker failed, and its pod is gone."),
        ({"lastReason": "Error"}, "A worker failed (Error), and its pod is gone."),
        (
            {"lastReason": "OOMKilled", "lastExitCode": 137},
            "A worker failed (OOMKilled, exit code 137), and its pod is gone.",
        ),
    ],
)
def test_the_message_of_a_failure_has_the_known_fields(known: Json, said: str) -> None:
    edited = {"failures": {"waves": 2, "specHash": spec_hash(POOL), **known}}
    found = problem(then(POOL, FiberPoolStatus.model_validate(edited)))
    assert found.reason == "ContainerFailed"
    assert found.message == f"{said} See the events of the pool with kubectl describe fiberpool es."


def test_a_wait_that_is_not_waited_for_is_not_shown() -> None:
    far = {"waves": 1, "specHash": spec_hash(POOL), "nextCreateTime": "2099-01-01T00:00:00Z"}
    pool = then(POOL, FiberPoolStatus.model_validate({"failures": far}))
    status = status_of(pool, ended(1))
    assert status.failures.next_create_time is None or status.failures.next_create_time < NOW + 999
    assert "2099" not in str(status.model_dump(mode="json"))
    assert status_of(pool).failures.next_create_time is None


def test_a_problem_is_not_there_since_a_time_that_has_not_come() -> None:
    first = status_of(POOL, waiting(1, "ErrImagePull", "no such image"))
    (told,) = first.problems
    (ready,) = (c for c in first.conditions if c.type == "Ready")
    edited = first.model_copy(
        update={
            "problems": (told.model_copy(update={"since": NOW + 10**9}),),
            "conditions": (ready.model_copy(update={"last_transition_time": NOW + 10**9}),),
        }
    )
    pod = waiting(1, "ErrImagePull", "no such image")
    second = status_of(then(POOL, edited), pod, now=NOW + 5)
    assert second.problems[0].since == NOW + 5
    assert {c.last_transition_time for c in second.conditions} == {NOW + 5}
    third = status_of(then(POOL, second), pod, now=NOW + 35)
    assert third.problems[0].severity == "Error", "it was a warning for half a minute"


def test_past_the_limit_the_first_problem_names_the_remedy() -> None:
    pool = make_pool(replicas=1, failurePolicy={"backoffLimit": 0})
    status = status_of(pool, ended(1, code=7))
    limit, cause = status.problems
    assert (limit.reason, limit.terminal) == ("BackoffLimitExceeded", True)
    assert "exited with code 7" in limit.message
    assert "spec.suspend" in limit.message
    for named in ("template", "processesPerPod", "failurePolicy", "update", "a new epoch"):
        assert named in limit.message
    assert cause.reason == "ContainerFailed"
    assert status.phase == "Failed"


# -- The pool


@pytest.mark.parametrize(
    ("code", "said", "reason", "terminal"),
    [
        (403, "pods is forbidden: exceeded quota: team, requested: cpu=1", "QuotaExceeded", False),
        (403, 'violates PodSecurity "restricted:latest"', "Forbidden", True),
        (422, "spec.containers[0].image: Required value", "InvalidTemplate", True),
    ],
)
def test_a_refusal_is_reported_in_the_api_servers_words(
    code: int, said: str, reason: str, terminal: bool
) -> None:
    refused = PodRefusal(template_hash(POOL), code, said, NOW)
    status = status_of(POOL, refusal=refused)
    (found,) = status.problems
    assert (found.reason, found.terminal, found.severity) == (reason, terminal, "Error")
    assert said in found.message
    (accepted,) = (c.status for c in status.conditions if c.type == "Accepted")
    assert accepted == ("True" if reason == "QuotaExceeded" else "False")


def test_an_account_that_is_not_there_yet_is_a_warning_first_and_tried_again_at_once() -> None:
    said = 'pods "es-1" is forbidden: error looking up service account team/default: not found'
    refused = PodRefusal(template_hash(POOL), 403, said, NOW, 5, True)
    status = status_of(POOL, refusal=refused)
    (found,) = status.problems
    assert (found.reason, found.severity, found.terminal) == ("Forbidden", "Warning", False)
    later = status_of(then(POOL, status), refusal=refused, now=NOW + 31)
    assert later.problems[0].severity == "Error"
    assert plan_of(POOL, refusal=refused).requeue_at == NOW + 1


def test_a_full_quota_is_no_problem_to_a_pool_that_wants_no_more() -> None:
    refused = PodRefusal(template_hash(POOL), 403, "exceeded quota", NOW)
    assert status_of(POOL, running(1), refusal=refused).problems == ()


def test_a_namespace_that_is_deleted_is_no_problem_of_its_pools() -> None:
    said = "unable to create new content in namespace team because it is being terminated"
    refused = PodRefusal(template_hash(POOL), 403, f'pods "es-1" is forbidden: {said}', NOW)
    assert status_of(POOL, refusal=refused).problems == ()


def test_an_obstacle_is_reported_unchanged() -> None:
    obstacle = Obstacle(Reason.NAME_TAKEN, "the Service es-fiber is another's", True)
    found = problem(POOL, running(1), obstacles=(obstacle,))
    assert (found.reason, found.message) == ("NameTaken", obstacle.message)
    assert found.terminal


def test_a_lost_master_is_reported_with_the_consequence() -> None:
    pool = make_pool(replicas=1, master={**MASTER, "leaseName": "es"}, onLost="Delete")
    expired = plans.LeaseVerdict(alive=False)
    found = problem(pool, running(1), master=expired)
    assert found.reason == "MasterLost"
    for said in ("10.0.3.7:41337", "epoch 1", "laptop-7:4711", "onLost is Delete"):
        assert said in found.message


def test_a_lost_lease_is_reported() -> None:
    pool = make_pool(replicas=1, master={**MASTER, "leaseName": "es"})
    seen = then(pool, status_of(pool, running(1), master=plans.LeaseVerdict(alive=True)))
    found = problem(seen, running(1), master=plans.LeaseVerdict(alive=False, missing=True))
    assert found.reason == "MasterLost"
    assert "The Lease es did not exist for 30 s" in found.message


def test_a_missing_lease_is_reported_with_the_remedy() -> None:
    pool = make_pool(replicas=1, master={**MASTER, "leaseName": "se"})
    first = status_of(pool, running(1), master=plans.LeaseVerdict(missing=True))
    (found,) = first.problems
    assert (found.reason, found.severity) == ("LeaseNotFound", "Warning")
    for said in ("no Lease se in this namespace", "10.0.3.7:41337", "correct spec.master.lease"):
        assert said in found.message
    (alive,) = (c for c in first.conditions if c.type == "MasterAlive")
    assert (alive.status, alive.reason) == ("Unknown", "LeaseNotFound")
    missing = plans.LeaseVerdict(missing=True)
    later = problem(then(pool, first), running(1), now=NOW + 30, master=missing)
    assert (later.reason, later.severity) == ("LeaseNotFound", "Error")


def test_a_master_of_the_other_address_family_is_reported() -> None:
    pool = make_pool(replicas=1, master={**MASTER, "host": "fd00::7"})
    found = problem(pool, running(1))
    assert (found.reason, found.terminal) == ("InvalidSpec", True)
    assert "fd00::7" in found.message
    assert "delete the Service es-fiber" in found.message


def test_a_master_of_either_family_of_the_service_is_right() -> None:
    addresses = "10.96.1.2:7070,[fd00:96::2]:7070"
    for host in ("10.0.3.7", "fd00::7"):
        pool = make_pool(replicas=1, master={**MASTER, "host": host})
        assert status_of(pool, running(1), address=addresses).problems == ()


def test_names_that_are_no_workers_are_reported() -> None:
    release = {"release": [name_of(1), "es-web", "other-0000000001"]}
    found = problem(make_pool(replicas=1, scaleDown=release), running(2))
    assert (found.reason, found.severity, found.count) == ("InvalidRelease", "Warning", 2)
    assert "es-web, other-0000000001" in found.message


def test_the_worst_comes_first_and_there_are_ten_at_most() -> None:
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
