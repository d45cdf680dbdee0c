"""Simulated processes that share a semaphore: the real code, in a simulated memory.

Each read and write is a step, after which any other process may go on.  Stores lie in a buffer of
their processor's until it empties: at an atomic instruction, at a whim, and within a moment.  A
process can be killed at any step, and interrupted after a call as by Ctrl-C.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from fiber._sync import semaphore as module
from fiber._sync.semaphore import SharedSemaphore

SLOTS = range(32, 32 + 8 * 8, 8)
STEPS = 9_000
"""Steps of a schedule; one that takes more hangs."""


class Killed(BaseException):
    """Thrown at every further step of a process that was killed."""


class Process:
    """A thread that moves when the schedule says so."""

    def __init__(self, world: World, number: int, action: Callable[[Process], None]) -> None:
        self.number = number
        self.alive = True
        self.done = False
        self.stores: list[tuple[int, bytes]] = []
        self.interrupted = False
        self.sleeps = 0
        """Number of turns for which the kernel lets others run."""
        self.error: BaseException | None = None
        self._world = world
        self._turn = threading.Lock()
        self._turn.acquire()
        self._back = threading.Lock()
        self._back.acquire()
        self._thread = threading.Thread(target=self._run, args=(action,), daemon=True)
        self._thread.start()

    def _run(self, action: Callable[[Process], None]) -> None:
        self._turn.acquire()
        try:
            action(self)
        except Killed:
            pass
        except BaseException as error:
            self.error = error
        self.done = True
        self._back.release()

    def go(self) -> None:
        """Let it do one step."""
        self._world.current = self
        self._turn.release()
        self._back.acquire()
        if self.done:
            self._thread.join()

    def step(self) -> None:
        """Pause this process's thread: others may run before the next step."""
        self._back.release()
        self._turn.acquire()
        if not self.alive:
            raise Killed


class World:
    """Memory, clock, processes, and the one semaphore."""

    def __init__(self, seed: int, tokens: int, maximum: int) -> None:
        self.random = random.Random(seed)
        self.tokens = tokens
        self.value = tokens
        self.holders: list[Process] = []
        self.processes: list[Process] = []
        self.current: Process
        self._memory = bytearray(8 * SLOTS.stop)
        self._now = 0.0
        self._owner: Process | None = None
        self._depth = 0
        self._put(8 * module._TOTAL, tokens.to_bytes(8, "little"))
        self._put(8 * module._MAXIMUM, maximum.to_bytes(8, "little"))

    # Memory

    def load(self, start: int, size: int) -> bytes:
        """Read the memory with the stores of this processor."""
        self.current.step()
        found = bytearray(self._memory[start : start + size])
        for at, data in self.current.stores:
            for offset, byte in enumerate(data, at - start):
                if 0 <= offset < size:
                    found[offset] = byte
        return bytes(found)

    def store(self, start: int, data: bytes) -> None:
        """Write, to be seen by others later."""
        self.current.step()
        self.current.stores.append((start, data))

    def empty(self, process: Process, count: int | None = None) -> None:
        """Make the stores of that processor visible to all."""
        while process.stores and count != 0:
            self._put(*process.stores.pop(0))
            count = None if count is None else count - 1

    def _put(self, start: int, data: bytes) -> None:
        self._memory[start : start + len(data)] = data

    # Stand-ins for functions that the code uses

    def sleep(self, seconds: float) -> None:
        """Make all earlier stores visible to all."""
        self.current.step()
        for process in self.processes:
            self.empty(process)
        self._now += seconds

    def monotonic(self) -> float:
        """Clock that advances at each read."""
        self._now += 0.03
        return self._now

    def me(self) -> int:
        """The word of the process that runs."""
        return self.current.number + 1

    def is_alive(self, who: int) -> bool:
        """Return whether the process lives, as the kernel knows it."""
        self.current.step()
        return self.processes[who - 1].alive

    def run(self, action: Callable[[], Any]) -> Any:
        """The robust mutex."""
        process = self.current
        process.step()
        while (owner := self._owner) is not None and owner is not process and owner.alive:
            process.step()
        if self._owner is not process:
            self._owner, self._depth = process, 0
        self.empty(process)
        self._depth += 1
        try:
            return action()
        finally:
            if process.alive:
                self._depth -= 1
                if not self._depth:
                    self._owner = None
                    self.empty(process)

    # The schedule

    def start(self, action: Callable[[Process], None]) -> Process:
        """Add a process."""
        process = Process(self, len(self.processes), action)
        self.processes.append(process)
        return process

    def kill(self, process: Process) -> None:
        """At the step where it is."""
        process.alive = False
        self.empty(process)
        if process in self.holders:
            self.holders.remove(process)

    def finish(self) -> None:
        """Let all run to their end."""
        for _ in range(STEPS):
            running = [process for process in self.processes if not process.done]
            if not running:
                return
            self.move(running)
        raise AssertionError("somebody waits for ever")

    def move(self, processes: Sequence[Process]) -> None:
        """Take one step of a process, or make one store visible."""
        process = self.random.choice(processes)
        if self.random.random() < 0.02:
            process.sleeps = 40
        if process.sleeps:
            process.sleeps -= 1
        elif not process.done:
            process.go()
        if self.random.random() < 0.05:
            self.empty(self.random.choice(self.processes), 1)

    def end(self) -> None:
        """Leave no thread."""
        for process in self.processes:
            process.alive = False
            while not process.done:
                process.go()


