"""Counting failed workers, how soon they are replaced, and when a pool is given up."""

from __future__ import annotations

import heapq
import itertools
import random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber_api.v1alpha1 import FailurePolicy, Failures
from fiber_operator.planning.failures import Account, account, delay, given_up, held_back_until
from fiber_operator.planning.pods import PodState, PodView, Trouble
from unit.operator_cluster_model import view
from unit.operator_objects import NOW, name_of

POLICY = FailurePolicy(backoff_base_seconds=5, backoff_max_seconds=60, backoff_limit=3)


def count(
    before: Failures, *pods: PodView, now: float = NOW, proven: str | None = None, **other: Any
) -> Account:
    known: dict[str, Any] = {
        "expected": (),
        "late": (),
        "desired": 4,
        "template_hash": "new",
        "spec_hash": "spec",
        "policy": POLICY,
        "seed": "uid",
    }
    return account(before, proven, pods, now=now, **{**known, **other})


def failed(number: int, *, created: float = NOW - 60, ago: float = 0, **fields: Any) -> PodView:
    known = {"trouble": Trouble.APPLICATION, "reason": "Error", "exit_code": 1, "ran": 1.0}
    known |= {"created": created, "since": NOW - ago, "template_hash": "new"}
    return view(number, PodState.ENDED, **{**known, **fields})


def lived(number: int, **fields: Any) -> PodView:
    """Return a pod that failed after it had worked."""
    return failed(number, **{"was_ready": True, "ran": 900.0, **fields})


def ready(number: int, *, since: float = NOW) -> PodView:
    return view(number, PodState.READY, created=since, since=since, template_hash="new")


@given(waves=st.integers(-1, 10**9), seed=st.text())
def test_delays_double_up_to_the_longest_with_a_tenth_of_jitter(waves: int, seed: str) -> None:
    due = min(60, 5 * 2 ** min(max(waves - 1, 0), 10))
    assert due <= delay(POLICY, waves, seed) <= due * 1.1
    assert delay(POLICY, waves, seed) == delay(POLICY, waves, seed)


def test_pools_that_fail_together_come_apart() -> None:
    assert len({delay(POLICY, 1, str(pool)) for pool in range(20)}) == 20


def test_pods_that_fail_together_are_one_wave() -> None:
    found = count(Failures(), failed(1), failed(2, reason="OOMKilled", exit_code=137, ago=-1))
    told = found.failures
    assert (told.total, told.waves, told.consecutive, told.waiting) == (2, 1, 1, 2)
    assert (told.last_reason, told.last_exit_code) == ("OOMKilled", 137)
    assert told.counted == (name_of(1), name_of(2))
    assert [pod.name for pod in found.failed] == [name_of(1), name_of(2)]
    due = held_back_until(told, NOW)
    assert due is not None
    assert NOW + 5 <= due <= NOW + 7
    assert held_back_until(told, due) is None
    assert count(told, failed(1), failed(2), now=due).failures.waiting == 0


def test_failures_during_the_delay_belong_to_the_same_wave_and_later_ones_to_the_next() -> None:
    first = count(Failures(), failed(1)).failures
    second = count(first, failed(1), failed(2), now=NOW + 4).failures
    assert (second.total, second.waves, second.waiting) == (2, 1, 2)
    assert second.next_create_time == first.next_create_time
    third = count(second, failed(3), now=NOW + 30).failures
    assert (third.total, third.waves, third.consecutive, third.waiting) == (3, 2, 2, 1)
    assert third.next_create_time is not None
    assert third.next_create_time >= NOW + 40


def test_no_failure_is_counted_twice_and_old_names_are_forgotten() -> None:
    pods = failed(1), failed(2)
    once = count(Failures(), *pods).failures
    again = count(once, *pods, now=NOW + 4)
    assert (again.failures, again.failed) == (once, ())
    assert count(once).failures.counted == ()


def test_expected_ends_are_not_counted() -> None:
    found = count(Failures(), failed(1), failed(2), expected={name_of(1), name_of(2)})
    assert (found.failures.total, found.failed) == (0, ())


@pytest.mark.parametrize("consecutive", [3, 4])
def test_the_limit_is_passed_not_reached(consecutive: int) -> None:
    assert given_up(Failures(consecutive=consecutive), POLICY) is (consecutive > 3)


def failing(**fields: Any) -> Failures:
    """Two waves; those that failed are replaced ten seconds from now."""
    known = {"consecutive": 2, "waves": 2, "total": 2, "waiting": 1, "spec_hash": "spec"}
    return Failures(**{**known, "next_create_time": NOW + 10, **fields})


