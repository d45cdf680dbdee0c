"""Runs schedules, shrinks one that fails, and prints how to run it again."""

from __future__ import annotations

import dataclasses
import itertools
import re
import traceback
from collections.abc import Callable, Iterable
from typing import NamedTuple

from simulation.agents import Agent
from simulation.schedule import Schedule, draw, simpler
from simulation.world import Master, World

ATTEMPTS = 600
"""Runs spent on making a schedule smaller."""


class Suite(NamedTuple):
    """Something to drive through schedules."""

    make: Callable[[World], Master]
    adapt: Callable[[Schedule], Schedule] = lambda schedule: schedule
    """Makes a schedule possible for it."""
    remote: type[Agent] = Agent
    """Simulations of hosts other than the master's own."""
    share: float = 1.0
    """The part of all seeds that it runs: it may be slow."""


class Failure(Exception):
    """A schedule that breaks a promise, shrunk, and its events."""

    def __init__(self, schedule: Schedule, error: Exception, trace: list[str], again: str) -> None:
        self.schedule = schedule
        self.error = error
        self.trace = trace
        self.again = again
        super().__init__(schedule, error)

    def __str__(self) -> str:
        where = "".join(traceback.format_exception(self.error)[-2:])
        return "\n".join(
            (
                f"seed {self.schedule.seed} breaks a promise; run it again with",
                f"\n    {self.again}\n",
                "made smaller:",
                *(f"    {line}" for line in describe(self.schedule)),
                "what happens:",
                *(f"  {line}" for line in self.trace[-60:]),
                "",
                where,
            )
        )


def run(schedule: Schedule, suite: Suite, trace: list[str] | None = None) -> Exception | None:
    """Return the failure of one run, if any."""
    try:
        World(suite.adapt(schedule), suite.make, trace, suite.remote).run()
    except Exception as error:  # also errors that the code under test raises by mistake
        return error
    return None


def examine(seed: int, suite: Suite, again: str) -> None:
    """Run the schedule of ``seed``; Failure if it breaks a promise."""
    schedule = draw(seed)
    if run(schedule, suite) is None:
        return
    schedule = shrink(schedule, suite)
    trace: list[str] = []
    error = run(schedule, suite, trace)
    assert error is not None
    raise Failure(schedule, error, trace, again)


def first_failure(seeds: Iterable[int], suite: Suite) -> tuple[int, Exception] | None:
    """The first seed that breaks a promise, and how."""
    for seed in seeds:
        error = run(draw(seed), suite)
        if error is not None:
            return seed, error
    return None


def shrink(schedule: Schedule, suite: Suite) -> Schedule:
    """The smallest schedule found that fails in the same way."""
    kind = _kind(run(schedule, suite))
    budget = itertools.count()
    while True:
        for smaller in simpler(schedule):
            if next(budget) == ATTEMPTS:
                return schedule
            if _kind(run(smaller, suite)) == kind:
                schedule = smaller
                break
        else:
            return schedule


def _kind(error: Exception | None) -> tuple[type | None, str]:
    """Return the identity of a failure: its type, and its text without numbers."""
    return type(error) if error else None, re.sub(r"\d+(, \d+)*", "", str(error))


def describe(schedule: Schedule) -> list[str]:
    """A schedule as text, without the default values."""
    lines = [f"seed={schedule.seed}, workers={schedule.min_workers} to {schedule.max_workers}"]
    lines[0] += f", left={schedule.left}, linger={schedule.linger}"
    lines += [f"host {number}: {agent}" for number, agent in enumerate(schedule.agents)]
    lines += [_unusual(job) for job in schedule.jobs]
    lines += [str(fault) for fault in schedule.faults]
    return lines


def _unusual(job: object) -> str:
    assert dataclasses.is_dataclass(job)
    fields = [
        f"{field.name}={getattr(job, field.name)}"
        for field in dataclasses.fields(job)
        if getattr(job, field.name) != field.default
    ]
    return f"Job({', '.join(fields)})"
