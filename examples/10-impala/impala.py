"""IMPALA in small: actors on other processes or hosts feed a learner (Espeholt et al. 2018)."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import fiber

try:
    import gymnasium as gym
    import numpy as np
    from matplotlib.figure import Figure
    from vtrace import Array, Learner, Unroll, forward, new_weights
except ModuleNotFoundError as error:
    sys.exit(f"10-impala needs {error.name}: pip install --editable '.[rl]'")

STEPS, BATCH = 20, 4  # of an unroll, and unrolls of an update


def act(actor: int, options: argparse.Namespace, weights: Any, unrolls: Any) -> None:
    """Play with the newest weights that have come, and send what happened, until None comes."""
    env, rng = gym.make(options.env), np.random.default_rng([options.seed, actor])
    observation, total = env.reset(seed=options.seed + actor)[0], 0.0
    newest = weights.get()
    while newest is not None:
        seen, steps, ended = [observation], list[tuple[int, float, float, bool]](), list[float]()
        for _ in range(STEPS):
            chances = forward(newest[1], observation)[1]
            action = int((rng.random() > chances.cumsum()[:-1]).sum())
            observation, reward, terminated, truncated, _ = env.step(action)
            over, total = terminated or truncated, total + float(reward)
            if over:
                ended.append(total)
                observation, total = env.reset()[0], 0.0
            steps.append((action, chances[action], float(reward), over))
            seen.append(observation)
        columns = map(np.array, zip(*steps, strict=True))
        unrolls.put(Unroll(actor, newest[0], ended, np.array(seen), *columns))
        while not weights.empty():
            newest = weights.get()
    unrolls.put(None)


def train(learner: Learner, weights: list[Any], unrolls: Any, updates: int) -> Array:
    """Learn from the unrolls as they come; return steps, return and lag for each episode."""
    episodes = list[tuple[int, float, float]]()
    for update in range(1, updates + 1):
        steps = update * BATCH * STEPS
        batch: list[Unroll] = [unrolls.get() for _ in range(BATCH)]
        lag = learner.version - float(np.mean([unroll.version for unroll in batch]))
        learner.learn(batch)
        for unroll in batch:
            weights[unroll.actor].put((learner.version, learner.weights))
            episodes += [(steps, total, lag) for total in unroll.returns]
        if update % max(1, updates // 10) == 0:
            mean = np.mean([total for _, total, _ in episodes[-50:]]) if episodes else np.nan
            print(f"update {update}: {steps:,} steps, mean return {mean:.1f}, lag {lag:.1f}")
    return np.array(episodes)


def draw(path: Path, episodes: Array) -> None:
    """Draw the returns of the episodes, and how old the weights were that played them."""
    figure = Figure(figsize=(8.6, 4.6), dpi=150, layout="constrained")
    figure.suptitle("Return of each episode, and mean of the last 50")
    curve, lags = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    steps, returns, lag = episodes.T
    curve.scatter(steps, returns, s=6, color="#94a3b8")
    window = min(50, len(returns))
    curve.plot(steps[window - 1 :], np.convolve(returns, np.ones(window) / window, "valid"), "r")
    lags.plot(steps, lag, color="#2563eb", lw=1)
    lags.set(xlabel="steps of all actors", ylabel="updates behind")
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="CartPole-v1", help="with Discrete actions")
    parser.add_argument("--actors", type=int, default=4)
    parser.add_argument("--updates", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("impala.png"), help="the picture")
    options = parser.parse_args()
    if min(options.actors, options.updates) < 1 or options.seed < 0:
        parser.error("--actors and --updates must be at least 1, --seed at least 0")
    if not options.out.parent.is_dir():
        parser.error(f"--out {options.out}: there is no folder {options.out.parent}")
    if options.out.suffix not in (".png", ".pdf", ".svg"):
        parser.error(f"--out {options.out}: the name must end in .png, .pdf or .svg")
    try:
        env: Any = gym.make(options.env)
    except (gym.error.Error, ImportError) as error:
        parser.error(f"--env {options.env}: {error}")
    shape: tuple[int, ...] = env.observation_space.shape or ()
    if len(shape) != 1 or not isinstance(env.action_space, gym.spaces.Discrete):
        parser.error(f"--env {options.env}: observations must be vectors, and actions Discrete")
    learner = Learner(new_weights(shape[0], int(env.action_space.n), options.seed))
    unrolls: Any = fiber.Queue(2 * options.actors)  # bounded: fast actors wait for the learner
    weights: list[Any] = [fiber.Queue() for _ in range(options.actors)]
    actors = [
        fiber.Process(target=act, args=(number, options, own, unrolls), daemon=True)
        for number, own in enumerate(weights)
    ]
    for own, actor in zip(weights, actors, strict=True):
        own.put((0, learner.weights))
        actor.start()
    episodes = train(learner, weights, unrolls, options.updates)
    for own in weights:
        own.put(None)
    for actor in actors:
        while unrolls.get() is not None:
            pass  # what actors sent meanwhile
        actor.join()
    if not len(episodes):
        sys.exit("No episode has ended, so there is nothing to draw. Take more --updates.")
    draw(options.out, episodes)
    print(f"picture: {options.out}")


if __name__ == "__main__":
    main()
