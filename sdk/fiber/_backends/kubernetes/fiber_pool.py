"""Control of one FiberPool by the program that is its master.

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

from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.attached_pool import AttachedPool
from fiber._backends.kubernetes.informer import Informer
from fiber._backends.kubernetes.problems import PoolName, Reporter
from fiber._backends.kubernetes.published import install_command
from fiber._exceptions import fresh
from fiber._transport.loop import Loop
from fiber.errors import FiberPoolError
from fiber_api import names
from fiber_api.rest import (
    PODS,
    POOLS,
    ApiError,
    Body,
    Conflict,
    Forbidden,
    NotFound,
    Transient,
    Unauthorized,
)

OPERATOR_SLOW, OPERATOR_ABSENT = 5.0, 30.0
"""Seconds without a status from the operator until a warning, and until an error."""

CLOSE_TIMEOUT = 10.0
"""Seconds that the API server may take to delete a pool, or to detach from it."""

_NO_STATUS = (
    "was not reconciled by an operator for {seconds:.0f} s. Check that one runs and serves this "
    "namespace (`kubectl get deployments -A -l app.kubernetes.io/name=fiber-operator`), or install "
    f"it: `{install_command()}`"
)
_NO_SIGNATURE = (
    "has no valid signature for this program in its status after {seconds:.0f} s, so no agent "
    "would serve this program. If the pool's Secret was made anew, start the program again; else "
    "look at the operator's log"
)

_RENEW, _WATCH = "renew the Lease of", "watch"
"""Actions that may fail, in words that the name of the pool follows."""


class AttachablePool(Protocol):
    """FiberPool that this program can become the master of: a new one, or a warm one."""

    name: str
    namespace: str
    doing: str
    """Action of ``attach``, in words that the name of the pool follows."""
    displaced: str
    """Identity of the lost master whose place ``attach`` took; empty if there was none."""

    @property
    def remedy(self) -> str:
        """Command for the user that does what ``detach`` could not."""

    def attach(self, cancel: threading.Event) -> AttachedPool:
        """Make this program the pool's master; ``ApiError``, FiberPoolError."""

    def detach(self, timeout: float) -> None:
        """Undo ``attach``, also if it failed halfway; ``ApiError``."""


class PoolObserver(Protocol):
    """Observer of a FiberPool.  Its methods run on the loop thread."""

    def connected(self) -> int:
        """Return how many agents are linked; called on any thread."""

    def on_attached(self, pool: AttachedPool) -> None:
        """Note that the pool exists, with this program as its master.  Called once."""

    def on_status(self, status: Body) -> None:
        """Take the pool's present status."""

    def on_pod(self, name: str, pod: Body | None) -> None:
        """Take a pod's present document; None once the pod is deleted."""

    def on_lease_expired(self) -> None:
        """Note that the Lease has expired: another program may become the pool's master."""

    def on_warning(self, message: str) -> None:
        """Report a problem that may pass."""

    def on_error(self, error: FiberPoolError) -> None:
        """Note that the pool has failed.  Called once at most."""

    def on_end(self) -> None:
        """Note that the failed pool was deleted or detached from."""


