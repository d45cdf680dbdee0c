"""Each feature of a ``fiber.Executor`` on one line, the same wherever its workers are.

With ``--lose`` a task waits for its pod to be deleted, and runs again as often as ``--retries``
says: the program then says in JSON what came of it, ``done`` or ``lost``, and ``goes on``.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import signal
import socket
import time
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, as_completed
from typing import Any

import fiber

_started: Any = None


def begin(started: Any) -> None:
    """The initializer: how often ``wait_once`` has begun, in all workers together."""
    global _started
    _started = started


def square(number: int) -> int:
    return number * number


def host(number: int) -> str:
    return socket.gethostname()


def nap(number: int) -> int:
    time.sleep(0.2)
    return number


def wait_once() -> int:
    """The first time it waits for its end."""
    with _started.get_lock():
        _started.value += 1
        times = int(_started.value)
    if times == 1:
        print(f"a task waits in {socket.gethostname()}.", flush=True)
        signal.pause()
    return times


def read(counted: list[int]) -> Iterator[int]:
    """Yield numbers without end; the list records how many were read."""
    while True:
        counted.append(len(counted))
        yield counted[-1]


async def gathered(executor: fiber.Executor) -> list[int]:
    loop = asyncio.get_running_loop()
    return await asyncio.gather(
        *(loop.run_in_executor(executor, square, number) for number in range(10))
    )


def show(executor: fiber.Executor) -> None:
    """Use each part of its interface."""
    futures = [executor.submit(square, number) for number in range(50)]
    print("submit:", sum(future.result() for future in as_completed(futures)))
    print("map:", *executor.map(square, range(10), chunksize=3))
    counted: list[int] = []
    results = executor.map(square, read(counted), buffersize=5)
    taken = [next(results) for _ in range(20)]
    assert len(counted) <= 25
    print("buffersize:", *taken)
    naps = [executor.submit(nap, number) for number in range(40)]
    assert naps[-1].cancel()
    assert not naps[0].cancelled()
    print("cancel:", naps[0].result(), naps[-1].cancelled(), naps[-1].running())
    for future in naps:
        future.cancel()
    print("asyncio:", *asyncio.run(gathered(executor)))
    small, large = executor.options(memory=160), executor.options(memory=192)
    hosts = [set(each.map(host, range(6))) for each in (small, large)]
    say("options", hosts=[sorted(each) for each in hosts])
    hasty = executor.options(timeout=0.5)
    error = hasty.submit(time.sleep, 60).exception()
    print("timeout:", isinstance(error, fiber.TimeoutError))


def lose(executor: fiber.Executor, retries: int) -> None:
    """A task whose pod goes, beside others that never notice."""
    others = [executor.submit(nap, number) for number in range(20)]
    unlucky = executor.options(retries=retries).submit(wait_once)
    try:
        say("done", times=unlucky.result())
    except BrokenExecutor as error:
        say("lost", kind=type(error).__name__, text=str(error))
    assert [future.result() for future in others] == [*range(20)]
    say("goes on", result=executor.submit(square, 7).result())


def main() -> None:
    """Run with the arguments' settings."""
    options = _parse()
    started = fiber.Value("i", 0)
    with fiber.Executor(2, initializer=begin, initargs=(started,)) as executor:
        if options.lose:
            lose(executor, options.retries)
        else:
            show(executor)


def say(event: str, **facts: object) -> None:
    """A line for the test."""
    print(json.dumps({"event": event, "at": time.monotonic(), **facts}) + "\n", end="", flush=True)


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("--lose", action="store_true")
    parser.add_argument("--retries", type=int, default=3)
    return parser.parse_args()


if __name__ == "__main__":
    main()
