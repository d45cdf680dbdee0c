"""Picture of the walker: its learning curve, and frames of an episode of the best policy."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from benchmarks.paper import packages

if TYPE_CHECKING:
    from benchmarks.paper.walker import Results

FRAMES = 6
SEED = 2**31 + 100
EVERY = 4
_SPREAD, _MEAN, _SOLVED = "#0072B2", "#D55E00", "#777777"
SOLVED = 300


def draw(results: Results, path: Path) -> None:
    """Play one episode with the best policy, and write the picture."""
    # Imported here, because the workers do not need it. A separate Figure draws without a display.
    from matplotlib.figure import Figure

    frames, total = _play(results)
    figure = Figure(figsize=(11, 6.2), dpi=110, layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(2.1, 1))
    _curve(figure.add_subplot(grid[0]), results)
    strip = figure.add_subplot(grid[1])
    strip.imshow(np.concatenate(frames, axis=1))
    strip.set_axis_off()
    strip.set_title(f"one new episode of the best policy, return {total:.0f}", fontsize=10)
    figure.savefig(path, metadata={"Software": None})


def _curve(axes: Any, results: Results) -> None:
    generations = [test.generation for test in results.tests]
    returns = np.array([test.returns for test in results.tests])
    axes.fill_between(
        generations,
        returns.min(axis=1),
        returns.max(axis=1),
        color=_SPREAD,
        alpha=0.15,
        label=f"least to greatest of {returns.shape[1]} new episodes",
    )
    axes.plot(generations, returns.mean(axis=1), color=_MEAN, lw=2.2, label="mean")
    axes.axhline(SOLVED, color=_SOLVED, ls="--", lw=1, label="solved")
    axes.set(xlabel="generation", ylabel="return of an episode")
    axes.set_title("BipedalWalker-v3 by evolution strategies with fiber.Pool", loc="left")
    axes.legend(frameon=False, fontsize=9, loc="lower right")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#eeeeee")


def _play(results: Results) -> tuple[list[Any], float]:
    """Return frames, evenly spaced over an episode, and its return."""
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    env = packages.walker(packages.WALKER, render_mode="rgb_array")
    weights, offset = np.array(results.weights), np.array(results.offset)
    observation, _ = env.reset(seed=SEED)
    frames, total, over, step = [], 0.0, False, 0
    while not over:
        if step % EVERY == 0:
            frames.append(env.render()[60:360])
        observation, reward, terminated, truncated, _ = env.step(
            np.clip(weights @ observation - offset, -1, 1)
        )
        total += float(reward)
        over = terminated or truncated
        step += 1
    env.close()
    chosen = np.linspace(0, len(frames) - 1, FRAMES).round().astype(int)
    return [frames[number] for number in chosen], total
