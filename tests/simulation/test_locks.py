"""No token is held twice or lost, when a process is killed or interrupted at any step."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest

from fiber._sync.semaphore import SEM_VALUE_MAX, SharedSemaphore
from simulation.shared_semaphores import Process, World, simulated

SEEDS = 250
ROUNDS = 2
KINDS = {"lock": (1, 1), "bounded": (2, 2), "semaphore": (2, SEM_VALUE_MAX)}


def takes_turns(world: World, make: Callable[[], SharedSemaphore]) -> Callable[[Process], None]:
    """Return the program of each process."""

    def action(process: Process) -> None:
        semaphore = make()
        for _ in range(ROUNDS):
            with suppress(KeyboardInterrupt):
                wait = world.random.random() < 0.7
                if semaphore.acquire(wait):
                    world.holders.append(process)
                    assert len(world.holders) <= world.tokens, "held by more than there are tokens"
                    process.step()
                    world.holders.remove(process)
                    semaphore.release()

    return action


def run(seed: int, tokens: int, maximum: int) -> None:
    """Run one schedule."""
    world = World(seed, tokens, maximum)
    with pytest.MonkeyPatch.context() as patch:
        make = simulated(world, patch)
        try:
            processes = [world.start(takes_turns(world, make)) for _ in range(tokens + 2)]
            for process in world.random.sample(processes, tokens + 1):
                for _ in range(world.random.randrange(200)):
                    world.move(processes)
                if world.random.random() < 0.3:
                    process.interrupted = True
                else:
                    world.kill(process)
            world.finish()
            # A later process gets all that are left.
            late = world.start(lambda _: acquires_all(make(), tokens))
            world.finish()
            for process in processes:
                assert process.error is None, process.error
            assert late.error is None, late.error
        finally:
            world.end()


def acquires_all(semaphore: SharedSemaphore, tokens: int) -> None:
    for _ in range(tokens):
        assert semaphore.acquire()
    assert not semaphore.acquire(False)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_locks_keep_their_promises_in_seeded_schedules(kind: str) -> None:
    for seed in range(SEEDS):
        try:
            run(seed, *KINDS[kind])
        except BaseException as error:
            error.add_note(f"seed {seed}")
            raise


def fails(kind: str, seeds: int = 10 * SEEDS) -> bool:
    for seed in range(seeds):
        try:
            run(seed, *KINDS[kind])
        except AssertionError:
            return True
    return False


FAULTS: dict[str, tuple[str, str, Any]] = {
    "who is busy is not waited for": (
        "lock",
        "_wait_until_quiet",
        lambda self: {slot: self._words[slot + 1] for slot in self._used() if self._is_gone(slot)},
    ),
    "an interrupted step is forgotten": ("lock", "_leave", lambda _, __: None),
    "no moment passes": ("semaphore", "_MOMENT", None),
    "the dead are never looked for": ("lock", "is_suspicious", lambda _: False),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_an_injected_fault_is_found(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    kind, name, instead = FAULTS[fault]
    if instead is None:
        monkeypatch.setattr(World, "sleep", lambda world, _: world.monotonic())
    else:
        monkeypatch.setattr(SharedSemaphore, name, instead)
    assert fails(kind), "the simulation does not see it"
