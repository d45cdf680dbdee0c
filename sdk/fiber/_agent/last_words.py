"""Python stacks of a child that crashes or runs for too long.

The zygote makes a memory file for each child.  faulthandler writes the stacks of all threads there,
also at a crash in native code, and the zygote reads them when the child is gone.
"""

from __future__ import annotations

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
