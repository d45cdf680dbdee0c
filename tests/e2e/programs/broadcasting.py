"""Program that broadcasts a large array to a worker in each of six pods."""

from __future__ import annotations

import hashlib
import json
import os
import socket
from typing import Any

import fiber
from fiber._runtime import state

PODS = 6
SIZE = 4 << 20


def digest(data: bytes) -> tuple[str, str]:
    """Return the hash of the data, and the host on which it was computed."""
    return hashlib.sha256(data).hexdigest(), socket.gethostname()


def bytes_sent() -> int:
    """Return the bytes that the program has sent to its agents."""
    backend: Any = state.runtime().backend
    agents = [agent for pods in backend._pods.values() for agent in pods.agents.agents.values()]
    return sum(agent._link.statistics().bytes_sent for agent in agents)


def main() -> None:
    """Say how many copies the program has sent, and what the workers have got."""
    data = os.urandom(SIZE)
    with fiber.Pool(PODS) as pool:
        pool.broadcast(os.getpid)  # all workers are there
        before = bytes_sent()
        hashes, hosts = zip(*pool.broadcast(digest, data), strict=True)
        copies = (bytes_sent() - before) / SIZE
    right = set(hashes) == {hashlib.sha256(data).hexdigest()}
    said = {"event": "done", "copies": copies, "right": right, "hosts": hosts}
    print(json.dumps(said) + "\n", end="", flush=True)


if __name__ == "__main__":
    main()
