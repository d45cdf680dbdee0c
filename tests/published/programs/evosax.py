"""evosax: evolution strategies in JAX, whose episodes run in a pool."""

from __future__ import annotations

import importlib
from typing import Any

from published.records import Package, Program
from published.runs import Run, Value

GENERATIONS, POPULATION = 4, 16
SIZES = (4, 8, 2)


def episode(task: tuple[Any, int]) -> float:
    """Play one episode of CartPole with a small network; return its length."""
    import gymnasium as gym
    import numpy as np

    theta, seed = task
    inputs, hidden, outputs = SIZES
    first = theta[: inputs * hidden].reshape(inputs, hidden)
    second = theta[inputs * hidden :].reshape(hidden, outputs)
    env = gym.make("CartPole-v1", max_episode_steps=100)
    observation, _ = env.reset(seed=seed)
    total, ended = 0.0, False
    while not ended:
        action = int(np.argmax(np.tanh(observation @ first) @ second))
        observation, reward, terminated, truncated, _ = env.step(action)
        total, ended = total + float(reward), terminated or truncated
    return total


def run(run: Run) -> dict[str, Value]:
    """Run OpenAI's strategy with a pool; compare returns and final parameters."""
    run.import_from()
    jax = importlib.import_module("jax")
    np = importlib.import_module("numpy")
    size = SIZES[0] * SIZES[1] + SIZES[1] * SIZES[2]
    strategy = importlib.import_module("evosax.algorithms").Open_ES(
        population_size=POPULATION, solution=np.zeros(size, np.float32)
    )
    params = strategy.default_params
    key = jax.random.key(0)
    state = strategy.init(key, np.zeros(size, np.float32), params)
    returns = []
    # JAX has threads, so multiprocessing must not fork.
    context = run.multiprocessing if run.on_fiber else run.multiprocessing.get_context("spawn")
    with context.Pool(2) as pool:
        for generation in range(GENERATIONS):
            key, asked, told = jax.random.split(key, 3)
            population, state = strategy.ask(asked, state, params)
            tasks = [(np.asarray(theta), generation) for theta in population]
            returns.append(pool.map(episode, tasks))
            fitness = -np.asarray(returns[-1], np.float32)
            state, _ = strategy.tell(told, population, fitness, state, params)
    return {"returns": returns, "mean": np.asarray(state.mean).tolist()}


PROGRAMS = [
    Program(
        name="evosax",
        upstream="https://github.com/RobertTLange/evosax",
        clone="evosax",
        way="`pool.map` for its evaluations",
        ran=f"`Open_ES` on CartPole, {GENERATIONS} generations of {POPULATION}",
        run=run,
        files=("evosax/algorithms/distribution_based/open_es.py",),
        packages=(
            Package("jax", "jax>=0.5"),
            Package("flax", "flax>=0.10"),
            Package("dotmap", "dotmap"),
            Package("gymnasium", "gymnasium>=1.0"),
        ),
    )
]
