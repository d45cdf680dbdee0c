"""Vector environments whose workers are on hosts that are drained: they move."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import fiber
from faults import drained
from faults.drained import Site, note, notes, patient
from faults.program import wait_for
from fiber.vector import VectorEnv
from patience import PATIENCE
from vector_envs import Faulty

pytestmark = [
    pytest.mark.may_leak("the operator's connections, for as long as the cluster is there"),
    pytest.mark.timeout(300),
]

played_cluster, site = drained.played_cluster, drained.site
grace, settings = drained.grace, drained.settings

GOOD, WAIT = Faulty.GOOD, Faulty.WAIT
UNDER_WAY = [GOOD, GOOD, WAIT, GOOD]
REASON = "(Drained|Deleted): "


@pytest.fixture
def gate(tmp_path: Path) -> Path:
    """File that ``WAIT`` waits for."""
    return tmp_path / "gate"


@pytest.fixture
def env(site: Site, gate: Path) -> Iterator[VectorEnv]:
    """Make four environments in two workers, each on a separate host, after a step."""
    env = VectorEnv([partial(Faulty, gate)] * 4, num_workers=2)
    try:
        env.reset()
        env.step([GOOD] * 4)
        assert host_of(env, 0) != host_of(env, 2)
        yield env
    finally:
        env.close(terminate=True)


def host_of(env: VectorEnv, number: int) -> str:
    hello = env._dispatcher._worker_of[number].hello
    assert hello is not None
    return hello.host


def works(env: VectorEnv) -> None:
    assert env.reset()[0].tolist() == [[0]] * 4
    assert env.step([GOOD] * 4)[0].tolist() == [[1]] * 4


def end_step_and_make_another(env: VectorEnv) -> tuple[Any, Any]:
    return env.step_wait(timeout=PATIENCE), env.step([GOOD] * 4)


@patient
def test_a_worker_answers_the_step_that_it_is_at_and_moves(
    env: VectorEnv, site: Site, gate: Path
) -> None:
    env.step_async(UNDER_WAY)
    agent = site.drain(host_of(env, 2))
    gate.touch()
    with pytest.warns(RuntimeWarning, match=f"environments 2 to 3 replaced: .*{REASON}"):
        (observations, _, _, truncations, _), after = end_step_and_make_another(env)
    assert observations.tolist() == [[2]] * 4
    assert not truncations.any()
    observations, rewards, _, truncations, infos = after
    assert observations.tolist() == [[3], [3], [2], [2]]
    assert rewards.tolist() == [1, 1, 0, 0]
    assert truncations.tolist() == [False, False, True, True]
    assert "is about to go: " in infos["restarted"][2]
    wait_for(lambda: agent.lost is not None)  # the host is idle: it need not wait for the grace
    works(env)


@patient
def test_idle_workers_move_before_the_next_call(env: VectorEnv, site: Site) -> None:
    before = env.call("pid")
    agent = site.drain(host_of(env, 2))
    with pytest.warns(RuntimeWarning, match="environments 2 to 3 replaced: "):
        pids = env.call("pid")
    assert pids[:2] == before[:2]
    assert not set(pids[2:]) & set(before)
    wait_for(lambda: agent.lost is not None)
    works(env)


def test_a_step_that_does_not_end_in_time_ends_its_episodes_and_no_others(
    env: VectorEnv, site: Site
) -> None:
    env.step_async(UNDER_WAY)
    site.drain(host_of(env, 2))
    with pytest.warns(RuntimeWarning, match=f"(?s)environments 2 to 3 replaced: .*{REASON}"):
        observations, _, _, truncations, _ = env.step_wait(timeout=PATIENCE)
    assert observations.tolist() == [[2], [2], [1], [1]]
    assert truncations.tolist() == [False, False, True, True]
    works(env)


@pytest.mark.parametrize("settings", [{"disruptions": 0}])
def test_too_many_disruptions_are_an_error_with_both_counts(env: VectorEnv, site: Site) -> None:
    env.step_async(UNDER_WAY)
    site.drain(host_of(env, 2))
    with pytest.raises(fiber.WorkerDied, match=REASON) as caught:
        env.step_wait(timeout=PATIENCE)
    assert (caught.value.attempts, caught.value.disruptions) == (0, 1)
    assert "its worker died 0 times, and the cluster ended it once" in str(caught.value)


def make_at_the_second_try(directory: Path) -> Faulty:
    note(directory, "begun")
    wait_for(lambda: len(notes(directory)) > 1, 10 * PATIENCE)
    return Faulty()


def test_environments_are_made_elsewhere_if_their_making_does_not_end_in_time(
    site: Site, tmp_path: Path
) -> None:
    def drain_the_first() -> None:
        wait_for(lambda: bool(notes(tmp_path)))
        (host,) = site.busy()
        site.drain(host)

    with ThreadPoolExecutor(1) as threads:
        drained = threads.submit(drain_the_first)
        with pytest.warns(RuntimeWarning, match="environment 0 replaced"):
            env = VectorEnv([partial(make_at_the_second_try, tmp_path)])
        drained.result()
    try:
        assert env.reset()[0].tolist() == [[0]]
        assert "restarted" not in env.step([GOOD])[4]
    finally:
        env.close(terminate=True)
