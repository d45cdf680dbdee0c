"""stable-baselines3: its own tests of vector environments, and PPO in a SubprocVecEnv."""

from __future__ import annotations

import importlib
from typing import Any

from published.records import Package, Program, Version
from published.runs import Run, Value

TESTS = ("tests/test_vec_envs.py",)
MODULE = "stable_baselines3.common.vec_env.subproc_vec_env"
STEPS = 1024


def cart_pole() -> Any:
    """Make one environment."""
    return importlib.import_module("gymnasium").make("CartPole-v1")


def tests(run: Run) -> dict[str, Value]:
    """Run the tests; compare their outcomes."""
    run.import_from()
    return run.tests(*TESTS, cwd=run.clone, adopt=[MODULE])


def ppo(run: Run) -> dict[str, Value]:
    """Learn CartPole by PPO; compare the parameters of the policy."""
    run.import_from()
    importlib.import_module("torch").set_num_threads(1)
    module = importlib.import_module(MODULE)
    run.adopt(MODULE)
    env = module.SubprocVecEnv([cart_pole] * 2)
    model = importlib.import_module("stable_baselines3").PPO(
        "MlpPolicy", env, n_steps=128, seed=1, device="cpu"
    )
    model.learn(STEPS)
    env.close()
    return {name: each.tolist() for name, each in model.policy.state_dict().items()}


PACKAGES = (
    Package("gymnasium", "gymnasium>=1.0"),
    Package("torch", "torch>=2.3"),
    Package("pandas", "pandas>=2.2"),
    Package("matplotlib", "matplotlib>=3.8"),
)
VERSION = Version("stable_baselines3/version.txt", ">=2.4.0a0", r"(\S+)")
PROGRAMS = [
    Program(
        name="stable-baselines3-tests",
        upstream="https://github.com/DLR-RM/stable-baselines3",
        clone="stable-baselines3",
        way="`fiber.adopt`",
        ran="its tests of vector environments",
        run=tests,
        files=TESTS,
        packages=(*PACKAGES, Package("pytest", "pytest>=8.3")),
        version=VERSION,
    ),
    Program(
        name="stable-baselines3-ppo",
        upstream="https://github.com/DLR-RM/stable-baselines3",
        clone="stable-baselines3",
        way="`fiber.adopt`",
        ran=f"PPO on CartPole in `SubprocVecEnv`, {STEPS} steps",
        run=ppo,
        files=("stable_baselines3/ppo/ppo.py",),
        packages=PACKAGES,
        version=VERSION,
    ),
]
