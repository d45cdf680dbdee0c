"""Primitives in shared memory that survive the death of a process.

The *identity* of a process is one word, by which other processes see whether it is alive.  A pid
alone is not enough, as the kernel gives it to another process later.  So the word also holds the
time at which the process started, as the kernel counts it.

A ``RobustMutex`` is released by the kernel when its holder dies.  It guards what is done rarely.
The program's locks are not robust mutexes, since only the thread that locked such a mutex may
unlock it.
"""

from __future__ import annotations

import ctypes
import errno
import functools
import os
import time
from collections.abc import Callable
from typing import TypeVar, cast

_PID = (1 << 31) - 1
_START = (1 << 32) - 1


def own_identity() -> int:
    """Return the identity of this process."""
    global _me
    if _me is None:
        _me = _own()
    return _me


def _own() -> int:
    pid = os.getpid()
    start = _start_time(pid)
    assert start is not None
    return start << 31 | pid


def pid_of(who: int) -> int:
    """Return the pid in an identity."""
    return who & _PID


def is_alive(who: int) -> bool:
    """Tell whether a process still runs.  A zombie does not."""
    return _start_time(who & _PID) == who >> 31


def _after_fork() -> None:
    global _me
    _me = None


_me: int | None = None
os.register_at_fork(after_in_child=_after_fork)


def _start_time(pid: int) -> int | None:
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            # The process's name may have any character in it; it ends at the last parenthesis.
            fields = file.read().rpartition(b")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return None
    return None if fields[0] in b"ZX" else int(fields[19]) & _START


MUTEX_SIZE = 64
"""Bytes reserved for a mutex.  It needs fewer."""

_RECURSIVE, _ROBUST, _SHARED = 1, 1, 1
_NAP = 0.0005  # seconds between two tries

# None of these calls waits, so they keep the interpreter.
_libc = ctypes.PyDLL(None)

_Result = TypeVar("_Result")


class RobustMutex:
    """Robust mutex at an address.  One process calls ``create``, once, for all."""

    __slots__ = ("_address",)

    def __init__(self, address: int) -> None:
        self._address = ctypes.c_void_p(address)

    def create(self) -> None:
        """Initialize the mutex.  It is recursive, as a finalizer may run while it is held."""
        _check(_libc.pthread_mutex_init(self._address, _attributes()))

    def run(self, action: Callable[[], _Result]) -> _Result:
        """Call ``action`` while this thread holds the mutex; return its result."""
        return cast("_Result", self._run(action, wait=True))

    def try_run(self, action: Callable[[], _Result]) -> _Result | None:
        """Do as ``run`` does, but return None at once if another thread holds the mutex."""
        return self._run(action, wait=False)

    def _run(self, action: Callable[[], _Result], *, wait: bool) -> _Result | None:
        outcomes: list[int] = []
        try:
            # One step locks and notes the outcome: no signal's handler runs in between.
            outcomes.extend(map(_libc.pthread_mutex_trylock, (self._address,)))
            while outcomes[-1] == errno.EBUSY:
                if not wait:
                    return None
                time.sleep(_NAP)
                outcomes.extend(map(_libc.pthread_mutex_trylock, (self._address,)))
            if outcomes[-1] == errno.EOWNERDEAD:
                # Each step of a change leaves the guarded data consistent.
                _check(_libc.pthread_mutex_consistent(self._address))
            elif outcomes[-1]:
                _check(outcomes[-1])
            return action()
        finally:
            if outcomes and outcomes[-1] in (0, errno.EOWNERDEAD):
                _libc.pthread_mutex_unlock(self._address)


@functools.cache
def _attributes() -> ctypes.Array[ctypes.c_char]:
    attributes = ctypes.create_string_buffer(MUTEX_SIZE)
    _check(_libc.pthread_mutexattr_init(attributes))
    _check(_libc.pthread_mutexattr_setpshared(attributes, _SHARED))
    _check(_libc.pthread_mutexattr_setrobust(attributes, _ROBUST))
    _check(_libc.pthread_mutexattr_settype(attributes, _RECURSIVE))
    return attributes


def _check(code: int) -> None:
    if code:
        raise OSError(code, f"a mutex in shared memory: {errno.errorcode.get(code, code)}")
