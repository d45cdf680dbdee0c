"""Reasons for the death of a child: its Python stacks, its running task, the memory limit.

The zygote makes a memory file for each child.  faulthandler writes the stacks of all threads there,
also at a crash in native code, and the zygote reads them when the child is gone.

SHOW asks a child that lives on for its stacks.  Its handler is Python code, so that Python's lock
is held: faulthandler crashes if it walks the frames of a thread that runs.  A child that does not
answer hangs in native code.  It gets SHOW_NATIVE, whose handler shows only the thread that it
interrupts.

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
"""Signal to a child: write the stacks of all threads between two steps of Python, and go on."""

SHOW_NATIVE = signal.SIGRTMAX - 5
"""Signal to a child: write the stack of the main thread at once, and go on."""

GRACE = 0.5
"""Seconds from TELL to SIGKILL."""

LIMIT = 1 << 14
"""Characters of the stacks that the zygote keeps."""

_HERE = os.path.dirname(os.path.abspath(__file__))

_PACKAGE = f'  File "{os.path.dirname(_HERE)}{os.sep}'
"""Start of the lines of a stack that show Fiber's code."""

_OUR_FRAMES = tuple(
    f'  File "{os.path.normpath(os.path.join(_HERE, place))}'
    for place in ("worker.py", "child.py", "../vector/slot.py", "../vector/worker.py")
)
"""Starts of the lines of a stack that show Fiber's frames around the code of the user."""

_HANDLER = f'  File "{os.path.join(_HERE, os.path.basename(__file__))}"'
"""Start of the line of the handler of SHOW."""


def make_file() -> int:
    """Return the descriptor of a new memory file, or -1 if the system has no room for one."""
    with suppress(OSError):
        return os.memfd_create("fiber-last-words", os.MFD_CLOEXEC)
    return -1


def write_to(fd: int) -> None:
    """Have faulthandler write to ``fd`` on TELL, SHOW and SHOW_NATIVE, and on crashes.

    Crashes stay the user's if the user enabled faulthandler.
    """
    import faulthandler

    with suppress(OSError, RuntimeError, ValueError):  # stacks are optional
        signal.signal(TELL, signal.SIG_DFL)
        faulthandler.register(TELL, file=fd, all_threads=True, chain=True)
        signal.signal(SHOW, lambda *_: faulthandler.dump_traceback(fd, all_threads=True))
        faulthandler.register(SHOW_NATIVE, file=fd, all_threads=False)
        if not faulthandler.is_enabled():
            faulthandler.enable(file=fd, all_threads=True)


def read(fd: int, *, told: bool) -> str:
    """Return what a child has written about its death, and close its file.

    ``told``: the child got TELL.  Else only a crash counts: other stacks are late answers to SHOW.
    """
    try:
        data = _data_in(fd)
    finally:
        os.close(fd)
    begin = 0 if told else data.rfind(_CRASH)
    return _text_of(data[begin:]) if begin >= 0 else ""


_ONE_THREAD = "Stack"
"""Start of what faulthandler writes on SHOW_NATIVE."""

_CRASH = b"Fatal Python error: "
"""Start of what faulthandler writes at a crash."""


class StackRequest:
    """Request for the stacks of a child that lives on; ``fd`` is the child's file.

    faulthandler does not say that it has finished.  So the stacks count as whole once the file has
    not grown between two looks.
    """

    INTERVAL = 0.05
    """Seconds between two looks."""

    def __init__(self, pid: int, fd: int, now: float) -> None:
        """Ask the child."""
        self.due = now + self.INTERVAL
        """Time of the next look."""
        self._pid = pid
        self._fd = fd
        self._native_at = now + _PYTHON_PATIENCE
        self._deadline = now + _PATIENCE
        self._size = 0
        empty(fd)
        self._refusal = self._ask(SHOW)

    def look(self, now: float) -> str | None:
        """Return the stacks, or why there are none; None: look again when it is ``due``."""
        before, self._size = self._size, os.fstat(self._fd).st_size
        if self._size and self._size == before:
            return self._shown()
        if self._refusal:
            return f"No stack: the process {self._refusal}."
        if now >= self._deadline:
            return f"No stack came within {_PATIENCE:.0f} s: the process {_activity(self._pid)}."
        if now >= self._native_at and not self._size:
            self._native_at = self._deadline
            self._refusal = self._ask(SHOW_NATIVE)
        self.due = now + self.INTERVAL
        return None

    def _shown(self) -> str:
        text = _text_of(_data_in(self._fd))
        empty(self._fd)
        return text if _has_user_code(text) else "Only Fiber's code runs: it waits for work."

    def _ask(self, signum: int) -> str:
        """Send a signal to the child, or return why that would do harm."""
        refusal = _refusal(self._pid, signum, self._fd)
        if not refusal:
            with suppress(PermissionError):  # the child runs a set-user-ID program
                os.kill(self._pid, signum)
        return refusal


