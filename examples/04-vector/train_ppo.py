"""PPO in NumPy on a Gymnasium task, whose environments are stepped by fiber.vector.

Prints the return as it rises and draws the learning curve.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

# With matrices as small as these, threads only wait for each other. NumPy reads this when imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import gymnasium as gym
import numpy as np
from learning_curve import Ended, write_curve
from ppo import Experience, Learner

import fiber
from fiber.vector import VectorEnv, make_vec

HORIZON = 64  # steps of each environment between two improvements
RECENT = 50  # episodes in the mean return that is printed


def main(arguments: Sequence[str] | None = None) -> int:
    """Train and draw; returns the exit status."""
    options = parse(arguments)
    rng = np.random.default_rng(options.seed)
    envs = make_vec(
        options.env,
        options.envs,
        vector_kwargs={"num_workers": options.workers, "autoreset_mode": "SameStep"},
    )
    ended: list[Ended] = []
    started = time.monotonic()
    try:
        actions: Any = envs.single_action_space
        (inputs,) = envs.single_observation_space.shape or ()
        learner = Learner(inputs, int(actions.n), rng)
        print(
            f"{options.env}: {learner.size} parameters, {options.envs} environments,"
            f" {options.workers} workers"
        )
        train(envs, learner, options, ended)
    except KeyboardInterrupt:
        print("interrupted")
        return 130
    finally:
        envs.close()
    took = time.monotonic() - started
    print(f"trained in {took:.1f} s: {options.steps / took:,.0f} steps a second")
    write_curve(options.out, f"PPO on {options.env}", ended)
    print(f"learning curve: {options.out}")
    return 0


def train(
    envs: VectorEnv, learner: Learner, options: argparse.Namespace, ended: list[Ended]
) -> None:
    """Roll out and learn in turn; add episodes to `ended` as they end."""
    rounds = max(1, options.steps // (HORIZON * options.envs))
    observations, _ = envs.reset(seed=options.seed)
    returns = np.zeros(options.envs)
    recent: deque[float] = deque(maxlen=RECENT)
    for number in range(1, rounds + 1):
        steps = number * HORIZON * options.envs
        experience, observations = roll_out(envs, learner, observations)
        for rewards, over in zip(experience.rewards, experience.over, strict=True):
            returns += rewards
            for which in np.flatnonzero(over):
                ended.append(Ended(steps, float(returns[which])))
                recent.append(float(returns[which]))
                returns[which] = 0.0
        learner.learn(experience, 1 - (number - 1) / rounds)
        if number % max(1, rounds // 10) == 0:
            mean = f"{np.mean(recent):8.1f}" if recent else "no episode has ended"
            print(f"{steps:8,} steps   return of the last {RECENT} episodes {mean}")


def roll_out(envs: VectorEnv, learner: Learner, observations: Any) -> tuple[Experience, Any]:
    """Let the policy act for a while; return the rollout, and the last observations."""
    taken: list[tuple[Any, ...]] = []
    for _ in range(HORIZON):
        before = observations.astype(np.float64)
        actions, likelihoods, values = learner.act(before)
        observations, rewards, terminations, truncations, infos = envs.step(actions)
        cut_short = np.zeros_like(rewards)
        if truncations.any():
            last = np.stack(infos["final_obs"][truncations]).astype(np.float64)
            cut_short[truncations] = learner.values(last)
        over = terminations | truncations
        taken.append((before, actions, likelihoods, values, rewards, over, cut_short))
    columns = [np.stack(column) for column in zip(*taken, strict=True)]
    last_values = learner.values(observations.astype(np.float64))
    return Experience._make([*columns, last_values]), observations


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the options; report wrong ones before anything starts."""
    parser = argparse.ArgumentParser(description="PPO in NumPy with fiber.vector.")
    parser.add_argument("--env", default="CartPole-v1", help="flat observations, few actions")
    parser.add_argument("--envs", type=int, default=16, help="how many environments")
    parser.add_argument("--workers", type=int, default=fiber.cpu_count())
    parser.add_argument("--steps", type=int, default=100_000, help="of all environments")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("learning-curve.png"))
    options = parser.parse_args(arguments)
    if options.envs < 1 or options.workers < 1 or options.steps < 1:
        parser.error("--envs, --workers and --steps must be at least 1")
    if options.seed < 0:
        parser.error(f"--seed must not be negative, as {options.seed} is")
    if not options.out.parent.is_dir():
        parser.error(f"--out {options.out}: there is no folder {options.out.parent}")
    try:
        with gym.make(options.env) as env:
            if not isinstance(env.action_space, gym.spaces.Discrete):
                parser.error(f"--env {options.env}: its actions are {env.action_space}")
            if len(env.observation_space.shape or ()) != 1:
                parser.error(f"--env {options.env}: its observations are {env.observation_space}")
    except gym.error.Error as error:
        parser.error(f"--env {options.env}: {error}")
    return options


if __name__ == "__main__":
    sys.exit(main())
