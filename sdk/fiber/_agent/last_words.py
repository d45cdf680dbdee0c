"""Reasons for the death of a child: its Python stacks, its running task, the memory limit.

The zygote makes a memory file for each child.  faulthandler writes the stacks of all threads there,
also at a crash in native code, and the zygote reads them when the child is gone.  SHOW asks a child
that lives on for its stacks.

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

SHOW = signal.SIGRTMAX - 4
"""Signal to a child: write the stacks, and go on."""

GRACE = 0.5
"""Seconds from TELL to SIGKILL."""

LIMIT = 1 << 14
"""Bytes of the stacks that the zygote keeps."""

_HERE = os.path.dirname(os.path.abspath(__file__))

_PACKAGE = f'  File "{os.path.dirname(_HERE)}{os.sep}'
"""Start of the lines of a stack that show Fiber's code."""

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
    """Have faulthandler write to ``fd`` on TELL and SHOW, and on crashes.

    Crashes stay the user's if the user enabled faulthandler.
    """
    import faulthandler

    with suppress(OSError, RuntimeError, ValueError):  # stacks are optional
        signal.signal(TELL, signal.SIG_DFL)
        faulthandler.register(TELL, file=fd, all_threads=True, chain=True)
        faulthandler.register(SHOW, file=fd, all_threads=True)
        if not faulthandler.is_enabled():
            faulthandler.enable(file=fd, all_threads=True)


def read(fd: int) -> str:
    """Return what a child has written, and close its file."""
    try:
        return _text_in(fd)
    finally:
        os.close(fd)


class StackRequest:
    """Request for the stacks of a child that lives on; ``fd`` is the child's file.

    faulthandler does not say that it has finished.  So the stacks count as whole once the file has
    not grown between two looks.
    """

    INTERVAL = 0.05
    """Seconds between two looks."""

    def __init__(self, pid: int, fd: int, now: float) -> None:
        self.due = now + self.INTERVAL
        """Time of the next look."""
        self._pid = pid
        self._fd = fd
        self._deadline = now + _PATIENCE
        self._size = 0
        _empty(fd)

    def look(self, now: float) -> str | None:
        """Return the stacks, or why there are none; None: look again when it is ``due``."""
        before, self._size = self._size, os.fstat(self._fd).st_size
        if self._size and self._size == before:
            text = _text_in(self._fd)
            _empty(self._fd)
            return text if _has_user_code(text) else "Only Fiber's code runs: it waits for work."
        if now >= self._deadline:
            return f"No stack came within {_PATIENCE:.0f} s: the process {_activity(self._pid)}."
        self.due = now + self.INTERVAL
        return None


_PATIENCE = 3.0
"""Seconds in which a child writes its stacks."""


def _activity(pid: int) -> str:
    """Return what the kernel says that a process does."""
    state = _read(f"/proc/{pid}/stat").rpartition(")")[2].strip()[:1]
    return {
        "D": "waits for a device or a network file system",
        "T": "is stopped by a signal",
        "t": "is stopped by a debugger",
        "Z": "has ended",
    }.get(state, "still starts, or it has changed the handler of Fiber's signal")


def _has_user_code(stacks: str) -> bool:
    frames = [line for line in stacks.splitlines() if line.startswith("  ")]
    return not all(frame.startswith(_PACKAGE) for frame in frames)


def _empty(fd: int) -> None:
    os.ftruncate(fd, 0)
    os.lseek(fd, 0, os.SEEK_SET)  # the child writes at the same position


def _text_in(fd: int) -> str:
    """Return the stacks in a file, without Fiber's frames."""
    try:
        data = os.pread(fd, LIMIT + 1, 0)
    except OSError:
        return ""
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
