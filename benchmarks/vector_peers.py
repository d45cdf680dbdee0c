"""Vector environments with one interface: each adapter uses its library's calls.

All have `reset(seed)`, `step(actions)`, `action_space` and `close()`. Adapters with first-ready
batches also have `reset_async(seed)`, `recv(batch)` and `send(actions)`, the latter for the
environments of the last batch. Workers share environments evenly, in order.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from benchmarks import peers
from benchmarks.environment import cart_pole

Make = Callable[[], Any]


def start(contender: str, make: Make, count: int, workers: int | None, batch: int) -> Any:
    """Return the contender's vector of so many environments.

    `workers`: None for one a processor; ignored if each environment has a worker or none has.
    `batch`: the size of first-ready batches, 0 for a vector that is stepped as a whole.
    """
    if not workers:
        # A power of two, as the counts are: not all libraries can share environments unevenly.
        processors = import_module("fiber").cpu_count()
        workers = min(count, 1 << processors.bit_length() - 1)
    return _ADAPTERS[contender](make, count, workers, batch)


def _fiber(make: Make, count: int, workers: int, batch: int) -> Any:
    return import_module("fiber.vector").VectorEnv([make] * count, num_workers=workers)


def _async(make: Make, count: int, workers: int, batch: int) -> Any:
    return import_module("gymnasium.vector").AsyncVectorEnv([make] * count, context="fork")


def _sync(make: Make, count: int, workers: int, batch: int) -> Any:
    return import_module("gymnasium.vector").SyncVectorEnv([make] * count)


class _SubprocVecEnv:
    """stable-baselines3's vector. Forked, as AsyncVectorEnv's: a server's would import all anew."""

    def __init__(self, make: Make, count: int, workers: int, batch: int) -> None:
        vec_env = import_module("stable_baselines3.common.vec_env")
        self._env = vec_env.SubprocVecEnv([make] * count, start_method="fork")
        spaces = import_module("gymnasium.vector.utils")
        self.action_space = spaces.batch_space(self._env.action_space, count)
        self.step = self._env.step
        self.close = self._env.close

    def reset(self, seed: int) -> None:
        self._env.seed(seed)
        self._env.reset()


class _PufferLib:
    """PufferLib's backend Multiprocessing, allowed more workers than cores as all are here."""

    def __init__(self, make: Make, count: int, workers: int, batch: int) -> None:
        vector = import_module("pufferlib.vector")
        emulation = import_module("pufferlib.emulation")

        def emulated(buf: Any = None, seed: int = 0) -> Any:
            return emulation.GymnasiumPufferEnv(env=make(), buf=buf, seed=seed)

        self._env = vector.make(
            emulated,
            backend=vector.Multiprocessing,
            num_envs=count,
            num_workers=workers,
            batch_size=batch or count,
            sync_traj=not batch,
            zero_copy=not batch,
            overwork=True,
        )
        self.action_space = self._env.action_space
        self.reset = self._env.reset
        self.step = self._env.step
        self.reset_async = self._env.async_reset
        self.send = self._env.send
        self.close = self._env.close

    def recv(self, batch: int) -> None:
        self._env.recv()


class _RayActors:
    """Actor for each worker, which has its environments in Gymnasium's SyncVectorEnv."""

    def __init__(self, make: Make, count: int, workers: int, batch: int) -> None:
        self._ray = peers.ray(workers)
        vector, self._numpy = import_module("gymnasium.vector"), import_module("numpy")
        self._each = count // workers
        actor = self._ray.remote(num_cpus=0)(vector.SyncVectorEnv)
        # Without a copy here, since Ray copies what leaves the actor.
        self._actors = [actor.remote([make] * self._each, copy=False) for _ in range(workers)]
        space = make().action_space
        self.action_space = import_module("gymnasium.vector.utils").batch_space(space, count)
        self._under_way: dict[Any, Any] = {}
        self._ready: list[Any] = []
        self.reset(seed=0)  # which waits until all are ready, as others do

    def reset(self, seed: int) -> None:
        self._ray.get(self._reset(seed))

    def step(self, actions: Any) -> tuple[Any, ...]:
        return self._joined(self._ray.get(self._step(self._actors, actions)))

    def reset_async(self, seed: int) -> None:
        self._under_way = dict(zip(self._reset(seed), self._actors, strict=True))

    def recv(self, batch: int) -> tuple[Any, ...]:
        ready, _ = self._ray.wait(list(self._under_way), num_returns=batch // self._each)
        self._ready = [self._under_way.pop(reference) for reference in ready]
        return self._joined(self._ray.get(ready))

    def send(self, actions: Any) -> None:
        self._under_way.update(zip(self._step(self._ready, actions), self._ready, strict=True))

    def close(self) -> None:
        for actor in self._actors:
            self._ray.kill(actor)

    def _reset(self, seed: int) -> list[Any]:
        return [
            actor.reset.remote(seed=seed + number * self._each)
            for number, actor in enumerate(self._actors)
        ]

    def _step(self, actors: list[Any], actions: Any) -> list[Any]:
        parts = self._numpy.split(actions, len(actors))
        return [actor.step.remote(part) for actor, part in zip(actors, parts, strict=True)]

    def _joined(self, results: list[Any]) -> tuple[Any, ...]:
        """Return observations and, unless after a reset, rewards and endings; no infos."""
        columns = zip(*(result[:-1] for result in results), strict=False)
        return tuple(self._numpy.concatenate(column) for column in columns)


class _EnvPool:
    """Environments in C++ and threads of this process: none of Python's, but a CartPole."""

    def __init__(self, make: Make, count: int, workers: int, batch: int) -> None:
        if make is not cart_pole:
            raise ValueError("EnvPool has no environments written in Python")
        self._env = import_module("envpool").make_gymnasium(
            "CartPole-v1", num_envs=count, num_threads=workers
        )
        spaces = import_module("gymnasium.vector.utils")
        self.action_space = spaces.batch_space(self._env.action_space, count)
        self.step = self._env.step
        self.close = self._env.close

    def reset(self, seed: int) -> None:
        self._env.reset()


_ADAPTERS: dict[str, Callable[[Make, int, int, int], Any]] = {
    "fiber": _fiber,
    "fiber-loopback": _fiber,
    "fiber-kubernetes": _fiber,
    "fiber-relay": _fiber,
    "async-vector-env": _async,
    "sync-vector-env": _sync,
    "stable-baselines3": _SubprocVecEnv,
    "pufferlib": _PufferLib,
    "ray-actors": _RayActors,
    "envpool": _EnvPool,
}
