"""Comparison of models and API server: both refuse the same manifests and name the field."""

from __future__ import annotations

import pytest

from contract.bad_manifests import BAD, BAD_UPDATES, DUPLICATE_RELEASE, GOOD, MASTER, Bad, BadUpdate
from fiber_api.v1alpha1 import FiberPool, InvalidPool


def test_the_manifest_that_they_are_made_from_is_good() -> None:
    assert FiberPool.read(GOOD).metadata.name == "es"


@pytest.mark.parametrize("bad", BAD, ids=lambda bad: bad.name)
def test_a_rule_that_is_broken_is_named(bad: Bad) -> None:
    with pytest.raises(InvalidPool) as caught:
        FiberPool.read(bad.manifest())
    assert any(all(word in error for word in bad.words) for error in caught.value.errors)
    assert all(error in str(caught.value) for error in caught.value.errors)


@pytest.mark.parametrize("update", BAD_UPDATES, ids=lambda update: update.name)
def test_rules_about_a_change_leave_both_ends_alone(update: BadUpdate) -> None:
    # A reader of one object does not know its earlier state.
    assert FiberPool.read(update.first()) != FiberPool.read(update.second())


def test_a_pod_that_is_released_twice_does_no_harm() -> None:
    assert FiberPool.read(DUPLICATE_RELEASE.manifest()).spec.scale_down.release == ("es-1", "es-1")


def test_an_epoch_below_one_that_was_is_refused() -> None:
    master = {**MASTER, "epoch": 2}
    pool = {**GOOD, "spec": {**GOOD["spec"], "master": master}}
    assert FiberPool.read({**pool, "status": {"masterEpoch": 2}}).status.master_epoch == 2
    with pytest.raises(InvalidPool, match=r"spec\.master\.epoch: must not be below status"):
        FiberPool.read({**pool, "status": {"masterEpoch": 3}})
    # Without the master, only the record of its work remains.
    assert FiberPool.read({**GOOD, "status": {"masterEpoch": 3}}).spec.master is None
