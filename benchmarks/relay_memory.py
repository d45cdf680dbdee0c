"""Memory of a relay and of its master, with 200 agents: `python -m benchmarks.relay_memory`.

The links are real, and so is the relay, a process. The master connects to it as a port-forward
would. The agents are objects of one more process (agent_host.py). What a link costs the master
without a relay is measured in the same way and shown beside it.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import re
import socket
import subprocess
import sys
import threading
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.agent_host import Order

from fiber._transport.credentials import OwnCredentials, make_credentials
from fiber._transport.link import Link
from fiber._transport.listener import MasterListener
from fiber._transport.loop import Loop
from fiber._transport.multiplexer import Multiplexer, SocketCarrier
from fiber._wire.streams import hello

AGENTS = 200
RELAY_BUDGET, MASTER_BUDGET = 150 << 20, 100 << 10
"""Bytes of the relay with 200 agents, and of the master for each agent beyond a direct link."""

_TIMEOUT = 120.0


def main(arguments: list[str]) -> int:
    """Print the figures; return 0 if the budgets are kept."""
    parser = argparse.ArgumentParser("benchmarks.relay_memory", description=__doc__)
    parser.add_argument("--agents", type=int, default=AGENTS)
    agents = parser.parse_args(arguments).agents
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as fresh:
        direct, relayed = fresh.starmap(measure, [(False, agents), (True, agents)], chunksize=1)
    beyond = (relayed["master"] - direct["master"]) / agents
    print(f"{agents} agents")
    print(f"relay: {relayed['idle'] / 2**20:.1f} MiB without agents")
    print(f"relay: {relayed['relay'] / 2**20:.1f} MiB (budget {RELAY_BUDGET >> 20} MiB)")
    print(f"master: {direct['master'] / agents / 1024:.0f} KiB for each agent without a relay")
    print(f"master: {beyond / 1024:.0f} KiB more with one (budget {MASTER_BUDGET >> 10} KiB)")
    return int(relayed["relay"] > RELAY_BUDGET or beyond > MASTER_BUDGET)


def measure(through_relay: bool, agents: int) -> dict[str, int]:
    """Return bytes: what the master grew by, and the relay's memory without and with agents."""
    master = _Master(agents)
    relay = _Relay(master) if through_relay else None
    idle = memory(relay.pid) if relay else 0
    before = memory(os.getpid())
    host = _start_agents(relay.address if relay else master.listener.address, master, agents)
    try:
        if not master.complete.wait(_TIMEOUT):
            raise TimeoutError(f"{len(master.links)} of {agents} agents have joined")
        grown = memory(os.getpid()) - before
        return {"master": grown, "idle": idle, "relay": memory(relay.pid) if relay else 0}
    finally:
        host.kill()
        host.wait()
        if relay:
            relay.close()


def memory(pid: int) -> int:
    """Return the resident memory of a process, in bytes."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    found = re.search(r"^VmRSS:\s+(\d+) kB", status, re.MULTILINE)
    return int(found[1]) * 1024 if found else 0


class _Master:
    def __init__(self, agents: int) -> None:
        self.loop = Loop()
        self.loop.start_thread("master")
        self.credentials: OwnCredentials = make_credentials()
        self.links: list[Link] = []
        self.complete = threading.Event()
        self._wanted = agents
        self.listener = MasterListener(
            self.loop,
            "127.0.0.1:0",
            self.credentials,
            on_agent=self._joined,
            on_refused=lambda why: print(why, file=sys.stderr),
        )

    def _joined(self, link: Link) -> str | None:
        self.links.append(link)
        if len(self.links) == self._wanted:
            self.complete.set()
        return None


class _Relay:
    def __init__(self, master: _Master) -> None:
        ports = dict.fromkeys(("FIBER_RELAY_AGENTS_PORT", "FIBER_RELAY_MASTER_PORT"), "0")
        self._process = subprocess.Popen(
            [sys.executable, "-m", "fiber.agent"],
            env={**os.environ, **ports},
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        agents_port, master_port = re.findall(r"\d+", self._process.stdout.readline())
        self.address = f"127.0.0.1:{agents_port}"
        self.pid = self._process.pid
        sock = socket.create_connection(("127.0.0.1", int(master_port)))
        master.loop.call_soon(_connect, master, sock)
        self._process.stdout.readline()  # it is connected

    def close(self) -> None:
        self._process.kill()
        self._process.wait()


def _connect(master: _Master, sock: socket.socket) -> None:
    def take(origin: str) -> socket.socket:
        near, far = socket.socketpair()
        master.listener.take(far, origin)
        return near

    end = Multiplexer(
        master.loop,
        SocketCarrier(sock),
        on_hello=lambda frame: None,
        on_end=lambda reason: print(reason, file=sys.stderr),
        on_open=take,
    )
    end.send(hello(epoch=1, identity="bench"))


def _start_agents(address: str, master: _Master, agents: int) -> subprocess.Popen[Any]:
    credentials = [
        asdict(master.credentials.agent(f"agent-{number}", str(number))) for number in range(agents)
    ]
    host = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.agent_host"], stdin=subprocess.PIPE, text=True
    )
    assert host.stdin is not None
    host.stdin.write(json.dumps(asdict(Order(address, credentials, _TIMEOUT))) + "\n")
    host.stdin.flush()
    return host


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
