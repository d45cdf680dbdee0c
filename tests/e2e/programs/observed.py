"""Program that is watched from outside: tasks that end, and tasks that wait for a signal."""

from __future__ import annotations

import contextlib
import json
import signal
import sys

import fiber


def double(number: int) -> int:
    """Return twice the number."""
    return 2 * number


def linger(_: int, begun: fiber.SimpleQueue[None]) -> None:
    """Say that this task has begun, and work until the worker is killed."""
    begun.put(None)
    signal.pause()


def main() -> None:
    """Run 100 tasks, then two that do not end; leave when both have lost their workers.

    With ``--stay``, wait for an interrupt before that.
    """
    fiber.init(retries=0)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with fiber.Pool(2) as pool:
        total = sum(pool.map(double, range(100)))
        begun: fiber.SimpleQueue[None] = fiber.SimpleQueue()
        results = [pool.apply_async(linger, (number, begun)) for number in range(2)]
        for _ in results:
            begun.get()
        with contextlib.suppress(KeyboardInterrupt):
            print(json.dumps({"event": "waiting", "total": total}) + "\n", end="", flush=True)
            for result in results:
                result.wait()
            if "--stay" in sys.argv:
                signal.pause()
    print(json.dumps({"event": "left"}) + "\n", end="", flush=True)


if __name__ == "__main__":
    main()