class FiberPoolClient:
    """Client that controls one pool, on the thread ``fiber-kubernetes``.

    Any thread may call its methods.  All return at once, except ``close``.
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
        """True once the operator serves this program as the pool's master."""
        self._lacks = _NO_STATUS
        self._began = 0.0
        """Time since which a status of the operator could have arrived."""
        self._followers: list[Informer | LeaseRenewer] = []
        self._thread = threading.Thread(target=self._run, name="fiber-kubernetes", daemon=True)

    def start(self) -> None:
        """Start the thread, which makes the pool or attaches to it."""
        self._thread.start()

    def demand(self, replicas: int, release: Iterable[str] = ()) -> None:
        """Ask for ``replicas`` pods, and for the end of those named in ``release``.

        Only the newest ``replicas`` counts.  A name to release is kept until its pod is gone.
        """
        self._scaling.want(replicas, release)
        self._wake.set()

    def ask_for_relay(self, pool: AttachedPool) -> None:
        """Ask the operator for a relay, to which agents connect instead of this program."""
        pool.relay = True
        self._scaling.write_again()
        self._wake.set()

    def begin_close(self, timeout: float = CLOSE_TIMEOUT) -> None:
        """Begin to delete the pool, or to detach from it, and return at once."""
        self._close_timeout = timeout
        self._closing.set()
        self._reporter.mute()
        self._wake.set()

    def close(self, timeout: float = CLOSE_TIMEOUT) -> None:
        """Delete the pool, or detach from it.

        Raises only what a signal handler raises.  If the API server does not answer, a line on
        stderr says what is left, and the command that removes it.
        """
        self.begin_close(timeout)
        if self._thread.ident is None:
            return
        why = "the program was interrupted before the API server had answered"
        try:
            # Not ``join``: after an interrupted one, the thread would count as ended.
            if self._ended.wait(timeout + 1.0):
                self._thread.join()
            why = f"the API server did not answer within {timeout:g} s"
        finally:
            if not self._ended.is_set():
                self._reporter.say_what_stays(why, self._attachment.remedy)

    def warn_anew(self) -> None:
        """Repeat the warnings of problems that persist, since children begin to wait."""
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
        except Exception as error:  # no error may keep the program from ending
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
        self._loop.call_soon(self._observer.on_attached, attached)
        for follower in self._followers:
            follower.start()
        return attached

    def _serve(self, attached: AttachedPool) -> None:
        while not (self._closing.is_set() or self._over.is_set()):
            pause = min(self._scaling.step(attached), self._check_operator())
            self._wake.wait(None if pause == math.inf else pause)
            self._wake.clear()

    def _check_operator(self) -> float:
        """Warn or fail if the operator is silent; return the seconds until the next check."""
        if self._observed:
            return math.inf
        silent = time.monotonic() - self._began
        error = self._reporter.error("NoOperator", self._lacks.format(seconds=silent))
        if silent >= OPERATOR_ABSENT:
            raise fresh(error)
        if silent < OPERATOR_SLOW:
            return OPERATOR_SLOW - silent
        self._reporter.warn("no operator", str(error))
        return OPERATOR_ABSENT - silent

    # -- On the threads of the followers

    def _lease_expired(self, attached: AttachedPool, seconds: float) -> None:
        if not attached.kept_by_others:
            return  # a pool that this program made never has another master
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
            self._lacks = _NO_SIGNATURE
            self._observed = attached.take_signature(status)
            self._wake.set()
        self._reporter.answered()
        if self._observed:  # else the status may be about the master before
            self._loop.call_soon(self._observer.on_status, status)

    def _pool_trouble(self, error: ApiError) -> None:
        if isinstance(error, Forbidden) and not self._observed:
            # Without a watch there is no status, and the operator would seem to be silent.
            self._reporter.refused(_WATCH, error)
            return
        self._began = time.monotonic()  # a status of the operator could not arrive either
        self._reporter.trouble(_WATCH, error)

    def _pod_changed(self, name: str, pod: Body | None) -> None:
        if pod is None and self._scaling.gone(name):
            self._wake.set()
        self._loop.call_soon(self._observer.on_pod, name, pod)

    def _give_up(self) -> None:
        self._over.set()
        self._wake.set()


RENEWALS = 3
"""Number of renewals within one duration of the Lease."""

_TIMEOUT = 1.0
"""Seconds for one call."""

_RETRY = 2.0
"""Seconds until the next attempt, after a failed one."""


