"""Steps counters in separate processes, as a vector of environments is stepped.

Says in JSON, a line each: ``stepping`` after some steps, with the hosts of the processes, and at
the end ``done`` with the sum of the counters, or ``lost`` with the error that a lost one gives.
"""

from __future__ import annotations

import argparse
import json
import socket
import time
from typing import Any

import fiber


def count(connection: Any, mine: Any) -> None:
    """Add the received numbers in the child, until the other end goes."""
    mine.close()  # or this copy would keep the pipe open
    connection.send(socket.gethostname())
    total = 0
    try:
        while True:
            total += connection.recv()
            connection.send(total)
    except EOFError:
        pass


def main() -> None:
    """Run with the arguments' settings; exit with 0 also if a process is lost, as tests expect."""
    options = _parse()
    pipes, processes = [], []
    for _ in range(options.envs):
        here, there = fiber.Pipe()
        process = fiber.Process(target=count, args=(there, here), daemon=True)
        process.start()
        there.close()
        pipes.append(here)
        processes.append(process)
    hosts = [pipe.recv() for pipe in pipes]
    try:
        for step in range(options.steps):
            for pipe in pipes:
                send(pipe, step)
            totals = [pipe.recv() for pipe in pipes]
            if step == 10:
                say("stepping", hosts=hosts)
            time.sleep(options.seconds)
        say("done", total=sum(totals))
    except EOFError as error:
        say("lost", kind=type(error).__name__, text=str(error))
    for pipe in pipes:
        pipe.close()
    for process in processes:
        process.join()
    say("left", exitcodes=[process.exitcode for process in processes])


def send(pipe: Any, number: int) -> None:
    """Send a number; raise EOFError with the reason if the other process is gone."""
    try:
        pipe.send(number)
    except BrokenPipeError:
        while True:  # messages that were sent before the end arrive first
            pipe.recv()


def say(event: str, **facts: object) -> None:
    """A line for the test."""
    print(json.dumps({"event": event, "at": time.monotonic(), **facts}) + "\n", end="", flush=True)


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    parser.add_argument("--envs", type=int, default=4)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=0.01)
    return parser.parse_args()


if __name__ == "__main__":
    main()
