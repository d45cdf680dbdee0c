"""Terms of the benchmarks.

A case is one thing to measure. A metric is one number that it gives. A run is all that was
measured.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

WORKERS = 5
BASELINE = "multiprocessing"
MANY = 1000
MANY_ROUNDS = 3


@dataclass(frozen=True)
class Metric:
    """Metric of a case. `unit` is "s", "1/s", "B" or "B/s"."""

    name: str
    label: str
    unit: str


def rounds_with(workers: int) -> int | None:
    """Return the most rounds with so many workers; None if there is no such bound."""
    return MANY_ROUNDS if workers >= MANY else None


@dataclass(frozen=True)
class Case:
    """Case that every able contender does once in every round.

    `limit`: seconds after which it counts as not finished and is not tried again. `fresh`: needs a
    contender process that has done nothing before. `rounds`: at most so many, however long they
    take. `baseline`: the contender that ratios are to. `not_run`: contenders that are left out
    although they offer it, and why.
    """

    measure: str
    name: str
    group: str
    needs: str
    params: Mapping[str, Any]
    metrics: tuple[Metric, ...]
    limit: float = 15.0
    fresh: bool = False
    rounds: int | None = None
    baseline: str = BASELINE
    not_run: Mapping[str, str] = field(default_factory=dict)


Series = list[float | None]


@dataclass
class Run:
    """Run of one measure.

    It has one value a round for each case, contender and metric, or None. `in_use` is the share of
    the processors' time that other programs used in a moment before each round.
    """

    about: dict[str, Any]
    values: dict[str, dict[str, dict[str, Series]]] = field(default_factory=dict)
    failures: dict[str, dict[str, str]] = field(default_factory=dict)
    unfinished: dict[str, dict[str, float]] = field(default_factory=dict)
    in_use: list[float] = field(default_factory=list)

    def add(self, case: str, contender: str, turn: int, sample: Mapping[str, float]) -> None:
        """Note the sample of round `turn`, counted from 0."""
        for metric, value in sample.items():
            series = self.series(case, contender, metric)
            series.extend([None] * (turn + 1 - len(series)))
            series[turn] = value

    def fail(self, case: str, contender: str, why: str, after: float | None = None) -> None:
        """Note that a contender failed in a case, or was not done after `after` seconds."""
        self.failures.setdefault(case, {})[contender] = why
        if after is not None:
            self.unfinished.setdefault(case, {})[contender] = after

    def series(self, case: str, contender: str, metric: str) -> Series:
        """Return the values by round, fewer than the run's rounds if the contender took part in
        fewer."""
        return self.values.setdefault(case, {}).setdefault(contender, {}).setdefault(metric, [])

    def as_json(self) -> dict[str, Any]:
        """Return plain data from which `from_json` makes the same run."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Run:
        """Return the run that `as_json` described."""
        return cls(**data)