def test_a_new_worker_that_stays_ready_for_a_minute_ends_the_waves() -> None:
    pod = ready(1, since=NOW + 15)
    early = count(failing(), pod, now=NOW + 74)
    assert (early.failures.waves, early.recovery_at) == (2, NOW + 75)
    found = count(failing(), pod, now=NOW + 75).failures
    assert (found.waves, found.next_create_time, found.total) == (0, None, 2)
    assert found.consecutive == 2, "one of four is fewer than half"


def test_workers_that_were_ready_before_do_not_unless_no_more_are_wanted() -> None:
    old = ready(1, since=NOW - 80)
    assert count(failing(), old, now=NOW + 500).failures.waves == 2
    assert count(failing(), old, desired=1, now=NOW + 58).failures.waves == 2
    assert count(failing(), old, desired=1, now=NOW + 60).failures.waves == 0


def test_half_of_the_wanted_workers_ready_for_a_minute_keeps_a_pool_alive() -> None:
    two = ready(1, since=NOW - 60), ready(2, since=NOW - 60)
    last = failing(consecutive=3, next_create_time=NOW - 1)
    assert count(last, *two, failed(3)).failures.consecutive == 0
    assert count(last, *two, failed(3), desired=5).failures.consecutive == 4
    assert count(last, *two, failed(3), now=NOW - 1).failures.consecutive == 4
    assert count(last, ready(1, since=NOW - 60), lived(3)).failures.consecutive == 0
    assert count(last, *two).failures.consecutive == 0


def test_half_of_which_one_always_fails_is_replaced_ever_more_slowly_and_not_given_up() -> None:
    found, now = Failures(spec_hash="spec"), NOW
    two = ready(1, since=NOW - 200), ready(2, since=NOW - 200)
    waits = []
    for number in range(10, 20):
        found = count(found, *two, failed(number), now=now).failures
        assert found.next_create_time is not None
        waits.append(found.next_create_time - now)
        now = found.next_create_time + 3
    assert waits[:4] == sorted(waits[:4])
    assert min(waits[4:]) >= 60
    assert not given_up(found, POLICY)


def test_a_wave_of_workers_that_had_lived_is_the_first() -> None:
    last = failing(next_create_time=NOW - 1)
    assert count(last, lived(1)).failures.waves == 1
    assert count(last, lived(1, was_ready=False)).failures.waves == 3
    assert count(last, lived(1), failed(2)).failures.waves == 3


def test_a_pool_that_is_given_up_has_no_waiting_failures() -> None:
    found = count(failing(consecutive=3, next_create_time=NOW - 1), failed(1)).failures
    assert (found.consecutive, found.waiting, found.next_create_time) == (4, 0, None)
    assert count(found, failed(1)).failures == found


def test_past_the_limit_only_the_user_ends_it() -> None:
    all_four = [ready(number, since=NOW + 15) for number in range(4)]
    past = failing(consecutive=4)
    found = count(past, *all_four, desired=0, now=NOW + 9000).failures
    assert (found.consecutive, found.waves, found.next_create_time) == (4, 2, None)
    found = count(past, spec_hash="corrected").failures
    assert (found.consecutive, found.waves, found.waiting, found.next_create_time) == (
        0,
        0,
        0,
        None,
    )
    assert found.spec_hash == "corrected"


def test_a_large_pool_whose_workers_leak_goes_on() -> None:
    """500 workers, each of which is killed for its memory after a quarter of an hour or so."""
    rnd, policy, wanted = random.Random(7), FailurePolicy(), 500
    found, numbers = Failures(spec_hash="spec"), itertools.count()
    workers: dict[int, PodView] = {}
    ends: list[tuple[float, int]] = []

    def create(now: float) -> None:
        number = next(numbers)
        workers[number] = ready(number, since=now + 10)
        heapq.heappush(ends, (now + 10 + rnd.expovariate(1 / 900), number))

    for _ in range(wanted):
        create(NOW - 100)
    fewest, now = wanted, NOW
    while now < NOW + 900:
        due = held_back_until(found, now)
        now = max(now + 1, min(ends[0][0], due or ends[0][0]))
        pods = dict(workers)
        while ends[0][0] <= now:
            end, number = heapq.heappop(ends)
            start = workers.pop(number).since
            pods[number] = lived(number, ran=end - start, was_ready=end > start)
        made = count(found, *pods.values(), desired=wanted, policy=policy, now=now)
        found = made.failures
        assert not given_up(found, policy)
        fewest = min(fewest, len(workers))
        for _ in range(wanted - len(workers) - made.held_back):
            create(now)
    assert found.total > 400
    assert fewest > 400


