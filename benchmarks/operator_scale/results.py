"""Results as plain data that a file can keep."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.samples import Summary, ratio, summary

Curve = list[list[float]]
"""Pairs: seconds since the objects were made, and a number."""

STEPS = {
    "created": "all pods are created",
    "settled": "the status says that all are ready",
    "halved": "scaled to half: as many are gone, and the status says so",
    "gone": "deleted: no pod is left",
}
"""Steps of a trial, in order; each is timed from when it was asked for."""

MEGA = 1e6


@dataclass
class OperatorUse:
    """Cost of one trial for the operator."""

    memory: Curve = field(default_factory=list)
    memory_before: float = 0.0
    memory_after: float = 0.0
    seconds_until_settled: float = 0.0
    """Seconds of a processor."""
    seconds: float = 0.0
    """Seconds of a processor, for all of the trial."""
    requests_until_settled: dict[str, float] = field(default_factory=dict)
    requests_after: dict[str, float] = field(default_factory=dict)

    @property
    def peak(self) -> float:
        """Most resident memory that was seen."""
        return max((size for _, size in self.memory), default=self.memory_after)


@dataclass
class Trial:
    """Trial: one case done once by one subject."""

    subject: str
    turn: int
    steps: dict[str, float] = field(default_factory=dict)
    created: Curve = field(default_factory=list)
    ready: Curve = field(default_factory=list)
    writes: dict[str, float] = field(default_factory=dict)
    """Writes of all clients at the API server, until the trial was settled."""
    operator: OperatorUse | None = None

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Trial:
        """Return the trial that `dataclasses.asdict` described."""
        use = data.get("operator")
        return cls(**{**data, "operator": OperatorUse(**use) if use else None})


@dataclass
class Result:
    """All trials of one case."""

    about: dict[str, Any]
    trials: list[Trial] = field(default_factory=list)

    def of(self, subject: str) -> list[Trial]:
        """Return its trials, by round."""
        return sorted((t for t in self.trials if t.subject == subject), key=lambda t: t.turn)

    def step(self, subject: str, step: str) -> Summary | None:
        """Return median and spread of a step's seconds."""
        return summary(self._series(subject, step))

    def ratio(self, subject: str, baseline: str, step: str) -> Summary | None:
        """Return the ratio of a step's seconds, within each round."""
        return ratio(self._series(subject, step), self._series(baseline, step))

    def peak(self) -> float | None:
        """Return the most memory that the operator used in any trial."""
        peaks = [trial.operator.peak for trial in self.trials if trial.operator]
        return max(peaks, default=None)

    def _series(self, subject: str, step: str) -> list[float | None]:
        trials = {trial.turn: trial for trial in self.of(subject)}
        rounds = 1 + max((trial.turn for trial in self.trials), default=-1)
        return [trials[t].steps.get(step) if t in trials else None for t in range(rounds)]


def load(path: Path) -> dict[str, Result]:
    """Return the results of earlier runs, by case, so that one case can be run again alone."""
    if not path.exists():
        return {}
    return {
        name: Result(data["about"], [Trial.from_json(trial) for trial in data["trials"]])
        for name, data in json.loads(path.read_text(encoding="utf-8")).items()
    }


def save(path: Path, results: dict[str, Result]) -> None:
    """Write them so that `load` returns them."""
    data = {name: dataclasses.asdict(result) for name, result in results.items()}
    path.write_text(json.dumps(_rounded(data), separators=(",", ":")) + "\n", encoding="utf-8")


def _rounded(data: Any) -> Any:
    """Round to milliseconds, which are fine enough and keep the file small."""
    if isinstance(data, float):
        return round(data, 3)
    if isinstance(data, dict):
        return {key: _rounded(value) for key, value in data.items()}
    return [_rounded(item) for item in data] if isinstance(data, list | tuple) else data
