"""Life of one FiberPool, as the program that is its master sees it.

``FiberPoolClient`` runs the thread of the pool. ``LeaseRenewer`` renews the master's Lease, which
shows the operator that the program lives. ``Scaling`` writes the program's demand for workers to
the pool.
"""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Protocol

from fiber._backends.kubernetes.api import (
    PODS,
    POOLS,
    Api,
    ApiError,
    Body,
    Conflict,
    Forbidden,
    NotFound,
    Transient,
    Unauthorized,
)
from fiber._backends.kubernetes.attached_pool import AttachedPool
from fiber._backends.kubernetes.informer import Informer
from fiber._backends.kubernetes.problems import PoolName, Reporter
from fiber._exceptions import fresh
from fiber._transport.loop import Loop
from fiber.errors import FiberPoolError
from fiber_api import names

OPERATOR_SLOW, OPERATOR_ABSENT = 5.0, 30.0
"""Seconds without a word from the operator until that is said, and until it is an error."""

CLOSE_TIMEOUT = 10.0
"""Seconds that the API server may take to give a pool back."""

_RENEW, _WATCH = "renew the Lease of", "watch"
"""Actions that may fail, in words that the name of the pool follows."""


class AttachablePool(Protocol):
    """Way in which a pool gets this program as its master, and in which that ends."""

    name: str
    namespace: str
    doing: str
    """Action of ``attach``, in words that the name of the pool follows."""
    displaced: str
    """Identity of the lost master whose place ``attach`` took; empty if there was none."""

    @property
    def remedy(self) -> str:
        """The command that does what ``detach`` could not."""

    def attach(self, cancel: threading.Event) -> AttachedPool:
        """Make this program the pool's master; ``ApiError``, FiberPoolError."""

    def detach(self, timeout: float) -> None:
        """Undo it, whether or not ``attach`` succeeded; ``ApiError``."""


class PoolObserver(Protocol):
    """Observer of a FiberPool.  Its methods run on the loop's thread."""

    def connected(self) -> int:
        """Return how many agents are linked; called on any thread."""

    def on_attached(self, epoch: int) -> None:
        """Once: the pool is there, with this program as its master."""

    def on_status(self, status: Body) -> None:
        """The pool's status, as it is now."""

    def on_pod(self, name: str, pod: Body | None) -> None:
        """A pod of the pool, as it is now; None once it is gone."""

    def on_lease_expired(self) -> None:
        """Another program may become the pool's master, and this one would not know."""

    def on_warning(self, message: str) -> None:
        """Something that keeps the pool waiting, and may pass."""

    def on_error(self, error: FiberPoolError) -> None:
        """Once: nothing comes of the pool any more."""

    def on_end(self) -> None:
        """After that: the pool is given back, as at the end of the program."""


