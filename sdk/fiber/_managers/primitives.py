"""Locks of a manager: Fiber's own, which its clients use without the manager.

The manager makes the lock and keeps it as long as a proxy refers to it.  A process that gets a
proxy gets the lock itself, too.  Calls of the proxy act on the lock's shared memory, or ask the hub
of the manager's host.  So the lock of a process that dies is released as any lock of Fiber is.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from multiprocessing import managers as mp_managers
from multiprocessing.managers import BaseProxy
from typing import Any

from fiber._hub.shared_blocks import RemoteSemaphore
from fiber.synchronize import BoundedSemaphore, Condition, Lock, RLock, Semaphore, SemLock

_AcquirerProxy: Any = mp_managers.AcquirerProxy  # type: ignore[attr-defined]  # typeshed lacks it

METHODS = frozenset(("acquire", "release", "wait", "notify", "notify_all"))
"""Methods that a client calls on the lock itself."""


def maker(make: Callable[..., Any] | None, proxytype: Any) -> Callable[..., Any] | None:
    """Return the callable that makes an object: Fiber's for one of ``threading``'s locks."""
    return _OURS.get(make, make) if _is_for_locks(proxytype) else make


def is_lock(obj: object, proxytype: Any) -> bool:
    """Tell whether clients use ``obj`` without the manager."""
    return _is_for_locks(proxytype) and isinstance(obj, (SemLock, Condition))


def _is_for_locks(proxytype: Any) -> bool:
    return isinstance(proxytype, type) and issubclass(proxytype, _AcquirerProxy)


def _condition(lock: Any = None) -> Condition:
    # A lock that is an argument comes as its proxy.
    return Condition(lock._getvalue() if isinstance(lock, BaseProxy) else lock)


_OURS: dict[Any, Callable[..., Any]] = {
    threading.Lock: Lock,
    threading.RLock: RLock,
    threading.Semaphore: Semaphore,
    threading.BoundedSemaphore: BoundedSemaphore,
    threading.Condition: _condition,
}


def disown(lock: SemLock | Condition) -> None:
    """Let another process release the lock, which this process does not use any longer."""
    semaphore = (lock._lock if isinstance(lock, Condition) else lock)._semlock
    if isinstance(semaphore, RemoteSemaphore):
        semaphore.disown()


def call(lock: Any, method: str, args: Any, kwds: Any) -> Any:
    """Call a method with the arguments and errors of ``threading``."""
    try:
        if method == "acquire":
            return _acquire(lock, *args, **kwds)
        return getattr(lock, method)(*args, **kwds)
    except AssertionError as error:
        raise RuntimeError(str(error)) from error
    except ValueError as error:
        if method == "release" and not isinstance(lock, BoundedSemaphore):
            raise RuntimeError(str(error)) from error
        raise


def _acquire(lock: Any, blocking: bool = True, timeout: float | None = None) -> bool:
    acquired: bool = lock.acquire(blocking, None if timeout == -1 else timeout)
    return acquired
