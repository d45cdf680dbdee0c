"""Identity of a process in one word of shared memory, by which others see whether it lives.

A pid alone would not do: the kernel gives it to another process.  Beside it is the time at which
the process started, as the kernel counts it.
"""

from __future__ import annotations

import os

_PID = (1 << 31) - 1
_START = (1 << 32) - 1


def me() -> int:
    """The word for this process."""
    global _me
    if _me is None:
        _me = _own()
    return _me


def _own() -> int:
    pid = os.getpid()
    start = _start_time(pid)
    assert start is not None
    return start << 31 | pid


def pid(who: int) -> int:
    """The pid in a word."""
    return who & _PID


def is_alive(who: int) -> bool:
    """Tell whether that process still runs.  One that has ended and was not reaped does not."""
    return _start_time(who & _PID) == who >> 31


def _after_fork() -> None:
    global _me
    _me = None


_me: int | None = None
os.register_at_fork(after_in_child=_after_fork)


def _start_time(pid: int) -> int | None:
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            # The name before it may have any character in it, the last parenthesis is its end.
            fields = file.read().rpartition(b")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return None
    return None if fields[0] in b"ZX" else int(fields[19]) & _START