class Semaphore:
    """A view of the POSIX semaphore: each of its operations is atomic."""

    def __init__(self, world: World, maximum: int) -> None:
        self._world = world
        self._maximum = maximum
        self.held = 0

    def acquire(self, block: bool, timeout: float = 0.0) -> bool:
        """Take one, or wait until the time is over."""
        world = self._world
        process = world.current
        process.step()
        while not world.value:
            if not block or world.random.random() < 0.3:
                return False
            process.step()
        world.empty(process)
        world.value -= 1
        self.held += 1
        self._interrupt(process)
        return True

    def release(self) -> None:
        """Give one."""
        process = self._world.current
        process.step()
        self._world.empty(process)
        if self._world.value >= self._maximum:
            raise ValueError("semaphore or lock released too many times")
        self._world.value += 1
        self.held -= 1
        self._interrupt(process)

    def _interrupt(self, process: Process) -> None:
        if process.interrupted:
            process.interrupted = False
            raise KeyboardInterrupt

    def _count(self) -> int:
        return self.held

    def _is_mine(self) -> bool:
        return self.held > 0

    def _get_value(self) -> int:
        self._world.current.step()
        return self._world.value

    def _is_zero(self) -> bool:
        return not self._get_value()

    def _after_fork(self) -> None:
        self.held = 0


class Words:
    """Memory as words."""

    def __init__(self, world: World) -> None:
        self._world = world

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, slice):
            words = range(SLOTS.stop)[key]
            return SimpleNamespace(tolist=lambda: [self[word] for word in words])
        return int.from_bytes(self._world.load(8 * key, 8), "little", signed=True)

    def __setitem__(self, key: int, value: int) -> None:
        self._world.store(8 * key, int(value).to_bytes(8, "little", signed=True))


class Bytes:
    """Memory as bytes: the view of a block."""

    def __init__(self, world: World) -> None:
        self._world = world

    def cast(self, _: str) -> Words:
        """Return a view of the memory as words."""
        return Words(self._world)

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, slice):
            return self._world.load(key.start, key.stop - key.start)
        return self._world.load(key, 1)[0]

    def __setitem__(self, key: Any, value: Any) -> None:
        if isinstance(key, slice):
            self._world.store(key.start, bytes(value))
        else:
            self._world.store(key, bytes([value]))


def simulated(world: World, patch: pytest.MonkeyPatch) -> Callable[[], SharedSemaphore]:
    """Makes a process's view of the semaphore."""
    patch.setattr(module, "time", world)
    processes = SimpleNamespace(own_identity=world.me, is_alive=world.is_alive, pid_of=int)
    patch.setattr(module, "liveness", processes)
    patch.setattr(module, "RobustMutex", lambda _: world)
    patch.setattr(module, "semaphore_at", lambda _, __, maximum: Semaphore(world, maximum))
    patch.setattr(module, "warn_of", lambda _, **__: None)
    patch.setattr(module, "_SLOTS", SLOTS)
    block: Any = SimpleNamespace(view=Bytes(world), address=0)
    return lambda: SharedSemaphore(block, module.COUNTING)
