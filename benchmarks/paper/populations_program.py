"""Program whose population grows and shrinks: reads a plan from standard input, plays it on pods.

It prints a line of JSON for each event: its name, its time by the monotonic clock, and a number.
Without imports from the checkout, so that few files go to the pods.
"""

from __future__ import annotations

import json
import sys
import time
from contextlib import ExitStack
from typing import Any

import fiber


def play(seconds: float) -> None:
    """Take as long as the episodes, on a worker without a GPU."""
    time.sleep(seconds)


@fiber.meta(gpu=1)
def play_on_gpu(seconds: float) -> None:
    """Take as long as the episodes, on a worker with a GPU."""
    time.sleep(seconds)


def tell(event: str, number: int = 0) -> None:
    """Print an event of this moment."""
    print(json.dumps([event, time.monotonic(), number]), flush=True)


def dynamic(phases: list[dict[str, Any]], idle: float) -> None:
    """Play each phase on a pool that follows the work."""
    for phase in phases:
        with fiber.Pool(min_workers=1, max_workers=phase["peak"], idle_timeout=idle) as pool:
            play_phase(pool, phase)


def static(phases: list[dict[str, Any]]) -> None:
    """Start the workers of all phases at first, and hold them until the last phase is over."""
    with ExitStack() as stack:
        pools = [stack.enter_context(fiber.Pool(phase["peak"])) for phase in phases]
        for pool, phase in zip(pools, phases, strict=True):
            # A task and not start_workers, which would not know that the tasks need GPUs.
            pool.map_async(function_of(phase), [0.0] * phase["peak"], 1)
        for pool, phase in zip(pools, phases, strict=True):
            play_phase(pool, phase)


def function_of(phase: dict[str, Any]) -> Any:
    return play_on_gpu if phase["gpu"] else play


def play_phase(pool: Any, phase: dict[str, Any]) -> None:
    """Play the waves one after the other; tell how many tasks are open."""
    for wave in phase["waves"]:
        tell("open", len(wave))
        results = pool.imap_unordered(function_of(phase), wave, 1)
        for done, _ in enumerate(results, 1):
            tell("open", len(wave) - done)


def main() -> None:
    plan = json.load(sys.stdin)
    tell("begin")
    if plan["allocation"] == "dynamic":
        dynamic(plan["phases"], plan["idle"])
    else:
        static(plan["phases"])
    tell("end")


if __name__ == "__main__":
    main()