def test_a_template_is_proven_by_a_ready_worker() -> None:
    assert count(Failures(), ready(1)).proven == "new"
    assert count(Failures(), ready(1), template_hash="newer").proven is None


def test_failing_at_once_takes_the_proof_back_until_ready_lasts() -> None:
    assert count(Failures(), failed(1, ran=30.0), proven="new").proven == "new"
    assert count(Failures(), failed(1), ready(2, since=NOW - 10), proven="new").proven == "new"
    found = count(Failures(), failed(1), proven="new")
    assert found.proven is None
    again = ready(2, since=NOW + 22)
    assert count(found.failures, again, now=NOW + 23).proven is None
    assert count(found.failures, again, now=NOW + 32).proven == "new"


def test_a_delay_that_the_policy_does_not_allow_is_dropped() -> None:
    found = count(failing(next_create_time=NOW + 9999)).failures
    assert (found.next_create_time, found.waiting) == (None, 0)
    found = count(failing(consecutive=4)).failures
    assert found.next_create_time is None, "past the limit nothing is created then either"
    assert count(failing(next_create_time=NOW - 60)).failures.next_create_time == NOW - 60


def test_sums_stay_within_the_limits_of_the_status() -> None:
    most = 2**31 - 1
    full = failing(
        **dict.fromkeys(("total", "disrupted", "consecutive", "waves", "waiting"), most),
        next_create_time=NOW - 1,
    )
    ended = view(3, PodState.ENDED, trouble=Trouble.DISRUPTED)
    found = count(full, failed(1), failed(2, created=NOW + 5), ended).failures
    assert (found.total, found.disrupted, found.consecutive, found.waves) == (most,) * 4


def test_a_pod_that_the_cluster_ends_counts_once_as_disrupted_and_is_replaced_at_once() -> None:
    drained = view(1, PodState.TERMINATING, trouble=Trouble.DISRUPTED)
    evicted = view(2, PodState.ENDED, trouble=Trouble.DISRUPTED)
    deleted = view(3, PodState.TERMINATING)
    marked = view(4, PodState.READY, trouble=Trouble.DISRUPTED)
    found = count(Failures(), drained, evicted, deleted, marked)
    assert [pod.name for pod in found.disrupted] == [name_of(1), name_of(2)]
    assert (found.failures.disrupted, found.failures.total, found.held_back) == (2, 0, 0)
    assert count(found.failures, drained, evicted).failures.disrupted == 2


def test_a_pod_that_was_late_and_became_ready_is_like_any_other() -> None:
    late = view(1, PodState.STARTING, template_hash="new")
    first = count(Failures(), late, late={late.name}).failures
    assert (first.total, first.last_reason) == (1, "StartupTimeout")
    kept = count(first, ready(1)).failures
    assert count(kept, failed(1)).failures.total == 2


def test_failures_beyond_the_statuss_room_are_counted_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("fiber_operator.planning.failures.NAMES", 6)
    stuck = [
        view(number, PodState.TERMINATING, trouble=Trouble.DISRUPTED) for number in range(20, 29)
    ]
    full = count(Failures(), *stuck).failures
    assert full.disrupted == 3
    assert count(full, *stuck).failures == full.model_copy(update={"spec_hash": "spec"})
    pods, totals, found = [failed(number) for number in range(12)], [], full
    while pods:
        made = count(found, *stuck, *pods)
        found = made.failures
        assert len(found.counted) <= 6
        assert made.held_back == 12
        totals.append(found.total)
        pods = [pod for pod in pods if pod.name not in found.counted]
    assert totals == [3, 6, 9, 12]
    assert found.waves == 1


def completed(number: int) -> PodView:
    return failed(number, trouble=Trouble.COMPLETED, exit_code=0, ran=12.0)


def test_workers_that_end_with_0_wait_like_others_and_are_never_given_up() -> None:
    found, now = Failures(), NOW
    for number in range(8):
        made = count(found, completed(number), now=now)
        found = made.failures
        assert (made.held_back, found.waves, found.consecutive) == (1, number + 1, 0)
        assert found.next_create_time is not None
        now = found.next_create_time
    assert found.total == 8
    mixed = count(found, completed(8), failed(9), now=now).failures
    assert (mixed.waves, mixed.consecutive) == (9, 1)