class LeaseRenewer:
    """Thread that renews the Lease of one pool, every third of its duration.

    It does little work, so that a busy interpreter delays it little.  If the program was stopped or
    blocked for longer than the duration, another program may be the master, so ``renew`` checks the
    pool first.
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
        """Prepare to renew a Lease that is new.  The functions are called on the thread.

        ``on_trouble`` gets the error of each failed attempt.  ``on_expired`` gets the seconds since
        the last renewal, once in each duration that passes without one.  One of the others ends the
        thread: ``on_lost`` if the pool has another master or is deleted, ``on_refused`` if a login
        or a right is missing for a whole duration, ``on_fault`` at a bug.  ``now`` counts seconds,
        and also counts while the machine sleeps.
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
        """Time at which the Lease expires, as far as this program knows."""
        self._refused: float | None = None
        """Time of the first refusal.  A starting API server refuses everything for a while."""
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fiber-lease", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop renewing; return at once."""
        self._stopped.set()

    def join(self, timeout: float) -> None:
        """Wait for the thread's end after ``stop``."""
        if self._thread.ident is not None:
            self._thread.join(timeout)

    def explain(self, error: FiberPoolError) -> FiberPoolError:
        """Return ``error``, the loss of the pool, with the reason if the Lease had expired."""
        late = self._late()
        if late <= self._pool.master.lease_duration:
            return error
        return FiberPoolError(
            f"{error}. This program did not renew its Lease for {late:.0f} s, and counts as lost "
            f"after {self._pool.master.lease_duration} s: it was stopped, native code blocked its "
            "interpreter, or the API server could not be reached",
            pool=error.pool,
            namespace=error.namespace,
            reason=error.reason,
        )

    def renew(self) -> None:
        """Renew the Lease once; FiberPoolError if the pool was lost."""
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
        """Renew the Lease; return the seconds until the next attempt."""
        pause = self._pool.master.lease_duration / RENEWALS
        try:
            self.renew()
        except ApiError as error:
            if self._stays_refused(error):
                raise
            self._on_trouble(error)
            self._notice_expiry()
            asked = error.retry_after if isinstance(error, Transient) else 0.0
            return max(_RETRY, min(asked, pause))  # in time, also if the server asks for longer
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
        """Make the Lease, which was deleted; FiberPoolError if the pool was deleted too."""
        self._pool.check()
        try:
            self._pool.make_lease(timeout=_TIMEOUT)
        except Conflict:
            pass  # it exists again


PATCH_INTERVAL = 1.0
"""Seconds between two patches, so that a changing demand makes few of them."""

REFUSED = 30.0
"""Seconds for which a login or a right may be missing."""


_PAUSE_MIN, _PAUSE_MAX = 0.2, 5.0
"""Seconds until the next attempt, after a failed one; growing."""


class Scaling:
    """Writer of the newest demand to the pool: at most once a second, repeated after failures.

    Any thread may call ``want`` and ``gone``.  One thread calls ``step``.
    """

    def __init__(
        self,
        on_trouble: Callable[[ApiError], None],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """``on_trouble`` gets the error of each failed attempt."""
        self._on_trouble = on_trouble
        self._now = now
        self._lock = threading.Lock()
        self._changed = False
        self._replicas = 0
        self._release: dict[str, None] = {}
        """Pods to release, in order.  At most MAX_RELEASE of them go at a time."""
        self._gone: set[str] = set()
        """Deleted pods.  A name is never used again."""
        self._due = 0.0
        self._pause = _PAUSE_MIN
        self._refused: float | None = None
        """Time of the first refusal in a row; None if there is none."""

    def want(self, replicas: int, release: Iterable[str]) -> None:
        """Set the number of pods; add names to those that are to be released."""
        with self._lock:
            self._replicas = replicas
            self._release.update((name, None) for name in release if name not in self._gone)
            self._changed = True

    def write_again(self) -> None:
        """Write the demand again, since another field of the pool has changed."""
        with self._lock:
            self._changed = True

    def gone(self, name: str) -> bool:
        """Note that a pod is deleted; return whether another name can be released now."""
        with self._lock:
            self._gone.add(name)
            if name not in self._release:
                return False
            waiting = len(self._release) > names.MAX_RELEASE
            del self._release[name]
            self._changed = self._changed or waiting
            return waiting

    def step(self, pool: AttachedPool) -> float:
        """Write what is due; return the seconds until the next step.

        ``ApiError`` or FiberPoolError: writing will never succeed.
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
            pool.check()  # if the pool was lost, that error says more
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
