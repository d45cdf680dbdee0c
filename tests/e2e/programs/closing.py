"""Program whose tasks report which addresses they reach, while the test closes the network.

The arguments are targets, as ``HOST:PORT``.  It says ``open`` with those that a task reaches,
``closed`` once a task reaches none of them, and ``done`` once a worker works that came after that.
"""

from __future__ import annotations

import json
import socket
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import fiber

CONNECT = 2.0
"""Seconds for a connection."""


def main() -> None:
    """Look where a task gets to, before and after."""
    targets = sys.argv[1:]
    with fiber.Pool(1) as pool:
        say("open", reached=pool.apply(reached, (targets,)))
        while pool.apply(reached, (targets,)):
            pass
        say("closed")
        first = pool.apply(host, (0,))
    hosts = {first}
    with fiber.Pool(2) as pool:
        while len(hosts) < 2:
            hosts |= set(pool.map(host, range(8), chunksize=1))
    say("done")


def reached(targets: list[str]) -> list[str]:
    """Return the targets that take a connection from here."""
    with ThreadPoolExecutor(len(targets)) as threads:
        taken = threads.map(_takes, targets)
        return [target for target, takes in zip(targets, taken, strict=True) if takes]


def _takes(target: str) -> bool:
    host, _, port = target.rpartition(":")
    try:
        socket.create_connection((host, int(port)), CONNECT).close()
    except OSError:
        return False
    return True


def host(_: int) -> str:
    """Return the pod that this runs in."""
    time.sleep(0.05)
    return socket.gethostname()


def say(event: str, **facts: object) -> None:
    """Print a line for the test."""
    print(json.dumps({"event": event, **facts}) + "\n", end="", flush=True)


if __name__ == "__main__":
    main()