class FiberPoolClient:
    """Holds one pool, on the thread ``fiber-kubernetes``; its methods return at once, but for
    ``close``.  Any thread may call them.
    """

    def __init__(
        self, api: Api, loop: Loop, attachment: AttachablePool, observer: PoolObserver
    ) -> None:
        self._api = api
        self._loop = loop
        self._attachment = attachment
        self._doing = attachment.doing
        self._observer = observer
        self._reporter = Reporter(
            loop,
            PoolName(attachment.name, attachment.namespace),
            api.server,
            on_warning=observer.on_warning,
            on_error=observer.on_error,
            on_failure=self._give_up,
        )
        self._scaling = Scaling(partial(self._reporter.trouble, "scale"))
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._close_timeout = CLOSE_TIMEOUT
        self._over = threading.Event()
        self._ended = threading.Event()
        self._generation = 0
        """Generation of the first spec with this program as its master."""
        self._observed = False
        """The operator has seen the pool with this program as its master."""
        self._began = 0.0
        """Since when the operator might have been heard."""
        self._followers: list[Informer | LeaseRenewer] = []
        self._thread = threading.Thread(target=self._run, name="fiber-kubernetes", daemon=True)

    def start(self) -> None:
        """Make the pool, or attach to it."""
        self._thread.start()

    def demand(self, replicas: int, release: Iterable[str] = ()) -> None:
        """Have so many pods, and without those named in ``release``, which are fenced.

        Only the newest ``replicas`` counts; a name to release is remembered until its pod is gone.
        """
        self._scaling.want(replicas, release)
        self._wake.set()

    def begin_close(self, timeout: float = CLOSE_TIMEOUT) -> None:
        """Begin to delete the pool, or to detach from it, and return at once."""
        self._close_timeout = timeout
        self._closing.set()
        self._reporter.mute()
        self._wake.set()

    def close(self, timeout: float = CLOSE_TIMEOUT) -> None:
        """Delete the pool, or detach from it.  Raises nothing but what signal handlers do: what
        stays behind is said on stderr, with the command that removes it.
        """
        self.begin_close(timeout)
        if self._thread.ident is None:
            return
        why = "the program was interrupted before the API server had answered"
        try:
            # Not `join`, after which an interrupted one's thread counts as ended.
            if self._ended.wait(timeout + 1.0):
                self._thread.join()
            why = f"the API server did not answer within {timeout:g} s"
        finally:
            if not self._ended.is_set():
                self._reporter.say_what_stays(why, self._attachment.remedy)

    def warn_anew(self) -> None:
        """Somebody begins to wait, and is to be told what was told before, if it is still so."""
        self._reporter.warn_anew()

    # -- On the thread

    def _run(self) -> None:
        try:
            self._serve(self._begin())
        except FiberPoolError as error:
            self._reporter.fail(error)
        except ApiError as error:
            self._reporter.refused(self._doing, error)
        except Exception as error:
            self._reporter.fault(error)
        for follower in self._followers:
            follower.stop()
        try:
            self._attachment.detach(self._close_timeout)
        except Exception as error:  # the program ends whatever comes
            self._reporter.say_what_stays(str(error), self._attachment.remedy)
        for follower in self._followers:
            follower.join(1.0)
        if not self._closing.is_set():
            self._loop.call_soon(self._observer.on_end)
        self._ended.set()

    def _begin(self) -> AttachedPool:
        attached = self._attachment.attach(self._closing)
        self._began, self._generation = time.monotonic(), attached.generation
        self._doing = "scale"
        attached.connected = self._observer.connected
        renewer = LeaseRenewer(
            attached,
            on_lost=self._reporter.fail,
            on_trouble=partial(self._reporter.trouble, _RENEW),
            on_expired=partial(self._lease_expired, attached),
            on_refused=partial(self._reporter.refused, _RENEW),
            on_fault=self._reporter.fault,
        )
        pool = Informer(
            self._api,
            POOLS.path(attached.namespace),
            {"fieldSelector": f"metadata.name={attached.name}"},
            known={attached.name},
            on_change=partial(self._pool_changed, attached, renewer),
            on_trouble=self._pool_trouble,
            on_fault=self._reporter.fault,
        )
        pods = Informer(
            self._api,
            PODS.path(attached.namespace),
            {"labelSelector": f"{names.LABEL_POOL_UID}={attached.uid}"},
            on_change=self._pod_changed,
            on_trouble=partial(self._reporter.trouble, "watch the pods of"),
            on_fault=self._reporter.fault,
        )
        self._followers = [renewer, pool, pods]
        self._loop.call_soon(self._observer.on_attached, attached.epoch)
        for follower in self._followers:
            follower.start()
        return attached

    def _serve(self, attached: AttachedPool) -> None:
        while not (self._closing.is_set() or self._over.is_set()):
            pause = min(self._scaling.step(attached), self._miss_operator())
            self._wake.wait(None if pause == math.inf else pause)
            self._wake.clear()

    def _miss_operator(self) -> float:
        """Seconds until the operator's silence means more than now."""
        if self._observed:
            return math.inf
        silent = time.monotonic() - self._began
        error = self._reporter.error(
            "NoOperator",
            f"was not looked at by an operator for {silent:.0f} s. Look whether one runs and "
            "serves this namespace (`kubectl get deployments -A -l "
            "app.kubernetes.io/name=fiber-operator`), or install it: `helm install fiber-operator "
            "charts/fiber-operator -n fiber-system --create-namespace`",
        )
        if silent >= OPERATOR_ABSENT:
            raise fresh(error)
        if silent < OPERATOR_SLOW:
            return OPERATOR_SLOW - silent
        self._reporter.warn("no operator", str(error))
        return OPERATOR_ABSENT - silent

    # -- On the threads that follow it

    def _lease_expired(self, attached: AttachedPool, seconds: float) -> None:
        if not attached.kept_by_others:
            return  # a pool of this program's own never has another master
        self._reporter.expired(seconds)
        self._loop.call_soon(self._observer.on_lease_expired)

    def _pool_changed(
        self, attached: AttachedPool, renewer: LeaseRenewer, name: str, found: Body | None
    ) -> None:
        if loss := attached.loss(found):
            self._reporter.fail(renewer.explain(loss))
            return
        assert found is not None
        status = found.get("status") or {}
        if not self._observed and status.get("observedGeneration", 0) >= self._generation:
            self._observed = True
            self._wake.set()
        self._reporter.answered()
        if self._observed:  # else it may be about the master before
            self._loop.call_soon(self._observer.on_status, status)

    def _pool_trouble(self, error: ApiError) -> None:
        if isinstance(error, Forbidden) and not self._observed:
            # Its status would never be known, and silence be taken for the operator's.
            self._reporter.refused(_WATCH, error)
            return
        self._began = time.monotonic()  # of an operator nothing could be heard either
        self._reporter.trouble(_WATCH, error)

    def _pod_changed(self, name: str, pod: Body | None) -> None:
        if pod is None and self._scaling.gone(name):
            self._wake.set()
        self._loop.call_soon(self._observer.on_pod, name, pod)

    def _give_up(self) -> None:
        self._over.set()
        self._wake.set()


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


PATCH_INTERVAL = 1.0
"""Seconds from one change to the next, so that a demand that moves is not a flood of patches."""

REFUSED = 30.0
"""Seconds that a login or a right may be missing that was there before."""


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
