"""OpenAI's baselines: the tests of its vector environments, and Breakout with its wrappers."""

from __future__ import annotations

import importlib
import zlib
from typing import Any

from published.records import Package, Program
from published.runs import Run, Value

FOLDER = "baselines/common/vec_env"
MODULES = ("subproc_vec_env", "shmem_vec_env")
ENVIRONMENTS, STEPS = 4, 100


class Breakout:
    """Function that makes one seeded Breakout, with the wrappers of DeepMind's paper."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def __call__(self) -> Any:
        wrappers = importlib.import_module("baselines.common.atari_wrappers")
        env = wrappers.make_atari("BreakoutNoFrameskip-v4")
        env.seed(self.seed)
        return wrappers.wrap_deepmind(env, frame_stack=False)


def tests(run: Run) -> dict[str, Value]:
    """Run the tests of vec_env; compare their outcomes."""
    run.stand_in("gym")
    run.import_from()
    adopted = [f"baselines.common.vec_env.{module}" for module in MODULES]
    return run.tests(f"{FOLDER}/test_vec_env.py", cwd=run.clone, adopt=adopted)


def breakout(run: Run) -> dict[str, Value]:
    """Step SubprocVecEnv with seeded actions; compare observations, rewards and ends."""
    import numpy as np

    run.stand_in("gym")
    run.import_from()
    module = importlib.import_module("baselines.common.vec_env.subproc_vec_env")
    run.adopt(module.__name__)
    env = module.SubprocVecEnv([Breakout(seed) for seed in range(ENVIRONMENTS)])
    actions = np.random.RandomState(0).randint(env.action_space.n, size=(STEPS, ENVIRONMENTS))
    observed, rewarded, ended = [zlib.crc32(env.reset().tobytes())], [], []
    for action in actions:
        observations, rewards, dones, _ = env.step(action)
        observed.append(zlib.crc32(observations.tobytes()))
        rewarded.append(rewards.tolist())
        ended.append(dones.tolist())
    env.close()
    return {"observations": observed, "rewards": rewarded, "dones": ended}


CV2 = "opencv-python-headless>=4.8"
PACKAGES = (
    Package("numpy", "numpy>=1.26"),
    Package("gymnasium", "gymnasium>=1.0"),
    Package("scipy", "scipy>=1.1"),
    Package("cloudpickle", "cloudpickle>=3.0"),
)
PROGRAMS = [
    Program(
        name="baselines-tests",
        upstream="https://github.com/openai/baselines",
        clone="baselines",
        way="`fiber.adopt`",
        ran="the tests of `vec_env`: `SubprocVecEnv`, `ShmemVecEnv`",
        run=tests,
        files=(f"{FOLDER}/test_vec_env.py", f"{FOLDER}/shmem_vec_env.py"),
        packages=(*PACKAGES, Package("pytest", "pytest>=8.3")),
        stood_in=("gym",),
    ),
    Program(
        name="baselines-breakout",
        upstream="https://github.com/openai/baselines",
        clone="baselines",
        way="`fiber.adopt`",
        ran=f"Breakout by its wrappers in `SubprocVecEnv`: {ENVIRONMENTS} times {STEPS} steps",
        run=breakout,
        files=("baselines/common/atari_wrappers.py", f"{FOLDER}/subproc_vec_env.py"),
        packages=(*PACKAGES, Package("ale_py", "ale-py>=0.10"), Package("cv2", CV2)),
        roms=("breakout",),
        stood_in=("gym",),
    ),
]
