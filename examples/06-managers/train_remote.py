"""Train a policy on environments that are managed objects: the paper's third listing.

Each environment has its own process, which on a cluster is a pod. The learner steps all of them
side by side and learns from the results.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from actor_critic import ActorCritic, Array
from remote_envs import RemoteEnvs

ROLLOUT = 20
"""Steps of each environment between two updates."""
LATELY = 20
"""Episodes of which the mean return is shown."""


class Training(NamedTuple):
    """Outcome of a training."""

    ended: list[tuple[int, float]]
    """Episodes that ended: after how many steps of all environments, and their returns."""
    rate: float
    """Steps of all environments a second."""


def train(envs: RemoteEnvs, model: ActorCritic, options: argparse.Namespace) -> Training:
    """Step all of the environments and learn, ``options.updates`` times."""
    observations = envs.reset(options.seed)
    running, ended = np.zeros(options.envs), list[tuple[int, float]]()
    started = time.perf_counter()
    for update in range(options.updates):
        seen, taken, gained, over = [observations], list[Array](), list[Array](), list[Array]()
        for _ in range(ROLLOUT):
            actions = model.act(observations)
            observations, rewards, done = envs.step(actions)
            running += rewards
            steps = (update * ROLLOUT + len(taken) + 1) * options.envs
            ended += [(steps, float(total)) for total in running[done]]
            running[done] = 0
            seen.append(observations)
            taken.append(actions)
            gained.append(rewards)
            over.append(done)
        model.update(*map(np.array, (seen, taken, gained, over)))
        returns = [total for _, total in ended[-LATELY:]]
        if returns and (update + 1) % 10 == 0:
            print(f"update {update + 1:4}   mean return {np.mean(returns):6.1f}", flush=True)
    taken_steps = options.updates * ROLLOUT * options.envs
    return Training(ended, taken_steps / (time.perf_counter() - started))


def rate_one_after_the_other(options: argparse.Namespace) -> float:
    """Return steps a second of the same environments without AsyncManager."""
    with RemoteEnvs(options.env, options.envs, options.ms, side_by_side=False) as envs:
        envs.reset(options.seed)
        started = time.perf_counter()
        for _ in range(ROLLOUT):
            envs.step(np.zeros(options.envs, int))
        steps: int = ROLLOUT * options.envs
        return steps / (time.perf_counter() - started)


def draw(path: Path, training: Training, alone: float, options: argparse.Namespace) -> None:
    """Draw the returns of the episodes, and the steps a second with either manager."""
    # Imported here, because the environments' processes do not need it. It draws without a display.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.6, 3.8), dpi=150, layout="constrained")
    curve, bars = figure.subplots(1, 2, width_ratios=(2.4, 1))
    steps, returns = np.array(training.ended or [(0, 0.0)]).T
    curve.scatter(steps, returns, s=8, color="#94a3b8", lw=0, label="an episode")
    window = min(LATELY, len(returns))
    mean = np.convolve(returns, np.full(window, 1 / window), "valid")
    curve.plot(steps[window - 1 :], mean, color="#c2410c", lw=2, label=f"mean of {window}")
    curve.set_xlabel("steps of all environments")
    curve.set_ylabel("return")
    curve.set_title(f"{options.envs} x {options.env}", loc="left", fontweight="bold")
    curve.legend(frameon=False)
    names = ["one after\nthe other", "side by side\n(AsyncManager)"]
    drawn = bars.bar(names, [alone, training.rate], color=["#94a3b8", "#2563eb"], width=0.6)
    bars.bar_label(drawn, fmt="{:,.0f}")
    bars.set_title(f"steps a second, {options.ms:g} ms each", fontsize=10)
    for axes in (curve, bars):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--env", default="CartPole-v1", help="with Discrete actions")
    parser.add_argument("--envs", type=int, default=10, help="how many environments")
    parser.add_argument("--updates", type=int, default=80)
    parser.add_argument("--ms", type=float, default=10.0, help="milliseconds of a step at least")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("managers.png"), help="the picture")
    options = parser.parse_args(arguments)
    if options.envs < 1 or options.updates < 1 or options.ms < 0:
        parser.error("--envs and --updates must be at least 1, --ms at least 0")
    try:
        env = gym.make(options.env)
    except gym.error.Error as error:
        parser.error(f"--env {options.env}: {error}")
    if not isinstance(env.action_space, gym.spaces.Discrete):
        parser.error(f"--env {options.env}: its actions are {env.action_space}, not Discrete")
    if not isinstance(env.observation_space, gym.spaces.Box):
        parser.error(f"--env {options.env}: its observations are no vectors")
    options.observation_size = int(np.prod(env.observation_space.shape))
    options.actions = int(env.action_space.n)
    return options


def main() -> None:
    options = parse()
    alone = rate_one_after_the_other(options)
    print(f"{options.envs} x {options.env}, a step takes {options.ms:g} ms at least")
    print(f"one after the other: {alone:8,.0f} steps a second", flush=True)
    model = ActorCritic(options.observation_size, options.actions, options.seed)
    with RemoteEnvs(options.env, options.envs, options.ms, side_by_side=True) as envs:
        training = train(envs, model, options)
    print(f"side by side:        {training.rate:8,.0f} steps a second")
    draw(options.out, training, alone, options)
    print(f"picture: {options.out}")


if __name__ == "__main__":
    main()