_PATIENCE = 3.0
"""Seconds in which a child writes its stacks."""

_PYTHON_PATIENCE = 0.5
"""Seconds in which a child that runs Python code writes its stacks."""


def _refusal(pid: int, signum: int, fd: int) -> str:
    """Return why a signal would end a child, or write into a file of the user; empty if not."""
    try:
        caught, _, ignored = signal_masks(pid)
    except (OSError, KeyError, ValueError):
        return "cannot be inspected"
    if _state(pid) != "Z" and not (caught | ignored) >> (signum - 1) & 1:
        return "runs another program, or it has reset the handler of Fiber's signal"
    if not _has_open(pid, fd):
        return "has closed the file for its stacks"
    return ""


def _has_open(pid: int, fd: int) -> bool:
    """Return whether the child's descriptor ``fd`` still is the file that it is here."""
    try:
        return os.path.samestat(os.stat(f"/proc/{pid}/fd/{fd}"), os.fstat(fd))
    except FileNotFoundError:
        return False
    except OSError:  # the child has changed its user: only the system's administrator may look
        return True


def signal_masks(pid: int) -> tuple[int, int, int]:
    """Return the signals that a process catches, blocks and ignores; OSError, KeyError, ValueError.

    The lowest bit is signal 1.
    """
    with open(f"/proc/{pid}/status") as status:
        lines = dict(line.split(":", 1) for line in status)
    return int(lines["SigCgt"], 16), int(lines["SigBlk"], 16), int(lines["SigIgn"], 16)


def _state(pid: int) -> str:
    return _read(f"/proc/{pid}/stat").rpartition(")")[2].strip()[:1]


def _activity(pid: int) -> str:
    """Return what the kernel says that a process does."""
    return {
        "D": "waits for a device or a network file system",
        "T": "is stopped by a signal",
        "t": "is stopped by a debugger",
        "Z": "has ended",
    }.get(_state(pid), "still starts, or it has changed the handler of Fiber's signal")


def _has_user_code(stacks: str) -> bool:
    frames = [line for line in stacks.splitlines() if line.startswith("  ")]
    return not all(frame.startswith(_PACKAGE) for frame in frames)


def empty(fd: int) -> None:
    """Drop what a child has written.  The child and this process write at the same position."""
    os.ftruncate(fd, 0)
    os.lseek(fd, 0, os.SEEK_SET)


def _data_in(fd: int) -> bytes:
    try:
        return os.pread(fd, os.fstat(fd).st_size, 0)
    except OSError:
        return b""


def _text_of(data: bytes) -> str:
    """Return stacks without Fiber's frames, that of the current thread first."""
    lines = _without_our_frames(data.decode(errors="replace").splitlines())
    text = _current_thread_first("\n".join(lines).strip())
    if text.startswith(_ONE_THREAD):
        text = f"Main thread, in native code{text.removeprefix(_ONE_THREAD)}"
    if len(text) <= LIMIT:
        return text
    return text[:LIMIT].rpartition("\n")[0] + "\n..."


def _current_thread_first(text: str) -> str:
    """Move the stack of the thread that runs the task to the front.

    faulthandler writes it last, where it would be cut off.
    """
    head, found, rest = text.partition("Current thread ")
    current, _, others = (found + rest).partition("\n\n")
    title = ""
    if head.startswith(_CRASH.decode()):
        title, _, head = head.partition("\n\n")
    return "\n\n".join(part.strip() for part in (title, current, head, others) if part.strip())


def _without_our_frames(lines: Iterable[str]) -> list[str]:
    """Drop Fiber's frames around the user's code, and the list of extension modules."""
    kept = []
    ours = False
    for line in lines:
        if line.startswith(_HANDLER):
            continue
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
