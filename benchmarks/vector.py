"""Vector environments: steps a second of many environments, by contender."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from benchmarks import environment, vector_peers
from benchmarks.model import Case, Metric

if TYPE_CHECKING:
    from benchmarks.contender import Bench

COUNTS = (8, 64, 512, 4096)
_EVERY_ROUND = 64
SLOW_WORKERS = 16
BASELINE = "async-vector-env"
_A_PROCESS_EACH = (BASELINE, "stable-baselines3")
_MOST_PROCESSES = 512
TITLE = "Vector environments"
ABOUT = f"""\
Steps a second of all environments together. CartPole is Gymnasium's. The other environments sleep
for a millisecond, or change an observation of 84x84x4 bytes, or are uneven: one step in ten takes
five milliseconds and the others a tenth of one. First ready: the program receives a quarter of the
uneven environments at a time, those that are ready first, and sends them back. There, ratios are to
Fiber's value.

* Fiber is `fiber.vector.VectorEnv`.
* AsyncVectorEnv and SyncVectorEnv are Gymnasium's. AsyncVectorEnv has a forked process for each
  environment, as stable-baselines3's SubprocVecEnv has. Both are measured with at most
  {_MOST_PROCESSES} environments.
* Fiber, PufferLib and Ray share workers: one for each processor for CartPoles and for large
  observations. For environments that sleep they have one for each, but at most {SLOW_WORKERS}.
* PufferLib is its backend Multiprocessing, from the package pufferlib-core, because pufferlib
  itself must be built with torch.
* Ray's are plain actors, because RLlib's need torch. Each has its share of the environments in a
  SyncVectorEnv, and the program joins their results.
* EnvPool runs only its environments, which are written in C++. Its CartPole is measured, with a
  thread for each processor. It shows what Python costs, not how good its workers are.
* SubprocVecEnv and PufferLib import torch and do not use it here. If it is not installed, a
  stand-in takes its place.

Before the clock starts, a vector is reset and makes three steps, or as many as fit into a quarter
of the measured time. More than {_EVERY_ROUND} environments take as long to make as to measure, and
are measured in one round."""

RATE = Metric("rate", "environment steps a second", "1/s")
FIRST_READY = "first ready"
PANELS = {
    "CartPoles": "CartPoles",
    "that sleep 1 ms": "environments that sleep 1 ms",
    "with 84x84x4 bytes": "environments with 84x84x4 bytes",
    "uneven ones": "environments with uneven steps",
    f"uneven ones, {FIRST_READY}": f"environments with uneven steps, {FIRST_READY}",
}
"""Groups of cases, by the ends of their names."""
_KINDS = ("cart_pole", "Sleeping", "Pixels", "Uneven", "Uneven")
_SLOW = ("Sleeping", "Uneven")


def cart_poles(count: int) -> str:
    """Return the name of the case with `count` of them."""
    return f"{count:,} CartPoles"


def pixels(count: int) -> str:
    """Return the name of the case with `count` environments with large observations."""
    return f"{count:,} with 84x84x4 bytes"


def uneven(count: int, *, first_ready: bool = False) -> str:
    """Return the name of the case with `count` environments with uneven steps."""
    return f"{count:,} uneven ones" + (f", {FIRST_READY}" if first_ready else "")


def cases(size: float) -> list[Case]:
    """Return the full measure at size 1; below, shorter, and with fewer environments if far
    below."""
    return [
        _case(kind, count, f"{count:,} {ending}", group, size)
        for kind, (ending, group) in zip(_KINDS, PANELS.items(), strict=True)
        for count in COUNTS
        if size >= 0.1 or count <= _EVERY_ROUND
    ]


def _case(kind: str, count: int, name: str, group: str, size: float) -> Case:
    batch = count // 4 if name.endswith(FIRST_READY) else 0
    return Case(
        measure="vector",
        name=name,
        group=group,
        needs="first ready" if batch else "cart poles" if kind == "cart_pole" else "vector steps",
        params={
            "kind": kind,
            "count": count,
            "seconds": 0.6 * size,
            "workers": min(count, SLOW_WORKERS) if kind in _SLOW else None,
            "batch": batch,
        },
        metrics=(RATE,),
        limit=60.0,
        rounds=None if count <= _EVERY_ROUND else 1,
        # Contenders with a process for each environment have no batches that are ready first.
        baseline="fiber" if batch else BASELINE,
        not_run={}
        if batch or count <= _MOST_PROCESSES
        else dict.fromkeys(_A_PROCESS_EACH, f"{count:,} processes"),
    )


def run(
    bench: Bench, kind: str, count: int, seconds: float, workers: int | None, batch: int
) -> dict[str, float]:
    """Step for so many seconds, in batches of `batch` that are ready first, or all together."""
    make: Callable[[], Any] = getattr(environment, kind)
    env = vector_peers.start(bench.contender, make, count, workers, batch)
    try:
        step = _first_ready(env, count, batch) if batch else _all(env)
        return {RATE.name: _rate(step, batch or count, seconds)}
    finally:
        env.close()


def _all(env: Any) -> Callable[[], object]:
    env.reset(seed=1)
    actions = env.action_space.sample()
    return lambda: env.step(actions)


def _first_ready(env: Any, count: int, batch: int) -> Callable[[], object]:
    env.reset_async(seed=1)
    actions = env.action_space.sample()[:batch]

    def step() -> None:
        env.recv(batch)
        env.send(actions)

    # So often that all environments are made and have stepped.
    for _ in range(2 * count // batch):
        step()
    return step


def _rate(step: Callable[[], object], count: int, seconds: float) -> float:
    """Return environment steps a second, where each call makes `count` of them."""
    warm = time.perf_counter() + seconds / 4
    for _ in range(3):
        step()
        if time.perf_counter() > warm:
            break
    begin = time.perf_counter()
    for steps in itertools.count(1):
        step()
        took = time.perf_counter() - begin
        if took >= seconds:
            return steps * count / took
    raise AssertionError("there is no last number")
