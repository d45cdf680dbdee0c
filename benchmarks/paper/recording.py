"""Recordings: how long real episodes of a walker, and real steps of Breakout, took.

They are files of JSON beside this module. Times are processor time of one thread, so that a busy
machine does not change them.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent / "recordings"
WALKER = "bipedal-walker-hardcore"
BREAKOUT = "breakout"


@dataclass(frozen=True)
class Recording:
    """Times in microseconds, and how they were made. `steps`: of each episode, or none."""

    environment: str
    how: str
    command: str
    machine: str
    microseconds: list[int]
    steps: list[int]

    @property
    def seconds(self) -> list[float]:
        """Return the times in seconds."""
        return [each / 1e6 for each in self.microseconds]


class BadRecording(Exception):
    """A recording that cannot be used; the text says why, and how to make another one."""


@cache
def read(name: str, folder: Path = FOLDER) -> Recording:
    """Return a recording; `BadRecording` if it is missing or has no times."""
    path = folder / f"{name}.json"
    again = "python -m benchmarks.paper.record makes it"
    try:
        recording = _checked(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise BadRecording(f"there is no recording {path}: {again}") from None
    except (ValueError, TypeError) as error:
        raise BadRecording(f"{path} is no recording ({error}): {again} anew") from None
    return recording


def write(name: str, recording: Recording, folder: Path = FOLDER) -> Path:
    """Write a recording, and return its path."""
    path = folder / f"{name}.json"
    path.write_text(json.dumps(asdict(recording), separators=(",", ":")) + "\n", encoding="utf-8")
    return path


def _checked(data: dict[str, Any]) -> Recording:
    recording = Recording(**data)
    if not recording.microseconds:
        raise ValueError("it has no times")
    if min(recording.microseconds) <= 0:
        raise ValueError("a time is not positive")
    if recording.steps and len(recording.steps) != len(recording.microseconds):
        raise ValueError("it has other numbers of steps and of times")
    return recording
