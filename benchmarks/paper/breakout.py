"""PPO on Breakout: time for so many steps, by the number of workers that play.

One environment a worker, as in the paper. With `played` games the workers run the emulator. With
`recorded` ones a step takes as long as a recorded step and no processor, so that two processors
have room for hundreds. The learner is small, a linear policy in NumPy, so that nearly all of the
time is that of the steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

from benchmarks.model import Case, Metric

if TYPE_CHECKING:
    from benchmarks.contender import Bench

WORKERS = (8, 16, 32, 64, 128, 256)
PLAYED_WORKERS = (8,)
STEPS = 65_536
PLAYED_STEPS = 16_384
HORIZON = 128
BASELINE = "stable-baselines3"
SUBPROC_MODULE = "stable_baselines3.common.vec_env.subproc_vec_env"
_QUICK_WORKERS = (2, 4)

TIME = Metric("time", "time of all steps", "s")
COLLECTION = Metric("collection", "time of the steps alone", "s")


def recorded(count: int) -> str:
    """Return the name of the case with so many workers whose steps only take as long."""
    return f"{count} workers, recorded steps"


def played(count: int) -> str:
    """Return the name of the case with so many workers that play the game."""
    return f"{count} workers, real games"


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, fewer steps; far below, few workers, too."""
    quick = size < 0.01
    kinds = (
        (played, "Breakout", PLAYED_STEPS, _QUICK_WORKERS[:1] if quick else PLAYED_WORKERS),
        (recorded, "Recorded", STEPS, _QUICK_WORKERS if quick else WORKERS),
    )
    return [
        Case(
            measure="paper.breakout",
            name=name(count),
            group="breakout",
            needs="ppo",
            params={"kind": kind, "workers": count, "steps": max(count, round(steps * size))},
            metrics=(TIME, COLLECTION),
            limit=300.0,
            rounds=3,
            fresh=True,
            baseline=BASELINE,
        )
        for name, kind, steps, counts in kinds
        for count in counts
    ]


def run(bench: Bench, kind: str, workers: int, steps: int) -> dict[str, float]:
    """Return seconds of so many steps with learning, and of the steps alone."""
    from benchmarks.paper import atari, ppo

    make: Callable[[], Any] = getattr(atari, kind)
    envs = _vector(bench.contender, make, workers)
    try:
        ppo.Training(envs, workers).steps(2)
        training = ppo.Training(envs, workers)
        begin = time.perf_counter()
        training.run(steps, HORIZON)
        took = time.perf_counter() - begin
    finally:
        envs.close()
    return {TIME.name: took, COLLECTION.name: training.collecting}


def _vector(contender: str, make: Callable[[], Any], workers: int) -> Any:
    if contender.startswith("fiber") and contender != "fiber-adopted":
        return _VectorEnv(make, workers)
    if contender == "fiber-adopted":
        import_module("fiber").adopt(SUBPROC_MODULE)
    vec_env = import_module("stable_baselines3.common.vec_env")
    return vec_env.SubprocVecEnv([make] * workers, start_method="fork")


class _VectorEnv:
    """`fiber.vector.VectorEnv` with the results of SubprocVecEnv, without importing torch."""

    def __init__(self, make: Callable[[], Any], workers: int) -> None:
        vector = import_module("fiber.vector")
        self._envs = vector.VectorEnv([make] * workers, num_workers=workers)
        self.close = self._envs.close

    def reset(self) -> Any:
        observations, _ = self._envs.reset()
        return observations

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any]:
        observations, rewards, terminated, truncated, infos = self._envs.step(actions)
        return observations, rewards, terminated | truncated, infos
