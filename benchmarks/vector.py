"""Vector environments: steps a second of many environments, whoever steps them."""

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
Steps a second of all environments together. CartPole is Gymnasium's; the others do nothing but
sleep for a millisecond, or change an observation of 84x84x4 bytes, or take five milliseconds in
one step of ten and else a tenth of one. First ready: a quarter of the uneven environments is
received at a time, those that were ready first, and sent back; ratios are to Fiber's there.

Fiber is `fiber.vector.VectorEnv`. AsyncVectorEnv and SyncVectorEnv are Gymnasium's; the first has a
process for each environment, forked, as stable-baselines3's SubprocVecEnv has, and more than
{_MOST_PROCESSES} they are not asked for. Who shares workers has one a processor for CartPoles and
for large observations, and for environments that sleep one for each, but at most {SLOW_WORKERS}:
Fiber, PufferLib, Ray. PufferLib is its backend Multiprocessing, from the package pufferlib-core, as
pufferlib itself has to be built with torch. Ray's are plain actors, as RLlib's need torch: each has
its share of the environments in a SyncVectorEnv, and the program puts together what they return.
EnvPool runs environments of its own alone, which are written in C++: of these its CartPole is
measured, with a thread a processor, and it says what Python costs, not what its workers do.
SubprocVecEnv and PufferLib import torch and do not use it here: where it is not installed, a
stand-in is.

Before the clock starts a vector is reset and makes three steps, or as many as fit into a quarter of
the time that is measured. More than {_EVERY_ROUND} environments take as long to make as to measure,
and are measured in one round."""

RATE = Metric("rate", "environment steps a second", "1/s")
FIRST_READY = "first ready"
PANELS = {
    "CartPoles": "CartPoles",
    "that sleep 1 ms": "environments that sleep 1 ms",
    "with 84x84x4 bytes": "environments with 84x84x4 bytes",
    "uneven ones": "environments with uneven steps",
    f"uneven ones, {FIRST_READY}": f"environments with uneven steps, {FIRST_READY}",
}
"""The groups of cases, by what ends the names of theirs."""
_KINDS = ("cart_pole", "Sleeping", "Pixels", "Uneven", "Uneven")
_SLOW = ("Sleeping", "Uneven")


def cart_poles(count: int) -> str:
    """The name of the case with `count` of them."""
    return f"{count:,} CartPoles"


def pixels(count: int) -> str:
    """The name of the case with `count` environments with large observations."""
    return f"{count:,} with 84x84x4 bytes"


def uneven(count: int, *, first_ready: bool = False) -> str:
    """The name of the case with `count` environments with uneven steps."""
    return f"{count:,} uneven ones" + (f", {FIRST_READY}" if first_ready else "")


def cases(size: float) -> list[Case]:
    """The full measure at size 1; below, shorter, and with fewer environments if far below."""
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
        # Those that have a process for each environment have no batches that are ready first.
        baseline="fiber" if batch else BASELINE,
        not_run={}
        if batch or count <= _MOST_PROCESSES
        else dict.fromkeys(_A_PROCESS_EACH, f"{count:,} processes"),
    )


def run(
    bench: Bench, kind: str, count: int, seconds: float, workers: int | None, batch: int
) -> dict[str, float]:
    """Steps for so many seconds, in batches of `batch` that are ready first, or all together."""
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

    # So often that all environments are there and have made steps.
    for _ in range(2 * count // batch):
        step()
    return step


def _rate(step: Callable[[], object], count: int, seconds: float) -> float:
    """Environment steps a second, where each call makes `count` of them."""
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
