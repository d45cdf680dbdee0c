"""Hosts that are drained, as pods are by SIGTERM: no finished work is lost."""

from __future__ import annotations

import signal
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import pytest

import fiber
from faults import drained
from faults.drained import PodSite, Site, note, notes, patient, played
from faults.program import wait_for
from fiber._hub import client
from fiber.errors import ConnectionClosed, MemberLost
from fiber.managers import BaseManager
from patience import PATIENCE

pytestmark = [
    pytest.mark.may_leak("the operator's connections, for as long as the cluster is there"),
    pytest.mark.timeout(300),
]

played_cluster, site = drained.played_cluster, drained.site
grace, settings = drained.grace, drained.settings


def ran(directory: Path, times: int) -> bool:
    return len(notes(directory)) >= times


def begin_and_wait(task: tuple[Path, object]) -> str:
    """Run until there is a file, and return the host."""
    directory, number = task
    note(directory, str(number))
    while not (directory / "go").exists():
        time.sleep(0.01)
    return str(number)


def begin_somewhere_and_wait(task: tuple[Path, int]) -> str:
    directory, number = task
    return begin_and_wait((directory, f"{number}@{client.host()}"))


def block_unless_it_ran(directory: Path) -> int:
    """Block the first time, return the second."""
    note(directory, "run")
    while len(notes(directory)) < 2:
        time.sleep(0.01)
    return len(notes(directory))


def block(directory: Path) -> None:
    note(directory, "run")
    time.sleep(10 * PATIENCE)


def hosts_of(pool: Any) -> set[str]:
    return {handle.host for handle in list(pool._executor._scheduler.workers.members)}


def wait_at_sigterm(directory: Path, ready: Any) -> None:
    """Handle SIGTERM as a program in an ordinary pod does."""
    signal.signal(signal.SIGTERM, lambda *_: note(directory, "heard"))
    ready.set()
    wait_for(lambda: "heard" in notes(directory))
    note(directory, "saved")


def go_on(directory: Path, ready: Any) -> None:
    ready.set()
    wait_for((directory / "go").exists)


def listen(directory: Path, word: str = "heard") -> None:
    signal.signal(signal.SIGTERM, lambda *_: note(directory, word))


class Tally:
    def __init__(self) -> None:
        self.count = 0

    def add(self) -> int:
        self.count += 1
        return self.count

    def host(self) -> str:
        return client.host()


class Tallies(BaseManager):
    pass


Tallies.register("Tally", Tally)


def add_for_ever(tally: Any) -> NoReturn:
    while True:
        tally.add()


def begin_member(member: Any, directory: Path) -> None:
    """Be prepared for SIGTERM, if this is member 0, and say where it is."""
    global place
    place = directory
    if member.rank == 0:
        listen(directory)
    note(directory, f"{member.rank}@{client.host()}")


place: Path


def go_round(rank: int, _size: int) -> Any:
    """Exchange the ranks; member 0 does so once there is a file."""
    while rank == 0 and not (place / "go").exists():
        time.sleep(0.01)
    return fiber.ring.current().exchange(rank)


def host_of_member_0(directory: Path) -> str:
    """Wait until both members of a ring have begun."""
    wait_for(lambda: sum("@" in word for word in notes(directory)) == 2)
    (host,) = (word[2:] for word in notes(directory) if word.startswith("0@"))
    return host


@patient
def test_running_tasks_end_and_run_only_once(site: Site, tmp_path: Path) -> None:
    with fiber.Pool(2, retries=1, disruptions=0) as pool:
        results = pool.map_async(begin_and_wait, [(tmp_path, n) for n in range(12)])
        wait_for(lambda: len(notes(tmp_path)) >= 2)
        before = hosts_of(pool)
        assert len(before) == 2
        site.drain(min(before))
        wait_for(lambda: bool(hosts_of(pool) - before - {""}))
        (tmp_path / "go").touch()
        assert results.get(PATIENCE) == [str(n) for n in range(12)]
    assert set(Counter(notes(tmp_path)).values()) == {1}


@patient
@pytest.mark.parametrize("chunksize", [6, 12])
def test_a_drained_worker_begins_no_more_tasks_of_its_chunk(
    site: Site, tmp_path: Path, chunksize: int
) -> None:
    with fiber.Pool(2, retries=1, disruptions=0) as pool:
        tasks = [(tmp_path, n) for n in range(2 * chunksize)]
        results = pool.map_async(begin_somewhere_and_wait, tasks, chunksize=chunksize)
        wait_for(lambda: len(notes(tmp_path)) == 2)
        drained_host = min(hosts_of(pool))
        agent = site.drain(drained_host)
        (tmp_path / "go").touch()
        wait_for(lambda: agent.lost is not None)
        ran = [result.split("@") for result in results.get(PATIENCE)]
    assert [number for number, _ in ran] == [str(n) for n in range(2 * chunksize)]
    assert [host for _, host in ran].count(drained_host) == 1
    assert set(Counter(notes(tmp_path)).values()) == {1}


