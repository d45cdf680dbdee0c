"""Wishes for a pool's size, on their way into the pool."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Callable, Iterable

from fiber._backends.kubernetes.api_errors import (
    ApiError,
    Conflict,
    Forbidden,
    Transient,
    Unauthorized,
)
from fiber._backends.kubernetes.attached_pool import AttachedPool
from fiber_api import names

PATCH_INTERVAL = 1.0
"""Seconds from one change to the next, so that a demand that moves is not a flood of patches."""

REFUSED = 30.0
"""Seconds that a login or a right may be missing that was there before."""

_TIMEOUT = 1.0
"""Seconds in which a connection that breaks is made again; after that a newer demand may count."""

_PAUSE_MIN, _PAUSE_MAX = 0.2, 5.0
"""Seconds after an attempt that failed, growing."""


class Scaling:
    """The newest demand, written at once, then once a second at most, and again until it holds.

    ``want`` and ``gone`` are for any thread, ``step`` for one.
    """

    def __init__(
        self,
        on_trouble: Callable[[ApiError], None],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """``on_trouble`` is told what keeps a demand from being written, each time."""
        self._on_trouble = on_trouble
        self._now = now
        self._lock = threading.Lock()
        self._changed = False
        self._replicas = 0
        self._release: dict[str, None] = {}
        """Pods to release, in order.  At most MAX_RELEASE of them go at a time."""
        self._gone: set[str] = set()
        """Pods that were there.  A name is never used again."""
        self._due = 0.0
        self._pause = _PAUSE_MIN
        self._refused: float | None = None
        """Since when."""

    def want(self, replicas: int, release: Iterable[str]) -> None:
        """From now on; names to release are added to those of before."""
        with self._lock:
            self._replicas = replicas
            self._release.update((name, None) for name in release if name not in self._gone)
            self._changed = True

    def gone(self, name: str) -> bool:
        """The pod is there no more; whether there is a name now that can take its place."""
        with self._lock:
            self._gone.add(name)
            if name not in self._release:
                return False
            waiting = len(self._release) > names.MAX_RELEASE
            del self._release[name]
            self._changed = self._changed or waiting
            return waiting

    def step(self, pool: AttachedPool) -> float:
        """Write what is due; seconds until the next step is.

        ``ApiError`` and FiberPoolError where that will never succeed.
        """
        now = self._now()
        if now < self._due:
            return self._due - now
        with self._lock:
            if not self._changed:
                return math.inf
            self._changed = False
            replicas = self._replicas
            release = list(itertools.islice(self._release, names.MAX_RELEASE))
        try:
            self._write(pool, replicas, release)
            self._due, self._pause, self._refused = now + PATCH_INTERVAL, _PAUSE_MIN, None
        except (Conflict, Forbidden, Unauthorized, Transient) as error:
            if not self._put_off(error):
                raise
        return self._due - now

    def _write(self, pool: AttachedPool, replicas: int, release: list[str]) -> None:
        try:
            pool.apply(replicas, release, timeout=_TIMEOUT)
        except (Forbidden, Unauthorized, Transient):
            raise
        except ApiError:
            pool.check()  # another's by now, or deleted: that says more
            raise

    def _put_off(self, error: ApiError) -> bool:
        """Try again later; return False if the server has refused for too long."""
        now = self._now()
        if isinstance(error, Forbidden | Unauthorized):
            self._refused = now if self._refused is None else self._refused
            if now - self._refused >= REFUSED:
                return False
        with self._lock:
            self._changed = True
        asked = error.retry_after if isinstance(error, Transient) else 0.0
        self._due = now + max(self._pause, asked)
        self._pause = min(2 * self._pause, _PAUSE_MAX)
        self._on_trouble(error)
        return True
