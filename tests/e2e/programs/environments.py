"""A vector environment of four, in two workers; in one of them something happens.

Says in JSON, a line each: ``sent`` with the host of each environment, when the others are done and
one has begun its last step; then ``received``, or ``lost`` with the error; and ``left``.
"""

from __future__ import annotations

import argparse
import json
import signal
import socket
import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

import fiber
from fiber.errors import WorkerDied
from fiber.vector import VectorEnv

ENVS, WORKERS = 4, 2
UNLUCKY = 2
STEP, WAIT, SWELL, CRASH, HANG = range(5)
"""Actions: make a step; wait for the end; need more and more memory; a fault of native code, and
native code that does not return.
"""
ACCIDENTS = {"wait": WAIT, "swell": SWELL, "crash": CRASH, "hang": HANG}


class Steps(gymnasium.Env[Any, Any]):
    """Observes how many steps it has made."""

    observation_space = spaces.Box(0, np.inf, (1,), np.float64)
    action_space = spaces.Discrete(5)

    def __init__(self) -> None:
        self.steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return np.array([0.0]), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if action == WAIT:
            signal.pause()
        if action == CRASH:
            signal.raise_signal(signal.SIGSEGV)
        if action == HANG:
            signal.raise_signal(signal.SIGSTOP)
        hoard = []
        while action == SWELL:
            hoard.append(bytearray(8 << 20))
        self.steps += 1
        return np.array([float(self.steps)]), 1.0, False, False, {}

    def host(self) -> str:
        return socket.gethostname()


@fiber.meta(memory=192)
def make() -> Steps:
    return Steps()


def main() -> None:
    """Run with the environments of the arguments; exit with 0 also if some are lost, as tests
    expect.
    """
    options = _parse()
    envs = VectorEnv(
        [make] * ENVS, num_workers=WORKERS, on_error=options.on_error, timeout=options.timeout
    )
    envs.reset(seed=1)
    everybody = np.full(ENVS, STEP)
    envs.step(everybody)
    actions = everybody.copy()
    actions[UNLUCKY] = ACCIDENTS[options.accident]
    hosts = envs.call("host")
    envs.send(actions)
    try:
        others = envs.recv(ENVS - WORKERS)  # those of the other worker
        say("sent", hosts=hosts, **facts(*others))
        say("received", **facts(*envs.recv(WORKERS)))
        say("goes on", steps=envs.step(everybody)[0].ravel().tolist())
    except WorkerDied as error:
        say("lost", text=str(error), pod=error.pod)
    envs.close()
    say("left")


def facts(
    observations: Any, rewards: Any, terminations: Any, truncations: Any, infos: dict[str, Any]
) -> dict[str, Any]:
    """Return the received values by the number of the environment."""
    numbers = infos["env_id"].tolist()
    restarted = infos.get("restarted", [None] * len(numbers))
    columns = {
        "steps": observations.ravel().tolist(),
        "truncated": truncations.tolist(),
        "restarted": restarted,
    }
    return {name: dict(zip(numbers, values, strict=True)) for name, values in columns.items()}


def say(event: str, **facts: object) -> None:
    """A line for the test."""
    print(json.dumps({"event": event, "at": time.monotonic(), **facts}) + "\n", end="", flush=True)


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("--on-error", default="raise")
    parser.add_argument("--accident", choices=ACCIDENTS, default="wait")
    parser.add_argument("--timeout", type=float)
    return parser.parse_args()


if __name__ == "__main__":
    main()