@patient
@pytest.mark.parametrize("site", ["loopback"], indirect=True)
def test_an_agent_leaves_by_name_when_its_last_child_is_gone(site: Site) -> None:
    agent = site.drain("loopback-0")
    wait_for(lambda: agent.lost is not None)
    assert agent.lost == agent.leaving
    assert agent.leaving.startswith("Drained: ")


def test_a_task_that_exceeds_the_grace_runs_elsewhere_and_uses_no_retry(
    site: Site, tmp_path: Path
) -> None:
    with fiber.Executor(1, retries=0, disruptions=1) as executor:
        future = executor.submit(block_unless_it_ran, tmp_path)
        wait_for(lambda: bool(notes(tmp_path)))
        (host,) = site.busy()
        site.drain(host)
        assert future.result(PATIENCE) == 2


@pytest.mark.parametrize("site", ["loopback"], indirect=True)
def test_a_task_that_is_disrupted_again_and_again_ends(site: Site, tmp_path: Path) -> None:
    with fiber.Executor(1, retries=3, disruptions=2) as executor:
        future = executor.submit(block, tmp_path)
        for runs in range(1, 4):
            wait_for(partial(ran, tmp_path, runs))
            (host,) = site.busy()
            site.drain(host)
        with pytest.raises(fiber.errors.WorkerDied) as caught:
            future.result(PATIENCE)
    error = caught.value
    assert (error.attempts, error.disruptions) == (0, 3)
    assert "the cluster ended it 3 times" in str(error)
    assert error.reason.startswith("Drained: ")


@pytest.mark.long
@pytest.mark.timeout(1800)
@played
@pytest.mark.parametrize("grace", [0.2])
def test_twenty_preemptions_in_a_row_are_borne_and_one_more_is_not(
    site: PodSite, tmp_path: Path
) -> None:
    with fiber.Executor(1) as executor:
        future = executor.submit(block, tmp_path)
        for runs in range(1, 22):
            wait_for(partial(ran, tmp_path, runs))
            assert not future.done()
            (host,) = site.busy()
            site.preempt(host)
        with pytest.raises(fiber.errors.WorkerDied) as caught:
            future.result(PATIENCE)
    error = caught.value
    assert (error.attempts, error.disruptions) == (0, 21)
    assert "its worker died 0 times, and the cluster ended it 21 times" in str(error)
    assert error.reason.startswith("Preempted: ")
    assert len(notes(tmp_path)) == 21


@patient
@pytest.mark.parametrize(("target", "told"), [(wait_at_sigterm, ["heard", "saved"]), (go_on, [])])
def test_a_process_gets_sigterm_only_if_it_has_a_handler(
    site: Site,
    tmp_path: Path,
    target: Callable[[Path, Any], None],
    told: list[str],
) -> None:
    ready = fiber.Event()
    process = fiber.Process(target=target, args=(tmp_path, ready))
    process.start()
    assert ready.wait(PATIENCE)
    popen: Any = process._popen
    site.drain(popen._child.host)
    (tmp_path / "go").touch()
    process.join(PATIENCE)
    assert process.exitcode == 0
    assert notes(tmp_path) == told


@patient
def test_new_processes_are_placed_elsewhere(site: Site, tmp_path: Path) -> None:
    ready = fiber.Event()
    process = fiber.Process(target=go_on, args=(tmp_path, ready))
    process.start()
    assert ready.wait(PATIENCE)
    popen: Any = process._popen
    host = popen._child.host
    site.drain(host)
    other = fiber.Process(target=go_on, args=(tmp_path, ready))
    other.start()
    (tmp_path / "go").touch()
    for each in (process, other):
        each.join(PATIENCE)
        assert each.exitcode == 0
    other_popen: Any = other._popen
    assert other_popen.report.host != host


@patient
def test_a_manager_gets_sigterm_and_goes_on(site: Site, tmp_path: Path) -> None:
    manager: Any = Tallies()
    manager.start(listen, (tmp_path,))
    with manager:
        tally = manager.Tally()
        site.drain(tally.host())
        wait_for(lambda: "heard" in notes(tmp_path))
        assert tally.add() == 1


def test_a_manager_that_is_killed_at_the_end_of_the_grace_says_why(site: Site) -> None:
    manager: Any = Tallies()
    with manager:
        tally = manager.Tally()
        site.drain(tally.host())
        with pytest.raises(ConnectionClosed, match=r"'Tallies-\d+'.*(Drained|Deleted): "):
            add_for_ever(tally)


@patient
def test_members_of_a_ring_get_sigterm_and_go_on(site: Site, tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as threads:
        results = threads.submit(fiber.Ring(2, go_round, begin_member, (tmp_path,)).run)
        site.drain(host_of_member_0(tmp_path))
        wait_for(lambda: "heard" in notes(tmp_path))
        (tmp_path / "go").touch()
        assert results.result(PATIENCE) == [1, 0]


def test_a_member_of_a_ring_that_is_killed_at_the_end_of_the_grace_is_lost(
    site: Site, tmp_path: Path
) -> None:
    with ThreadPoolExecutor(1) as threads:
        results = threads.submit(fiber.Ring(2, go_round, begin_member, (tmp_path,)).run)
        site.drain(host_of_member_0(tmp_path))
        with pytest.raises(MemberLost, match=r"(Drained|Deleted): "):
            results.result(PATIENCE)
