"""Vector environments: steps a second of many environments, whoever steps them."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

from benchmarks.model import BASELINE, Case, Metric

if TYPE_CHECKING:
    from benchmarks.contender import Bench

TITLE = "Vector environments"
ABOUT = """\
Steps a second of all environments together. CartPole is Gymnasium's; the others do nothing but
sleep for a millisecond, or change an observation of 84x84x4 bytes, or take five milliseconds in
one step of ten and else a tenth of one. Fiber is `fiber.vector.VectorEnv`, with a worker for each
processor; for each environment where these sleep for a millisecond, for four of those that are
uneven. PufferLib's Multiprocessing backend has as many. multiprocessing is Gymnasium's
AsyncVectorEnv, which always has a worker for each environment, and is not asked for 512. Behind
loopback agents only what works is measured, as each worker there brings an agent of its own. First
ready: `recv` of 16 environments of 64, and `send` for these."""

RATE = Metric("rate", "environment steps a second", "1/s")
POLES = "CartPoles"
OTHERS = "other environments"
PIXELS = "64 with 84x84x4 bytes"
UNEVEN = "64 uneven ones"
FIRST_READY = f"{UNEVEN}, first ready"


def cart_poles(count: int) -> str:
    """The name of the case with `count` of them."""
    return f"{count} {POLES}"


def cases(size: float) -> list[Case]:
    """The full measure at size 1; below, shorter, and with fewer environments if far below."""
    tiny = size < 0.1
    few: dict[str, Any] = {"count": 8 if tiny else 64}
    asleep = {"kind": "Sleeping", **few, "workers": few["count"]}
    uneven = {"kind": "Uneven", **few, "workers": few["count"] // 4}
    found = [
        (POLES, cart_poles(8), "vector steps", {"kind": "cart_pole", "count": 8}),
        (POLES, cart_poles(64), "vector steps", {"kind": "cart_pole", **few}),
        (POLES, cart_poles(512), "many vector steps", {"kind": "cart_pole", "count": 512}),
        (OTHERS, "64 that sleep 1 ms", "slow vector steps", asleep),
        (OTHERS, PIXELS, "vector steps", {"kind": "Pixels", **few}),
        (OTHERS, UNEVEN, "slow vector steps", uneven),
        (OTHERS, FIRST_READY, "first ready", uneven | {"batch": 16}),
    ]
    return [
        Case(
            measure="vector",
            name=name,
            group=group,
            needs=needs,
            params={**params, "seconds": 2.0 * size},
            metrics=(RATE,),
            limit=30.0,
        )
        for group, name, needs, params in found
        if not (tiny and params["count"] > 64)
    ]


def run(
    bench: Bench,
    kind: str,
    count: int,
    seconds: float,
    workers: int | None = None,
    batch: int = 0,
) -> dict[str, float]:
    """Steps for so many seconds, in batches of `batch` that are ready first, or all together."""
    make: Callable[[], Any] = getattr(import_module("benchmarks.environment"), kind)
    env = _MAKERS[bench.contender](make, count, workers)
    try:
        env.reset(seed=1)
        if batch:
            return {RATE.name: _first_ready(env, min(batch, count // 4), seconds)}
        actions = env.action_space.sample()
        return {RATE.name: _rate(lambda: env.step(actions), count, seconds)}
    finally:
        env.close()


def _first_ready(env: Any, batch: int, seconds: float) -> float:
    actions = env.action_space.sample()
    env.send(actions)

    def step() -> None:
        env.recv(batch)
        env.send(actions[:batch])

    rate = _rate(step, batch, seconds)
    env.recv()
    return rate


def _rate(step: Callable[[], object], count: int, seconds: float) -> float:
    for _ in range(3):
        step()
    begin = time.perf_counter()
    for steps in itertools.count(1):
        step()
        took = time.perf_counter() - begin
        if took >= seconds:
            return steps * count / took
    raise AssertionError("there is no last number")


def _fiber(make: Callable[[], Any], count: int, workers: int | None) -> Any:
    return import_module("fiber.vector").VectorEnv([make] * count, num_workers=workers)


def _async(make: Callable[[], Any], count: int, workers: int | None) -> Any:
    return import_module("gymnasium.vector").AsyncVectorEnv([make] * count)


def _sync(make: Callable[[], Any], count: int, workers: int | None) -> Any:
    return import_module("gymnasium.vector").SyncVectorEnv([make] * count)


def _puffer(make: Callable[[], Any], count: int, workers: int | None) -> Any:
    vector, emulation = import_module("pufferlib.vector"), import_module("pufferlib.emulation")

    def emulated(buf: Any = None, seed: int = 0) -> Any:
        return emulation.GymnasiumPufferEnv(env=make(), buf=buf, seed=seed)

    processors = import_module("fiber").cpu_count()
    return vector.make(
        emulated,
        backend=vector.Multiprocessing,
        num_envs=count,
        num_workers=workers or min(count, processors),
        overwork=True,
    )


class _SubprocVecEnv:
    """stable-baselines3's, as the others are called."""

    def __init__(self, make: Callable[[], Any], count: int, workers: int | None) -> None:
        self._env = import_module("stable_baselines3.common.vec_env").SubprocVecEnv([make] * count)
        spaces = import_module("gymnasium.vector.utils")
        self.action_space = spaces.batch_space(self._env.action_space, count)
        self.step = self._env.step
        self.close = self._env.close

    def reset(self, seed: int) -> None:
        self._env.seed(seed)
        self._env.reset()


_MAKERS: dict[str, Callable[[Callable[[], Any], int, int | None], Any]] = {
    "fiber": _fiber,
    "fiber-loopback": _fiber,
    BASELINE: _async,
    "sync-vector-env": _sync,
    "pufferlib": _puffer,
    "stable-baselines3": _SubprocVecEnv,
}
