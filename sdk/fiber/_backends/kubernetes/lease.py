"""A thread that renews the master's Lease, by which the operator knows that the program lives."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from fiber._backends.kubernetes.api_errors import ApiError, Conflict, NotFound
from fiber._backends.kubernetes.held_pool import HeldPool
from fiber.errors import FiberPoolError

RENEWALS = 3
"""Within one duration."""

_RETRY = 2.0
"""Seconds after one that failed."""


class LeaseRenewer:
    """Renews the Lease of one pool, every third of its duration.

    It does little, over a connection that stays open, so that an interpreter that is busy or held
    by native code delays it as little as can be.  Where that, or a stopped process, took longer
    than the duration the operator may have given the pool away: it looks before it goes on.
    """

    def __init__(
        self,
        pool: HeldPool,
        *,
        on_lost: Callable[[FiberPoolError], None],
        on_trouble: Callable[[ApiError], None],
        now: Callable[[], float] = lambda: time.clock_gettime(time.CLOCK_BOOTTIME),
    ) -> None:
        """The Lease is fresh.  ``now`` counts seconds, those of a machine's sleep as well."""
        self._pool = pool
        self._on_lost = on_lost
        self._on_trouble = on_trouble
        self._now = now
        self._renewed = now()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fiber-lease", daemon=True)

    def start(self) -> None:
        """Begin, on a thread of its own."""
        self._thread.start()

    def stop(self) -> None:
        """Renew no more; returns at once."""
        self._stopped.set()

    def join(self, timeout: float) -> None:
        """Wait for the thread's end after ``stop``."""
        self._thread.join(timeout)

    def _run(self) -> None:
        pause = self._pool.master.lease_duration / RENEWALS
        while not self._stopped.wait(pause):
            try:
                self.renew()
                pause = self._pool.master.lease_duration / RENEWALS
            except ApiError as error:
                self._on_trouble(error)
                pause = _RETRY
            except FiberPoolError as error:
                self._on_lost(error)
                return

    def renew(self) -> None:
        """Once; FiberPoolError if the pool is this program's no more."""
        now = self._now()
        late = now - self._renewed
        if late > self._pool.master.lease_duration:
            self._check(late)
        try:
            self._pool.renew_lease(timeout=0.0)
        except NotFound:
            self._make()
        self._renewed = now

    def _make(self) -> None:
        """Somebody deleted it, or all of the pool."""
        self._pool.check()
        try:
            self._pool.make_lease(timeout=0.0)
        except Conflict:
            pass  # it is there again

    def _check(self, late: float) -> None:
        try:
            self._pool.check()
        except FiberPoolError as error:
            raise FiberPoolError(
                f"{error}. This program did not renew its Lease for {late:.0f} s: it was stopped, "
                "native code held the interpreter, or the API server was out of reach; and after "
                f"{self._pool.master.lease_duration} s it counts as gone",
                pool=error.pool,
                namespace=error.namespace,
                reason=error.reason,
            ) from None
