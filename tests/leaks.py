"""Leaks that fail a test: processes, threads, open files, temporary files.

The process-wide runtime of Fiber (thread, zygotes, agents) lives as long as the session. Its own
processes are known by their command line, and open files are compared only between two moments at
which it has the same ones; at the end of the session it is shut down, and then nothing is excused.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import census
from fiber._hub.heap import SIZES
from fiber._wire.memory_files import RETAINED_BLOCKS
from patience import PATIENCE

SETTLE = PATIENCE  # seconds for processes, threads and files that are ending to end
_RUNTIME_THREADS = ("fiber-io",)
_ZYGOTE = "fiber._agent.zygote import main"
_AGENT = "'fiber.agent'"
# nng's poller, made at the first use in a process, stays until the process ends.
_NNG_THREAD = "nng:"
_NNG_OPENS = Counter(["anon_inode:[eventpoll]", "anon_inode:[eventfd]"])
# Memory for large messages is kept for the next ones; each block holds two descriptors.
_MESSAGE_MEMORY = "/memfd:fiber-message (deleted)"
_MESSAGE_MEMORY_LIMIT = 2 * RETAINED_BLOCKS
# So is memory for small shared objects: one segment for each size, and one full segment with free
# places; each may hold two descriptors.
HEAP = "/memfd:fiber-heap (deleted)"
HEAP_LIMIT = 4 * len(SIZES)


class Lasting(NamedTuple):
    """Objects that outlive a test by design and hold files open."""

    runtime: object | None
    address: object | None
    processes: frozenset[int]
    nng: bool


class Snapshot(NamedTuple):
    """State at one moment."""

    lasting: Lasting
    processes: frozenset[int]
    threads: frozenset[threading.Thread]
    descriptors: frozenset[tuple[int, str]]
    files: frozenset[str]


class Watch:
    """Looks at this process, what it started, and its folder for temporary files."""

    def __init__(self, marker: str, folder: Path) -> None:
        self._strangers: frozenset[census.Identity] = frozenset()
        self._marker = marker
        self._folder = folder
        present = census.identities()
        mine = {found.pid for found in self._started()}
        self._strangers = frozenset(each for each in present if each[0] not in mine)

    def look(self) -> Snapshot:
        started = self._started()
        return Snapshot(
            lasting=Lasting(_runtime(), _address(), _excused(started), _nng_runs()),
            processes=frozenset(found.pid for found in started),
            threads=frozenset(threading.enumerate()),
            descriptors=frozenset(descriptors()),
            files=frozenset(name for name in os.listdir(self._folder) if not self._probe(name)),
        )

    def _probe(self, name: str) -> bool:
        """Tell whether the file is Python's own, of a process that was killed as it made it.

        ``tempfile`` writes ``blat`` to a file with a random name of eight characters, and removes
        it, to find out whether the folder can be written to.
        """
        try:
            return len(name) == 8 and (self._folder / name).read_bytes() in (b"", b"blat")
        except OSError:  # a folder, or a file that is gone
            return False

    def left_since(self, before: Snapshot, *, excuse_runtime: bool = True) -> list[str]:
        """Return the leftovers in words, once all that is ending has ended."""
        deadline = time.monotonic() + SETTLE
        pause = 0.001
        while left := self._compare(before, excuse_runtime):
            if time.monotonic() > deadline:
                break
            gc.collect()
            multiprocessing.active_children()  # joins the ended threads, which hold descriptors
            time.sleep(pause)
            pause = min(pause * 2, 0.1)
        return left

    def kill_processes_since(self, before: Snapshot) -> None:
        """End the leftovers of a failed test, so that they do not fail the next one."""
        started = self._started()
        spared = before.processes | before.lasting.processes | _excused(started)
        census.kill(found for found in started if found.pid not in spared)

    def _compare(self, before: Snapshot, excuse_runtime: bool) -> list[str]:
        now = self.look()
        new = now.processes - before.processes
        if excuse_runtime:
            new -= now.lasting.processes
        left = [f"process {found}" for pid in sorted(new) if (found := census.read(pid))]
        left += [
            f"thread {thread.name}"
            for thread in now.threads - before.threads
            if thread.is_alive() and not (excuse_runtime and thread.name in _RUNTIME_THREADS)
        ]
        if now.lasting == before.lasting or not excuse_runtime:
            left += _opened(before, now)
            left += [f"temporary file {name}" for name in sorted(now.files - before.files)]
        return left

    def _started(self) -> list[census.Found]:
        return census.started_by(os.getpid(), self._marker, self._strangers)


def shut_down_runtime() -> None:
    """End Fiber's runtime, where the tests have made one."""
    state = sys.modules.get("fiber._runtime.state")
    if state is not None:
        state.shutdown()


def _excused(started: list[census.Found]) -> frozenset[int]:
    """The agents of this process, its zygotes, and theirs."""
    agents = {p.pid for p in started if p.parent == os.getpid() and _AGENT in p.command}
    owners = agents | {os.getpid()}
    zygotes = {p.pid for p in started if p.parent in owners and _ZYGOTE in p.command}
    return frozenset(agents | zygotes)


def _runtime() -> object | None:
    return getattr(sys.modules.get("fiber._runtime.state"), "_runtime", None)


def _address() -> object | None:
    """Return where the hub of the runtime listens, once it does."""
    hub = getattr(sys.modules.get("fiber._hub.client"), "_local_hub", None)
    return getattr(hub, "known_address", None)


def _nng_runs() -> bool:
    return any(_name(task).startswith(_NNG_THREAD) for task in Path("/proc/self/task").iterdir())


def _name(task: Path) -> str:
    try:
        return (task / "comm").read_text()
    except OSError:
        return ""  # it has just ended


def _opened(before: Snapshot, now: Snapshot) -> list[str]:
    excused = _NNG_OPENS.copy() if now.lasting.nng and not before.lasting.nng else Counter[str]()
    kept = sum(target == _MESSAGE_MEMORY for _, target in now.descriptors)
    if kept <= _MESSAGE_MEMORY_LIMIT:
        excused[_MESSAGE_MEMORY] = kept
    kept = sum(target == HEAP for _, target in now.descriptors)
    if kept <= HEAP_LIMIT:
        excused[HEAP] = kept
    opened = []
    for number, target in sorted(now.descriptors - before.descriptors):
        if excused[target]:
            excused[target] -= 1
        else:
            opened.append(f"open file {number}: {target}")
    return opened


def descriptors(pid: int | str = "self") -> list[tuple[int, str]]:
    """Return the descriptors of a process, each with what it leads to."""
    found = []
    for name in os.listdir(f"/proc/{pid}/fd"):
        try:
            found.append((int(name), os.readlink(f"/proc/{pid}/fd/{name}")))
        except FileNotFoundError:
            pass  # the one that listed the folder, or one that was closed meanwhile
    return found
