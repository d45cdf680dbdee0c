"""Shared memory of several hosts: a process that gets a message finds earlier writes, and all
copies agree in the end.

python -c 'from simulation.memory_hosts import World; World(SEED).run(300)'
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from fiber._hub.replicas import MemoryLink, Twin
from simulation.memory_hosts import World

SEEDS = 2000
PARTS = 2
STEPS = 300


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
def test_shared_memory_keeps_its_promises_in_seeded_schedules(part: int) -> None:
    run_all(range(part, SEEDS, PARTS))


def run_all(seeds: range) -> None:
    for seed in seeds:
        try:
            World(seed).run(STEPS)
        except Exception as error:
            raise AssertionError(f"seed {seed}: {error}") from error


def every_third(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same method, which ignores every third call."""
    calls = 0

    def sometimes(*args: Any) -> Any:
        nonlocal calls
        calls += 1
        return function(*args) if calls % 3 else None

    return sometimes


def _apply_all(twin: Any, runs: Any) -> None:
    """Apply patches, but forget the local changes that are yet to be sent."""
    for start, data in runs:
        twin._memory[start : start + len(data)] = data
        twin._agreed[start : start + len(data)] = data


@pytest.mark.parametrize(
    ("cls", "name", "faulty"),
    [
        (MemoryLink, "flush", every_third(MemoryLink.flush)),
        (Twin, "merge", every_third(Twin.merge)),
        (Twin, "_merge_newer", _apply_all),
        (Twin, "_sent", lambda twin, patch: patch),
    ],
)
def test_planted_faults_are_found(
    cls: type, name: str, faulty: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cls, name, faulty)
    if name == "_sent":
        monkeypatch.setattr(Twin, "acknowledged", lambda twin: None)
    with pytest.raises(AssertionError, match="seed"):
        run_all(range(SEEDS))
