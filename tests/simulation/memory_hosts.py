"""Hosts that share a block of memory, over links that keep their order and take their time.

What the hubs do is real: replicas, twins and patches.  Processes pass tokens to each other by
messages; who has the token of a slot may write to it, and who gets it must find what was written.
There are also bytes to which everybody writes at any time.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fiber._hub import heap
from fiber._hub.heap import Block
from fiber._hub.hosted import HostedMemory
from fiber._hub.protocol import NO_SECRET, Extent, ObjectKind, Origin
from fiber._hub.registry import Registry
from fiber._hub.replicas import MemoryLink, Replicas
from fiber._wire import messages
from fiber._wire.messages import MemoryMessage

MASTER = "master"
RACY = 24
"""Bytes at the end of the block that all processes write."""


@dataclass
class Token:
    """The right to write to a slot, and the value that was written."""

    start: int
    expected: bytes


@dataclass
class Passing:
    """A message: a token on its way to a process."""

    to: Process
    token: Token | None


class Host:
    """A host: its hub's replicas, and one queue of frames for each link."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.registry = Registry(lambda shared: HostedMemory(), _at_once)
        self.replicas = Replicas(name, self.registry)
        self.links: dict[str, MemoryLink] = {}
        self.wires: dict[str, deque[MemoryMessage | Passing]] = {}

    def connect(self, other: Host, *, dialer: bool) -> None:
        """Near side of a link."""
        wire = self.wires[other.name] = deque()
        towards = None if dialer else other.name
        self.links[other.name] = self.replicas.link(towards, wire.append, dialer=dialer)

    def send(self, message: Passing) -> None:
        """Send changes first, as agents and master do."""
        if message.to.host is self:
            message.to.receive(message.token)
            return
        far = message.to.host.name
        hop = far if far in self.links else MASTER
        self.links[hop].flush()
        self.wires[hop].append(message)

    def receive(self, sender: str, frame: MemoryMessage | Passing) -> None:
        """The next frame of a link."""
        if isinstance(frame, Passing):
            self.send(frame)
            return
        again = messages.decode(bytearray(frame.encode()))
        assert isinstance(again, MemoryMessage)
        self.links[sender].on_frame(again)


@dataclass(eq=False)
class Process:
    """A process of a host; a ``Joiner``."""

    host: Host
    memory: memoryview | None = None
    tokens: list[Token] = field(default_factory=list)
    waiting: list[Token | None] = field(default_factory=list)

    def joined(self, block: Block) -> None:
        self.memory = block.view
        waiting, self.waiting = self.waiting, []
        for token in waiting:
            self.receive(token)

    def refused(self, reason: str) -> None:
        raise AssertionError(reason)

    def receive(self, token: Token | None) -> None:
        """Check that the receiver of a token finds the last write under it in its memory."""
        if self.memory is None:
            self.waiting.append(token)
        elif token is not None:
            found = bytes(self.memory[token.start : token.start + len(token.expected)])
            assert found == token.expected, f"{self.host.name}: {found!r}, not {token.expected!r}"
            self.tokens.append(token)


class World:
    """World of one run."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = random.Random(seed)
        self.master = Host(MASTER)
        agents = [Host(f"agent-{number}") for number in range(rng.randint(1, 3))]
        for agent in agents:
            agent.connect(self.master, dialer=True)
            self.master.connect(agent, dialer=False)
        self.hosts = [self.master, *agents]
        self.processes = [
            Process(host) for host in self.hosts for _ in range(rng.choice((1, 1, 2)))
        ]
        self.written: set[int] = {0}
        self._make_block()

    def _make_block(self) -> None:
        sizes = [self.rng.choice((1, 3, 8, 50, 5000)) for _ in range(self.rng.randint(1, 4))]
        self.size = sum(sizes) + RACY
        maker = self.rng.choice(self.processes)
        block = heap.allocate(self.size)
        block.give()
        extent = Extent(block.offset, block.size)
        grant, identity = maker.host.registry.register(
            ObjectKind.MEMORY, block.segment.fileno(), extent, reusable=True
        )
        self.origin = Origin(maker.host.name, identity, block.size, NO_SECRET, grant)
        maker.memory = block.view
        start = 0
        for size in sizes:
            maker.tokens.append(Token(start, bytes(size)))
            start += size

    def run(self, steps: int) -> None:
        """Anything that can happen, in any order; then let everything arrive."""
        acts: list[Callable[[], None]] = [self._write, self._race, self._pass, self._join]
        for _ in range(steps):
            self.rng.choice([*acts, self._deliver, self._deliver, self._deliver])()
        for process in self.processes:
            self._join_for(process)
        self._settle()
        self._check()

    def _write(self) -> None:
        """Part of a slot, so that a write is seen in the middle."""
        process = self.rng.choice(self.processes)
        if process.memory is None or not process.tokens:
            return
        token = self.rng.choice(process.tokens)
        at = self.rng.randrange(len(token.expected))
        data = self.rng.randbytes(self.rng.randint(1, len(token.expected) - at))
        data = data if self.rng.random() < 0.8 else bytes(len(data))
        process.memory[token.start + at : token.start + at + len(data)] = data
        token.expected = token.expected[:at] + data + token.expected[at + len(data) :]

    def _race(self) -> None:
        process = self.rng.choice(self.processes)
        if process.memory is not None:
            value = self.rng.randrange(1, 256)
            self.written.add(value)
            process.memory[self.size - self.rng.randint(1, RACY)] = value
            assert set(process.memory[-RACY:]) <= self.written, "a byte that no process wrote"

    def _pass(self) -> None:
        sender, to = self.rng.choice(self.processes), self.rng.choice(self.processes)
        token = None
        if sender.tokens and self.rng.random() < 0.7:
            token = sender.tokens.pop(self.rng.randrange(len(sender.tokens)))
        sender.host.send(Passing(to, token))

    def _join(self) -> None:
        self._join_for(self.rng.choice(self.processes))

    def _join_for(self, process: Process) -> None:
        if process.memory is None:
            process.host.replicas.join(self.origin, process, process)
        elif self.rng.random() < 0.1 and process.host.name != self.origin.home:
            # It has ended, and another one begins.
            for token in process.tokens:
                process.host.send(Passing(self.rng.choice(self.processes), token))
            process.tokens.clear()
            process.memory = None
            process.host.replicas.leave(self.origin.block, process)

    def _deliver(self) -> None:
        wires = [(host, to, wire) for host in self.hosts for to, wire in host.wires.items() if wire]
        if wires:
            host, to, wire = self.rng.choice(wires)
            receiver = next(other for other in self.hosts if other.name == to)
            receiver.receive(host.name, wire.popleft())

    def _settle(self) -> None:
        """Deliver until no message is left."""
        for process in self.processes:
            if process.memory is None:
                process.host.replicas.join(self.origin, process, process)
        for _ in range(len(self.hosts) + 1):
            for host in self.hosts:
                for link in host.links.values():
                    link.flush()
            while any(wire for host in self.hosts for wire in host.wires.values()):
                self._deliver()

    def _check(self) -> None:
        memories = {bytes(process.memory or b"") for process in self.processes}
        assert len(memories) == 1, "the copies are not the same in the end"
        tokens = [token for process in self.processes for token in process.tokens]
        (memory,) = memories
        for token in tokens:
            assert memory[token.start : token.start + len(token.expected)] == token.expected


def _at_once(callback: Callable[..., Any], *args: Any) -> None:
    callback(*args)
