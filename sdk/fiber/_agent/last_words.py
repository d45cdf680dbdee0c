"""Reasons for the death of a child: its Python stacks, its running task, the memory limit.

The zygote makes a memory file for each child.  faulthandler writes the stacks of all threads there,
also at a crash in native code, and the zygote reads them when the child is gone.

The progress table is shared memory in which each pool worker notes its running task.  A note costs
a store into memory.  When a worker dies, its agent reads here which task to blame.

``MemoryLimit`` detects children that the kernel killed because the control group was out of memory.
They look like any other child that got a SIGKILL, so the kernel's count of such deaths decides.
"""

from __future__ import annotations

import itertools
import mmap
import os
import signal
from collections.abc import Iterable
from contextlib import suppress

TELL = signal.SIGRTMAX - 3
"""Signal to a child: write the stacks, then die."""

GRACE = 0.5
"""Seconds from TELL to SIGKILL."""

LIMIT = 1 << 14
"""Bytes of the stacks that the zygote keeps."""

_HERE = os.path.dirname(__file__)

_OUR_FRAMES = tuple(
    f'  File "{os.path.normpath(os.path.join(_HERE, place))}'
    for place in ("worker.py", "child.py", "../vector/slot.py", "../vector/worker.py")
)
"""Starts of the lines of a stack that show Fiber's frames around the code of the user."""


def make_file() -> int:
    """Return the descriptor of a new memory file, or -1 if the system has no room for one."""
    with suppress(OSError):
        return os.memfd_create("fiber-last-words", os.MFD_CLOEXEC)
    return -1


def write_to(fd: int) -> None:
    """Have faulthandler write to ``fd`` on TELL, and on crashes unless the user enabled it."""
    import faulthandler

    with suppress(OSError, RuntimeError, ValueError):  # stacks are optional
        signal.signal(TELL, signal.SIG_DFL)
        faulthandler.register(TELL, file=fd, all_threads=True, chain=True)
        if not faulthandler.is_enabled():
            faulthandler.enable(file=fd, all_threads=True)


def read(fd: int) -> str:
    """Return what a child has written, and close its file."""
    try:
        data = os.pread(fd, LIMIT + 1, 0)
    except OSError:
        return ""
    finally:
        os.close(fd)
    lines = _without_our_frames(data[:LIMIT].decode(errors="replace").splitlines())
    if len(data) > LIMIT:
        lines[-1:] = ["..."]
    return "\n".join(lines).strip()


def _without_our_frames(lines: Iterable[str]) -> list[str]:
    """Drop Fiber's frames around the user's code, and the list of extension modules."""
    kept = []
    ours = False
    for line in lines:
        ours = line.startswith("  ") and (ours or line.startswith(_OUR_FRAMES))
        if not ours and not line.startswith("Extension modules:"):
            kept.append(line)
    return kept


_SLOT = 3  # words: sequence number of the batch, index of the task in it, whether to stop
_SLOTS = 1 << 16  # sparse: only pages that are used exist


class ProgressTable:
    """Slots of one agent's children, which share the memory by its descriptor."""

    def __init__(self, fd: int | None = None) -> None:
        self.fd = os.memfd_create("fiber-progress", os.MFD_CLOEXEC) if fd is None else fd
        size = _SLOTS * _SLOT * 8
        try:
            if fd is None:
                os.ftruncate(self.fd, size)
            self._memory = mmap.mmap(self.fd, size)
        except BaseException:
            os.close(self.fd)
            raise
        self._words = memoryview(self._memory).cast("Q")
        self._free: list[int] = []
        self._next = itertools.count()

    def claim(self) -> int:
        """Return a cleared slot for a new child."""
        try:
            slot = self._free.pop()  # in one step: several threads may be here
        except IndexError:
            slot = next(self._next)
            if slot >= _SLOTS:
                raise RuntimeError(
                    f"one agent runs at most {_SLOTS} pool workers at a time"
                ) from None
        view = self.slot(slot)
        view[0] = view[1] = view[2] = 0
        return slot

    def stop(self, slot: int) -> None:
        """Have a worker return the tasks that it has not begun, whatever chunk they are of."""
        self.slot(slot)[2] = 1

    def release(self, slot: int) -> None:
        """Free the slot of a child that is gone."""
        self._free.append(slot)

    def slot(self, slot: int) -> memoryview:
        """Return the words of a slot: sequence number (0: none), index, whether to stop."""
        return self._words[slot * _SLOT : (slot + 1) * _SLOT]

    def running(self, slot: int) -> tuple[int, int] | None:
        """Return the sequence number and index that the child noted last, or None."""
        view = self.slot(slot)
        return (view[0], view[1]) if view[0] else None

    def close(self) -> None:
        """Unmap the memory and close its descriptor."""
        self._words.release()
        self._memory.close()
        os.close(self.fd)


def describe(exitcode: int) -> str:
    """Return an exit code in words."""
    if exitcode >= 0:
        return f"exit status {exitcode}"
    try:
        return f"killed by {signal.Signals(-exitcode).name}"
    except ValueError:
        return f"killed by signal {-exitcode}"


_ROOT = "/sys/fs/cgroup"
_MEMBERSHIP = "/proc/self/cgroup"

_UNITS = (("Gi", 1 << 30), ("Mi", 1 << 20), ("Ki", 1 << 10))


class MemoryLimit:
    """Memory limit of the control group that this process is in."""

    def __init__(self, root: str = _ROOT, membership: str = _MEMBERSHIP) -> None:
        self._events, self._maximum = _files(root, membership)
        self._kills = self._count()

    def was_exceeded(self) -> bool:
        """Return whether the kernel has killed a process for memory since the last call."""
        before, self._kills = self._kills, self._count()
        return self._kills > before

    def describe(self) -> str:
        """Return a sentence with the limit as Kubernetes writes it."""
        limit = _read(self._maximum).strip()
        if limit.isdigit():
            return f"its memory limit is {_quantity(int(limit))}"
        return "its container has no memory limit"

    def _count(self) -> int:
        for line in _read(self._events).splitlines():
            name, _, count = line.partition(" ")
            if name == "oom_kill" and count.isdigit():
                return int(count)
        return 0


def _files(root: str, membership: str) -> tuple[str, str]:
    """Return the paths of the file that counts the deaths and the file with the limit."""
    groups = {}
    for line in _read(membership).splitlines():
        _, controllers, group = line.split(":", 2)
        groups[controllers] = group.rstrip("/")
    found = []
    # In a separate cgroup namespace the group is the root of the mount, under any name.
    for group in (groups.get("", ""), ""):
        found.append((f"{root}{group}/memory.events", f"{root}{group}/memory.max"))
    for group in (groups.get("memory", ""), ""):
        old = f"{root}/memory{group}"
        found.append((f"{old}/memory.oom_control", f"{old}/memory.limit_in_bytes"))
    return next((files for files in found if _read(files[0])), found[0])


def _quantity(limit: int) -> str:
    for unit, size in _UNITS:
        if limit % size == 0:
            return f"{limit // size}{unit}"
    return f"{limit} bytes"


def _read(path: str) -> str:
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except OSError:  # no such file, or no such group
        return ""
