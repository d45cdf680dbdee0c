"""A thread that renews the master's Lease, by which the operator knows that the program lives."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from fiber._backends.kubernetes.api_errors import (
    ApiError,
    Conflict,
    Forbidden,
    NotFound,
    Transient,
    Unauthorized,
)
from fiber._backends.kubernetes.attached_pool import AttachedPool
from fiber.errors import FiberPoolError

RENEWALS = 3
"""Within one duration."""

_TIMEOUT = 1.0
"""Seconds in which a connection that breaks is made again."""

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
        pool: AttachedPool,
        *,
        on_lost: Callable[[FiberPoolError], None],
        on_trouble: Callable[[ApiError], None],
        on_expired: Callable[[float], None],
        on_refused: Callable[[ApiError], None],
        on_fault: Callable[[Exception], None],
        now: Callable[[], float] = lambda: time.clock_gettime(time.CLOCK_BOOTTIME),
    ) -> None:
        """The Lease is fresh.  Told on the thread: ``on_trouble`` what keeps it from being renewed,
        each time; ``on_expired``, once in each duration that passes without a renewal, the seconds
        since the last one.  And once, which ends the thread: ``on_lost`` that the pool is this
        program's no more, ``on_refused`` that a login or a right has been missing for a whole
        duration, ``on_fault`` of a fault of ours.  ``now`` counts seconds, a machine's sleep among
        them.
        """
        self._pool = pool
        self._on_lost = on_lost
        self._on_trouble = on_trouble
        self._on_expired = on_expired
        self._on_refused = on_refused
        self._on_fault = on_fault
        self._now = now
        self._renewed = now()
        self._expires = self._renewed + pool.master.lease_duration
        """Time at which the Lease runs out, as far as this program knows."""
        self._refused: float | None = None
        """Time of the first refusal.  A starting API server refuses everything for a while."""
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
        if self._thread.ident is not None:
            self._thread.join(timeout)

    def explain(self, error: FiberPoolError) -> FiberPoolError:
        """``error``, which says that the pool is this program's no more, and why that may be."""
        late = self._late()
        if late <= self._pool.master.lease_duration:
            return error
        return FiberPoolError(
            f"{error}. This program did not renew its Lease for {late:.0f} s, and counts as gone "
            f"after {self._pool.master.lease_duration} s: it was stopped, native code held its "
            "interpreter, or the API server could not be reached",
            pool=error.pool,
            namespace=error.namespace,
            reason=error.reason,
        )

    def renew(self) -> None:
        """Once; FiberPoolError if the pool is this program's no more."""
        now = self._now()
        if self._late() > self._pool.master.lease_duration:
            self._pool.check()
        try:
            self._pool.renew_lease(timeout=_TIMEOUT)
        except NotFound:
            self._make()
        self._renewed = now
        self._expires = now + self._pool.master.lease_duration

    def _run(self) -> None:
        pause = self._pool.master.lease_duration / RENEWALS
        try:
            while not self._stopped.wait(pause):
                pause = self._attempt()
        except FiberPoolError as error:
            self._on_lost(self.explain(error))
        except ApiError as error:
            self._on_refused(error)
        except Exception as error:
            self._on_fault(error)

    def _attempt(self) -> float:
        """Seconds until the next one."""
        pause = self._pool.master.lease_duration / RENEWALS
        try:
            self.renew()
        except ApiError as error:
            if self._stays_refused(error):
                raise
            self._on_trouble(error)
            self._notice_expiry()
            asked = error.retry_after if isinstance(error, Transient) else 0.0
            return max(_RETRY, min(asked, pause))  # who lives must be heard in time all the same
        self._refused = None
        return pause

    def _notice_expiry(self) -> None:
        now = self._now()
        if now >= self._expires:
            self._expires = now + self._pool.master.lease_duration
            self._on_expired(now - self._renewed)

    def _stays_refused(self, error: ApiError) -> bool:
        if not isinstance(error, Forbidden | Unauthorized):
            self._refused = None
            return False
        now = self._now()
        self._refused = now if self._refused is None else self._refused
        return now - self._refused > self._pool.master.lease_duration

    def _late(self) -> float:
        return self._now() - self._renewed

    def _make(self) -> None:
        """Somebody deleted it, or all of the pool."""
        self._pool.check()
        try:
            self._pool.make_lease(timeout=_TIMEOUT)
        except Conflict:
            pass  # it is there again
