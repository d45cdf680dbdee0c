"""A mutex in shared memory that the kernel releases when its holder dies.

It guards what is done rarely; a lock of the program's must not be one, since only the thread that
locked it may unlock it.
"""

from __future__ import annotations

import ctypes
import errno
import time
from collections.abc import Callable
from typing import TypeVar

SIZE = 64
"""Bytes that it takes; some are spare."""

_RECURSIVE, _ROBUST, _SHARED = 1, 1, 1
_NAP = 0.0005  # seconds between two tries

# None of these calls waits, so they keep the interpreter.
_libc = ctypes.PyDLL(None)

_Result = TypeVar("_Result")


class RobustMutex:
    """Robust mutex at an address; ``create`` makes it, once, for all processes."""

    __slots__ = ("_address",)

    def __init__(self, address: int) -> None:
        self._address = ctypes.c_void_p(address)

    def create(self) -> None:
        """Make it.  Recursive: a finalizer may come in the middle of what it guards."""
        attributes = ctypes.create_string_buffer(SIZE)
        _check(_libc.pthread_mutexattr_init(attributes))
        _check(_libc.pthread_mutexattr_setpshared(attributes, _SHARED))
        _check(_libc.pthread_mutexattr_setrobust(attributes, _ROBUST))
        _check(_libc.pthread_mutexattr_settype(attributes, _RECURSIVE))
        _check(_libc.pthread_mutex_init(self._address, attributes))

    def run(self, action: Callable[[], _Result]) -> _Result:
        """Call ``action`` under the mutex; return its result."""
        outcomes: list[int] = []
        try:
            # The outcome is noted in the step that brings it: no signal strikes in between.
            outcomes.extend(map(_libc.pthread_mutex_trylock, (self._address,)))
            while outcomes[-1] == errno.EBUSY:
                time.sleep(_NAP)
                outcomes.extend(map(_libc.pthread_mutex_trylock, (self._address,)))
            if outcomes[-1] == errno.EOWNERDEAD:
                # Whatever it guards is changed in steps of which each leaves it in order.
                _check(_libc.pthread_mutex_consistent(self._address))
            elif outcomes[-1]:
                _check(outcomes[-1])
            return action()
        finally:
            if outcomes and outcomes[-1] in (0, errno.EOWNERDEAD):
                _libc.pthread_mutex_unlock(self._address)


def _check(code: int) -> None:
    if code:
        raise OSError(code, f"a mutex in shared memory: {errno.errorcode.get(code, code)}")
