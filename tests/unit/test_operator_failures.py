"""Counting failed workers, and how long to wait after them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fiber_api.v1alpha1 import FailurePolicy, FiberPoolStatus
from fiber_operator.planning.failures import Account, Record, account, delay
from fiber_operator.planning.pods import PodView, State, Trouble
from unit.operator_cluster_model import view
from unit.operator_objects import NOW, name_of

POLICY = FailurePolicy(backoff_base_seconds=5, backoff_max_seconds=60, backoff_limit=3)


def count(record: Record, *pods: PodView, now: float = NOW, **other: Any) -> Account:
    known: dict[str, Any] = {
        "expected": (),
        "late": (),
        "desired": 4,
        "template_hash": "new",
        "spec_hash": "spec",
        "policy": POLICY,
        "seed": "uid",
    }
    return account(record, pods, now=now, **{**known, **other})


def failed(number: int, *, created: float = NOW - 60, ago: float = 0, **fields: Any) -> PodView:
    known = {"trouble": Trouble.APPLICATION, "reason": "Error", "exit_code": 1, "ran": 1.0}
    known |= {"created": created, "since": NOW - ago, "template_hash": "new"}
    return view(number, State.ENDED, **{**known, **fields})


def ready(number: int, *, created: float = NOW, since: float = NOW) -> PodView:
    return view(number, State.READY, created=created, since=since, template_hash="new")


@given(rounds=st.integers(-1, 10**9), seed=st.text())
def test_waits_double_up_to_the_longest_and_a_tenth_more(rounds: int, seed: str) -> None:
    due = min(60, 5 * 2 ** min(max(rounds - 1, 0), 10))
    assert due <= delay(POLICY, rounds, seed) <= due * 1.1
    assert delay(POLICY, rounds, seed) == delay(POLICY, rounds, seed)


def test_pools_that_fail_together_come_apart() -> None:
    assert len({delay(POLICY, 1, str(pool)) for pool in range(20)}) == 20


def test_pods_that_fail_together_are_one_round() -> None:
    found = count(Record(), failed(1), failed(2, reason="OOMKilled", exit_code=137, ago=-1))
    record = found.record
    assert (record.total, record.consecutive) == (2, 1)
    assert (record.last_reason, record.last_exit_code) == ("OOMKilled", 137)
    assert record.counted == {name_of(1), name_of(2)}
    assert [pod.name for pod in found.failed] == [name_of(1), name_of(2)]
    due = record.waits_until(POLICY, NOW)
    assert due is not None
    assert NOW + 5 <= due <= NOW + 7
    assert record.waits_until(POLICY, due) is None


def test_more_of_the_same_round_neither_counts_nor_waits_again() -> None:
    first = count(Record(), failed(1), ready(2, created=NOW - 60)).record
    second = count(first, failed(1), failed(2), now=NOW + 20).record
    assert (second.total, second.consecutive) == (2, 1)
    assert second.next_create_time == first.next_create_time
    third = count(second, failed(3, created=NOW + 10), now=NOW + 30).record
    assert (third.total, third.consecutive) == (3, 2)
    assert third.next_create_time is not None
    assert third.next_create_time >= NOW + 40


def test_nothing_is_counted_twice_and_names_that_are_gone_are_forgotten() -> None:
    pods = failed(1), failed(2)
    once = count(Record(), *pods).record
    assert count(once, *pods, now=NOW + 9).record == once
    assert not count(once, *pods).news
    assert count(once).record.counted == frozenset()


def test_what_is_expected_is_not_counted() -> None:
    ending = view(2, State.TERMINATING)
    found = count(Record(), failed(1), ending, expected={name_of(1), name_of(2)})
    assert (found.record.total, found.record.disrupted, found.news) == (0, 0, False)
    assert count(Record(), ending).record.disrupted == 1


@pytest.mark.parametrize("consecutive", [3, 4])
def test_the_limit_is_passed_not_reached(consecutive: int) -> None:
    assert Record(consecutive=consecutive).exhausted(POLICY) is (consecutive > 3)


def failing(**fields: Any) -> Record:
    known = {"consecutive": 2, "total": 2, "spec_hash": "spec"}
    times = {"last_time": NOW, "newest_created": NOW - 60, "next_create_time": NOW + 10}
    return Record(**{**known, **times, **fields})


def test_a_new_worker_that_stays_ready_for_a_minute_ends_the_row() -> None:
    pod = ready(1, created=NOW + 12, since=NOW + 15)
    early = count(failing(), pod, now=NOW + 74)
    assert (early.record.consecutive, early.again) == (2, NOW + 75)
    record = count(failing(), pod, now=NOW + 75).record
    assert (record.consecutive, record.next_create_time, record.total) == (0, None, 2)


def test_workers_that_were_ready_before_do_not_unless_no_more_are_wanted() -> None:
    old = ready(1, created=NOW - 90, since=NOW - 80)
    assert count(failing(), old, now=NOW + 500).record.consecutive == 2
    assert count(failing(), old, desired=1, now=NOW + 59).record.consecutive == 2
    assert count(failing(), old, desired=1, now=NOW + 60).record.consecutive == 0


def test_past_the_limit_only_the_user_ends_it() -> None:
    pod = ready(1, created=NOW + 12, since=NOW + 15)
    past = failing(consecutive=4)
    assert count(past, pod, desired=0, now=NOW + 9000).record.consecutive == 4
    record = count(past, spec_hash="corrected").record
    assert (record.consecutive, record.next_create_time, record.spec_hash) == (0, None, "corrected")


def test_a_template_is_proven_by_a_ready_worker() -> None:
    assert count(Record(), ready(1)).record.proven == "new"
    assert count(Record(), ready(1), template_hash="newer").record.proven is None


def test_failing_at_once_takes_the_proof_back_until_ready_lasts() -> None:
    proven = Record(proven="new", spec_hash="spec")
    assert count(proven, failed(1, ran=30.0)).record.proven == "new"
    assert count(proven, failed(1), ready(2)).record.proven == "new"
    record = count(proven, failed(1)).record
    assert record.proven is None
    again = ready(2, created=NOW + 20, since=NOW + 22)
    assert count(record, again, now=NOW + 23).record.proven is None
    assert count(record, again, now=NOW + 32).record.proven == "new"


def test_a_record_survives_the_status() -> None:
    record = replace(
        failing(), counted=frozenset({name_of(1), "b", "es"}), last_reason="Error", proven="new"
    )
    status = FiberPoolStatus(failures=record.failures("es"), proven_template_hash=record.proven)
    document = status.model_dump(mode="json", by_alias=True)
    assert Record.read(FiberPoolStatus.model_validate(document), "es", NOW) == record


def test_times_that_have_not_come_yet_are_none_of_ours() -> None:
    status = FiberPoolStatus(
        failures=failing(last_time=NOW + 9999, newest_created=NOW + 9999).failures("es")
    )
    record = Record.read(status, "es", NOW)
    assert (record.last_time, record.newest_created) == (None, None)
    assert failing(next_create_time=NOW + 9999).waits_until(POLICY, NOW) is None


@pytest.mark.parametrize(
    ("due", "consecutive", "shown"),
    [
        (NOW + 60, 2, NOW + 60),
        (NOW - 60, 2, NOW - 60),
        (NOW + 9999, 2, None),
        (NOW + 60, 4, None),  # past the limit: nothing is created then either
    ],
)
def test_a_time_for_which_nobody_waits_is_not_kept(
    due: float, consecutive: int, shown: float | None
) -> None:
    kept = count(failing(next_create_time=due, consecutive=consecutive)).record
    assert kept.next_create_time == shown


def test_sums_stay_what_a_status_may_hold() -> None:
    full = failing(total=2**31 - 1, disrupted=2**31 - 1, consecutive=2**31 - 1)
    ended = view(3, State.ENDED, trouble=Trouble.DISRUPTED)
    record = count(full, failed(1), failed(2, created=NOW + 5), ended).record
    found = record.failures("es")
    assert (found.total, found.disrupted, found.consecutive) == (2**31 - 1,) * 3


def test_what_the_operator_deletes_is_not_disrupted_and_what_others_delete_is() -> None:
    record = Record(deleting=frozenset({name_of(1), name_of(3)}))
    pods = [view(number, State.TERMINATING) for number in (1, 2)]
    found = count(record, *pods)
    assert [pod.name for pod in found.disrupted] == [name_of(2)]
    assert found.record.deleting == {name_of(1)}
    assert count(found.record).record.deleting == frozenset()


def test_a_pod_that_was_to_be_deleted_and_is_not_is_like_any_other() -> None:
    """Its deletion came too late: it changed before."""
    record = Record(deleting=frozenset({name_of(1), name_of(2)}), counted=frozenset({name_of(2)}))
    assert [pod.name for pod in count(record, failed(1)).failed] == [name_of(1)]
    kept = count(record, ready(2)).record
    assert count(kept, failed(2)).record.total == 1


def test_what_has_no_room_in_the_record_is_counted_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fiber_operator.planning.failures.NAMES", 5)
    monkeypatch.setattr("fiber_operator.planning.failures.ROUND", 2)
    pods = [failed(number) for number in range(12)]
    record, totals = Record(), []
    while pods:
        found = count(record, *pods)
        record = found.record
        assert len(record.counted) <= 5
        totals.append(record.total)
        pods = [pod for pod in pods if pod.name not in record.counted]
    assert totals == [5, 10, 12]
    assert record.consecutive == 1
    stuck = [view(number, State.TERMINATING) for number in range(20, 29)]
    full = count(record, *stuck).record
    assert full.disrupted == 5
    assert count(full, *stuck).record == full
    assert count(full, *stuck, failed(1)).record.total == 13


def completed(number: int, *, created: float = NOW - 60) -> PodView:
    return failed(number, created=created, trouble=Trouble.COMPLETED, exit_code=0, ran=12.0)


def test_ends_with_0_are_counted_and_wait_from_the_second_round_on() -> None:
    first = count(Record(), completed(1), completed(2))
    assert [pod.name for pod in first.completed] == [name_of(1), name_of(2)]
    assert first.news
    record = first.record
    assert (record.completed, record.completions, record.total) == (2, 1, 0)
    assert record.waits_until(POLICY, NOW) is None
    same = count(record, completed(1), completed(2), completed(3), now=NOW + 5).record
    assert (same.completed, same.completions) == (3, 1)
    again = count(same, completed(4, created=NOW + 6), now=NOW + 20).record
    assert (again.completed, again.completions) == (4, 2)
    due = again.waits_until(POLICY, NOW + 20)
    assert due is not None
    assert NOW + 25 <= due <= NOW + 27
    assert not replace(again, completions=10**6).exhausted(POLICY)


def test_ends_with_0_are_forgiven_after_a_while_and_by_another_spec() -> None:
    record = count(Record(spec_hash="spec"), completed(1)).record
    kept = count(record, now=NOW + 599)
    assert (kept.record.completions, kept.again) == (1, NOW + 600)
    assert count(record, now=NOW + 600).record.completions == 0
    assert count(record, spec_hash="corrected").record.completions == 0
    waiting = replace(record, next_create_time=NOW + 50)
    assert count(waiting).again == NOW + 650
