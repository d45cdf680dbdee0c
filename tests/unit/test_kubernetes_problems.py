"""Statuses as a program sees them: warnings, errors that end a wait, one line for people."""

from __future__ import annotations

import pickle
from typing import Any

import pytest

from fiber._backends.kubernetes.problems import (
    AgentRoute,
    PoolName,
    failure,
    new_problems,
    overdue,
    summary,
    unreachable,
)
from fiber_api.times import parse_time

POOL = PoolName("es-1a2b3c", "team")
SINCE = "2026-11-21T14:56:13Z"
NOW = parse_time(SINCE) + 14
WAY = AgentRoute("10.0.0.7:41337")
SCHEDULER = (
    "0/3 nodes are available: 1 node(s) had untolerated taint {node.kubernetes.io/disk: }, "
    "2 Insufficient cpu"
)


def problem(
    reason: str, message: str = "what, why, what to do.", *, pods: int = 0, **more: Any
) -> dict[str, Any]:
    of_pods = {"pod": "es-1a2b3c-0011223344", "count": pods} if pods else {"count": 1}
    told = {"reason": reason, "severity": "Error", "message": message, "since": SINCE}
    return {**told, **of_pods, **more}


def status(*problems: dict[str, Any], **counts: Any) -> dict[str, Any]:
    return {"observedGeneration": 2, "problems": list(problems), **counts}


UNSCHEDULABLE = problem(
    "Unschedulable",
    f"No node takes es-1a2b3c-0011223344: {SCHEDULER}. preemption: 0/3 nodes are available: 3 No "
    "preemption victims found. Add nodes, or ask for less in spec.template.",
    pods=30,
    severity="Warning",
)


class TestWarnings:
    def test_a_warning_has_pool_reason_number_and_message(self) -> None:
        (text,) = new_problems(POOL, {}, status(problem("ImagePullError", pods=3)))
        assert text == (
            "the FiberPool 'es-1a2b3c' in namespace 'team': ImagePullError (3 pods): "
            "what, why, what to do."
        )

    def test_a_warning_is_given_once(self) -> None:
        first = status(problem("ImagePullError", pods=1))
        second = status(problem("ImagePullError", "in other words", pods=3))
        assert list(new_problems(POOL, first, second)) == []

    def test_come_again_when_it_gets_worse_and_not_when_it_gets_better(self) -> None:
        mild = status(problem("ImagePullError", severity="Warning"))
        bad = status(problem("ImagePullError"))
        assert len(list(new_problems(POOL, mild, bad))) == 1
        assert list(new_problems(POOL, bad, mild)) == []

    def test_a_status_without_problems_gives_no_warning(self) -> None:
        assert list(new_problems(POOL, status(UNSCHEDULABLE), {})) == []

    @pytest.mark.parametrize("reason", ["LeaseNotFound", "MasterLost"])
    def test_a_program_gets_no_warning_about_its_own_lease(self, reason: str) -> None:
        """The operator may look between the pool's making and the Lease's."""
        found = status(problem(reason, severity="Warning"), desiredReplicas=2)
        assert list(new_problems(POOL, {}, found)) == []
        assert summary(found, NOW) == "0 of 2 pods ready"


class TestFailure:
    @pytest.mark.parametrize(
        "hopeless",
        [
            status(problem("InvalidTemplate", terminal=True), replicas=0),
            status(
                problem("ErrImageNeverPull", pods=1, terminal=True), replicas=3, pendingReplicas=3
            ),
            status(problem("BackoffLimitExceeded", pods=1, terminal=True), replicas=0),
            status(problem("QuotaExceeded"), replicas=0),
            status(problem("ImagePullError", pods=3), replicas=3, pendingReplicas=3),
            status(problem("CreateContainerConfigError", pods=3), replicas=3, pendingReplicas=3),
        ],
        ids=lambda one: str(one["problems"][0]["reason"]),
    )
    def test_an_impossible_pod_ends_the_wait(self, hopeless: dict[str, Any]) -> None:
        error = failure(POOL, hopeless, joined=0)
        assert error is not None
        reason = hopeless["problems"][0]["reason"]
        assert (error.pool, error.namespace, error.reason) == ("es-1a2b3c", "team", reason)
        assert f"in namespace 'team': {reason}: what, why, what to do." in str(error)
        assert str(pickle.loads(pickle.dumps(error))) == str(error)

    @pytest.mark.parametrize(
        "hopeful",
        [
            {},
            status(replicas=3, pendingReplicas=3),
            status(UNSCHEDULABLE, replicas=30, pendingReplicas=30),
            status(
                problem("ImagePullError", pods=3, severity="Warning"), replicas=3, pendingReplicas=3
            ),
            status(problem("ImagePullError", pods=2), replicas=3, pendingReplicas=3),
            status(problem("QuotaExceeded"), replicas=2, pendingReplicas=2),
            status(problem("OOMKilled", pods=1), replicas=0),
            status(problem("ContainerFailed", pods=1), replicas=0),
            status(problem("ApiUnavailable"), replicas=0),
        ],
        ids=lambda one: "-".join(p["reason"] for p in one.get("problems", ())) or "nothing",
    )
    def test_a_possible_pod_does_not_end_the_wait(self, hopeful: dict[str, Any]) -> None:
        assert failure(POOL, hopeful, joined=0) is None

    def test_a_pool_with_workers_goes_on(self) -> None:
        hopeless = status(problem("ErrImageNeverPull", pods=1, terminal=True), replicas=2)
        assert failure(POOL, {**hopeless, "pendingReplicas": 2}, joined=1) is None
        assert failure(POOL, {**hopeless, "pendingReplicas": 1}, joined=0) is None

    def test_a_suspended_pool_has_no_workers(self) -> None:
        suspended = status(conditions=[{"type": "Suspended", "status": "True"}])
        error = failure(POOL, suspended, joined=0)
        assert error is not None
        assert error.reason == "Suspended"
        awake = status(conditions=[{"type": "Suspended", "status": "False"}])
        assert failure(POOL, awake, joined=0) is None


