"""Maps a function over numbers, and says in JSON, a line each, how that goes.

``{"event": "first", "at": …}`` follows the first result, ``half`` half of them, ``done`` them all;
``at`` is the monotonic clock, which is the same in pods and beside them on one machine.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import signal
import socket
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import fiber

MARK = Path(tempfile.gettempdir(), "this-pod-had-its-accident")


def square(seconds: float, number: int) -> tuple[int, str]:
    """The square after so many seconds, and the host that it was made on."""
    time.sleep(seconds)
    return number * number, socket.gethostname()


def loud(seconds: float, number: int) -> tuple[int, str]:
    """The same, and a line of output for every time that it is done."""
    print(f"task {number} runs", flush=True)
    return square(seconds, number)


def kill(seconds: float, number: int) -> tuple[int, str]:
    """The same, but the first task of each pod that ends in 7 ends its process."""
    if number % 10 == 7 and _first_time():
        os.kill(os.getpid(), signal.SIGKILL)
    return square(seconds, number)


@fiber.meta(memory=160)
def swell(seconds: float, number: int) -> tuple[int, str]:
    """The same, but task 7 needs more memory than there is, wherever it runs."""
    if number == 7:
        bytearray(1 << 30)
    return square(seconds, number)


TASKS: dict[str, Callable[[float, int], tuple[int, str]]] = {
    task.__name__: task for task in (square, loud, kill, swell)
}


def main() -> None:
    """Run with the arguments' settings and compare the results with the built-in map's."""
    options = _parse()
    fiber.init(retries=options.retries)
    task = partial(TASKS[options.task], options.seconds)
    say("began")
    hosts, total = set(), 0
    with pool_for(options) as pool:
        if options.together:
            pool.wait_until_workers_up()
        results = pool.imap(task, range(options.tasks), chunksize=1)
        for done, (result, host) in enumerate(results, 1):
            if done == 1:
                say("first")
            if done == options.tasks // 2:
                say("half")
                hold(options.hold)
            total += result
            hosts.add(host)
        say("done", total=total, hosts=sorted(hosts))
        if options.stay:
            signal.pause()
    say("left")


def pool_for(options: argparse.Namespace) -> Any:
    """Return a pool of the requested number of workers, or of as many as the work needs."""
    if options.most:
        return fiber.Pool(min_workers=0, max_workers=options.most, idle_timeout=1)
    return fiber.Pool(options.workers, disruptions=options.disruptions)


def hold(seconds: int) -> None:
    """Let no other thread of this interpreter run for so long."""
    ctypes.PyDLL(None).sleep(seconds)


def say(event: str, **facts: object) -> None:
    """A line for the test."""
    print(json.dumps({"event": event, "at": time.monotonic(), **facts}) + "\n", end="", flush=True)


def _first_time() -> bool:
    try:
        MARK.touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", choices=TASKS, default="square")
    parser.add_argument("--tasks", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=0.02)
    parser.add_argument("--retries", type=int, default=3)
    parser.add_argument("--disruptions", type=int, help="as configured, if it is not given")
    parser.add_argument("--most", type=int, help="workers, as many as the work asks for")
    parser.add_argument("--together", action="store_true", help="begin once all workers are ready")
    parser.add_argument("--stay", action="store_true", help="keep the pool until a signal comes")
    parser.add_argument("--hold", type=int, default=0, help="seconds, when half is done")
    return parser.parse_args()


if __name__ == "__main__":
    main()
