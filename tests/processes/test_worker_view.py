"""View of a pool's workers, and their resources."""

from __future__ import annotations

import os
import time

import pytest

import fiber
from fiber._runtime.workers import WorkerResources
from fiber.errors import StartError, TimeoutError
from fiber.resources import Resources
from patience import PATIENCE


def square(number: int) -> int:
    return number * number


def fail() -> None:
    raise LookupError("no such device")


def test_workers_are_described() -> None:
    with fiber.Pool(2) as pool:
        pool.wait_until_workers_up(PATIENCE)
        assert {info.state for info in pool.workers()} == {"idle"}
        pool.map(square, range(100))
        infos = pool.workers()
        assert sum(info.tasks for info in infos) == 100
        assert {info.pid for info in infos} == set(pool.broadcast(os.getpid))
        assert {(info.host, info.node) for info in infos} == {("local", "")}
        pool.apply_async(time.sleep, (PATIENCE,))
        assert sorted(info.state for info in pool.workers()).count("leaving") == 0
    pool.join()
    assert pool.workers() == []


def test_calls_that_their_callers_wait_for_count_too() -> None:
    with fiber.Pool(1) as pool:
        for _ in range(50):
            pool.apply(square, (2,))
        assert pool.workers()[0].tasks == 50
    pool.join()


def test_workers_that_do_not_come_in_time_are_counted() -> None:
    with fiber.Pool(1, time.sleep, (PATIENCE,)) as pool:
        with pytest.raises(TimeoutError, match=r"0 of 1 workers are ready after 0.1 s"):
            pool.wait_until_workers_up(0.1)
        assert pool.workers()[0].state == "starting"
    pool.join()


@pytest.mark.slow
def test_the_error_of_an_initializer_is_raised_to_a_caller_that_waits_for_workers() -> None:
    with fiber.Pool(1, fail) as pool, pytest.raises(StartError, match="no such device"):
        pool.wait_until_workers_up(PATIENCE)
    pool.join()


@pytest.mark.slow
def test_an_initializer_that_ends_its_process_is_named() -> None:
    with fiber.Pool(1, os._exit, (9,)) as pool, pytest.raises(StartError) as caught:
        pool.wait_until_workers_up(PATIENCE)
    pool.join()
    assert "exit status 9" in str(caught.value)
    (note,) = caught.value.__notes__
    assert note.startswith("The pool's initializer, _exit, may have ended the process")


@pytest.mark.slow
def test_no_initializer_is_blamed_for_an_error_that_it_raises() -> None:
    with fiber.Pool(1, fail) as pool, pytest.raises(StartError) as caught:
        pool.wait_until_workers_up(PATIENCE)
    pool.join()
    assert not hasattr(caught.value, "__notes__")


def test_the_first_function_decides_the_resources_of_the_workers() -> None:
    resources = WorkerResources(Resources(pool="warm"))
    resources.choose_for(fiber.meta(cpu=2)(square))
    assert resources.chosen == Resources(cpu=2, pool="warm")
    resources.choose_for(square)  # which has no wishes
    resources.choose_for(fiber.meta(cpu=2)(square))
    with pytest.raises(ValueError, match="Make another pool"):
        resources.choose_for(fiber.meta(cpu=2, gpu=1)(square))


def test_workers_that_were_started_before_have_no_wishes() -> None:
    resources = WorkerResources(Resources())
    assert resources.chosen == Resources()
    with pytest.raises(ValueError, match="gpu=1"):
        resources.choose_for(fiber.meta(gpu=1)(square))
