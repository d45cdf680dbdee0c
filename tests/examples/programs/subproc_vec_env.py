"""A vector environment as OpenAI Baselines has it: some environments a process, commands down a
pipe, the parent's end closed in the child, an end that the garbage collector begins.

    subproc_vec_env.py multiprocessing|fiber
"""

from __future__ import annotations

import contextlib
import importlib
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from typing import Any

import cloudpickle
import gymnasium
import numpy as np

mp: Any = importlib.import_module(sys.argv[1] if len(sys.argv) > 1 else "multiprocessing")


class CloudpickleWrapper:
    """multiprocessing's pickle knows no lambdas."""

    def __init__(self, x: Any) -> None:
        self.x = x

    def __getstate__(self) -> bytes:
        dumped: bytes = cloudpickle.dumps(self.x)
        return dumped

    def __setstate__(self, dumped: bytes) -> None:
        self.x = pickle.loads(dumped)


@contextlib.contextmanager
def without_mpi_variables() -> Iterator[None]:
    """Hide the variables that make an MPI in a child think that mpirun started it."""
    removed = {name: os.environ.pop(name) for name in list(os.environ) if name.startswith("PMI_")}
    try:
        yield
    finally:
        os.environ.update(removed)


def worker(remote: Any, parent_remote: Any, env_fn_wrappers: CloudpickleWrapper) -> None:
    def step_env(env: Any, action: Any) -> tuple[Any, float, bool, dict[str, Any]]:
        ob, reward, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            ob, _ = env.reset()
        return ob, reward, terminated or truncated, info

    parent_remote.close()
    envs = [env_fn() for env_fn in env_fn_wrappers.x]
    try:
        while True:
            cmd, data = remote.recv()
            if cmd == "step":
                remote.send([step_env(env, act) for env, act in zip(envs, data, strict=True)])
            elif cmd == "reset":
                pairs = zip(envs, data, strict=True)
                remote.send([env.reset(seed=int(seed))[0] for env, seed in pairs])
            elif cmd == "close":
                remote.close()
                break
            elif cmd == "get_spaces_spec":
                spec = envs[0].observation_space, envs[0].action_space, envs[0].spec.id
                remote.send(CloudpickleWrapper(spec))
            else:
                raise NotImplementedError
    except KeyboardInterrupt:
        print("SubprocVecEnv worker: got KeyboardInterrupt")
    finally:
        for env in envs:
            env.close()


class SubprocVecEnv:
    def __init__(
        self, env_fns: list[Callable[[], Any]], context: str = "spawn", in_series: int = 1
    ) -> None:
        self.waiting = False
        self.closed = False
        self.num_envs = len(env_fns)
        groups = np.array_split(np.array(env_fns), len(env_fns) // in_series)
        ctx = mp.get_context(context)
        self.remotes, self.work_remotes = zip(*[ctx.Pipe() for _ in groups], strict=True)
        self.ps = [
            ctx.Process(target=worker, args=(work_remote, remote, CloudpickleWrapper(group)))
            for work_remote, remote, group in zip(
                self.work_remotes, self.remotes, groups, strict=True
            )
        ]
        for p in self.ps:
            p.daemon = True
            with without_mpi_variables():
                p.start()
        for remote in self.work_remotes:
            remote.close()
        self.remotes[0].send(("get_spaces_spec", None))
        self.observation_space, self.action_space, self.spec = self.remotes[0].recv().x

    def step_async(self, actions: Any) -> None:
        for remote, action in zip(
            self.remotes, np.array_split(actions, len(self.remotes)), strict=True
        ):
            remote.send(("step", action))
        self.waiting = True

    def step_wait(self) -> tuple[Any, Any, Any]:
        results = [result for remote in self.remotes for result in remote.recv()]
        self.waiting = False
        obs, rews, dones, _ = zip(*results, strict=True)
        return np.stack(obs), np.stack(rews), np.stack(dones)

    def reset(self, seed: int) -> Any:
        seeds = np.array_split(np.arange(seed, seed + self.num_envs), len(self.remotes))
        for remote, some in zip(self.remotes, seeds, strict=True):
            remote.send(("reset", some))
        return np.stack([ob for remote in self.remotes for ob in remote.recv()])

    def close(self) -> None:
        self.closed = True
        if self.waiting:
            for remote in self.remotes:
                remote.recv()
        for remote in self.remotes:
            remote.send(("close", None))
        for p in self.ps:
            p.join()

    def __del__(self) -> None:
        if not self.closed:
            self.close()


def main() -> None:
    envs = SubprocVecEnv([lambda: gymnasium.make("CartPole-v1") for _ in range(4)], in_series=2)
    envs.action_space.seed(0)
    print(envs.spec, envs.observation_space.shape)
    obs = envs.reset(seed=3)
    ended, total = 0, float(obs.sum())
    for _ in range(60):
        envs.step_async([envs.action_space.sample() for _ in range(4)])
        obs, rews, dones = envs.step_wait()
        ended += int(dones.sum())
        total += float(obs.sum() + rews.sum())
    print(f"{ended} {total:.6f}")
    envs.step_async([0] * 4)
    processes = envs.ps
    del envs  # with a step under way
    print([p.exitcode for p in processes])


if __name__ == "__main__":
    main()