class TestOverdue:
    def test_the_message_names_the_known_problem(self) -> None:
        late = status(UNSCHEDULABLE, desiredReplicas=30, pendingReplicas=30)
        error = overdue(POOL, late, 60.0, NOW, WAY)
        assert error.reason == "Unschedulable"
        for part in ("after 60 s", "0 of 30 pods ready", SCHEDULER, "Add nodes", "pod_timeout"):
            assert part in str(error)
        assert "kubectl describe fiberpool es-1a2b3c --namespace team" in str(error)

    def test_the_message_names_the_absence_of_problems(self) -> None:
        error = overdue(POOL, {}, 60.0, NOW, WAY)
        assert error.reason == "StartTimeout"
        assert "the operator has not looked at it yet. See kubectl describe" in str(error)

    def test_workers_that_run_and_did_not_join_cannot_reach_the_program(self) -> None:
        error = overdue(POOL, status(desiredReplicas=2, replicas=2), 60.0, NOW, WAY)
        assert "0 of 2 pods ready" in str(error)
        assert WAY.advice in str(error)


class TestUnreachable:
    def test_the_error_of_unreachable_pods_has_address_reasons_and_remedies(self) -> None:
        error = unreachable(POOL, status(replicas=3, pendingReplicas=1), 8.0, WAY)
        assert error.reason == "Unreachable"
        assert "no agent of its 2 running pods has reached this program at 10.0.0.7:41337" in str(
            error
        )
        for part in ("within 8 s", "NAT", "NetworkPolicy", "in a pod", "FIBER_LISTEN_HOST"):
            assert part in str(error)
        assert "its running pod has" in str(unreachable(POOL, status(replicas=1), 8.0, WAY))

    def test_the_error_of_a_pool_that_was_taken_over_names_its_last_master(self) -> None:
        way = AgentRoute("10.0.0.7:41337", displaced="laptop-8:4712")
        told = str(unreachable(POOL, status(replicas=1), 8.0, way))
        assert "Or the pods still serve laptop-8:4712" in told


class TestSummary:
    def test_a_summary_has_the_schedulers_message_and_its_age(self) -> None:
        counts = {"desiredReplicas": 50, "readyReplicas": 12, "pendingReplicas": 30}
        assert summary(status(UNSCHEDULABLE, **counts), NOW) == (
            f"12 of 50 pods ready, 30 pending: {SCHEDULER} (for 14 s)"
        )

    def test_a_summary_has_the_first_sentence_of_other_problems(self) -> None:
        message = "es-1 cannot get its image: manifest unknown. If the image is wrong, correct it."
        told = status(problem("ImagePullError", message, pods=1), desiredReplicas=1)
        assert summary(told, NOW) == (
            "0 of 1 pods ready: ImagePullError: es-1 cannot get its image: manifest unknown "
            "(for 14 s)"
        )

    def test_the_message_is_one_short_line(self) -> None:
        told = summary(status(problem("ContainerFailed", "x" * 500), problem("B")), NOW)
        assert len(told) < 180
        assert "..." in told
        assert "\n" not in summary(status(problem("A", "first\nsecond")), NOW)

    def test_a_summary_without_problems_has_the_counts(self) -> None:
        assert summary(status(desiredReplicas=2, readyReplicas=2), NOW) == "2 of 2 pods ready"

    def test_an_empty_status_is_named(self) -> None:
        assert summary({}, NOW) == "the operator has not looked at it yet"

    @pytest.mark.parametrize("since", [None, "yesterday"])
    def test_an_invalid_time_is_left_out(self, since: str | None) -> None:
        told = summary(status(problem("Forbidden", "no", since=since), desiredReplicas=1), NOW)
        assert told == "0 of 1 pods ready: Forbidden: no"

    def test_a_clock_that_is_behind_the_clusters_counts_from_now(self) -> None:
        told = summary(status(problem("Forbidden", "no")), NOW - 100)
        assert told.endswith("(for 0 s)")
