"""The life of one FiberPool, as the program that is its master sees it."""

from __future__ import annotations

import contextlib
import math
import sys
import threading
import time
from collections.abc import Iterable
from functools import partial
from typing import Protocol

from fiber._backends.kubernetes.api import Api
from fiber._backends.kubernetes.api_errors import (
    ApiError,
    Body,
    Forbidden,
    ServerError,
    TooManyRequests,
    Transient,
    Unreachable,
    explain,
)
from fiber._backends.kubernetes.attached_pool import AttachedPool
from fiber._backends.kubernetes.informer import Informer
from fiber._backends.kubernetes.lease import LeaseRenewer
from fiber._backends.kubernetes.resources import PODS, POOLS
from fiber._backends.kubernetes.scaling import Scaling
from fiber._transport.loop import Loop
from fiber.errors import FiberPoolError
from fiber_api import names

OPERATOR_SLOW, OPERATOR_ABSENT = 5.0, 30.0
"""Seconds without a word from the operator until that is said, and until it is an error."""

CLOSE_TIMEOUT = 10.0
"""Seconds that the API server may take to give a pool back."""

_RENEW, _WATCH = "renew the Lease of", "watch"
"""What cannot be done, in words that follow "cannot"."""


class Attachment(Protocol):
    """How a pool comes to have this program as its master, and how that ends."""

    name: str
    namespace: str
    doing: str
    """What ``attach`` does, in words that follow "cannot"."""

    @property
    def remedy(self) -> str:
        """The command that does what ``detach`` could not."""

    def attach(self, cancel: threading.Event) -> AttachedPool:
        """Make this program the pool's master; ``ApiError``, FiberPoolError."""

    def detach(self, timeout: float) -> None:
        """Undo it, whether or not ``attach`` succeeded; ``ApiError``."""


class Observer(Protocol):
    """Who is told, on the loop's thread."""

    def on_attached(self) -> None:
        """Once: the pool is there, with this program as its master."""

    def on_status(self, status: Body) -> None:
        """The pool's status, as it is now."""

    def on_pod(self, name: str, pod: Body | None) -> None:
        """A pod of the pool, as it is now; None once it is gone."""

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

    def __init__(self, api: Api, loop: Loop, attachment: Attachment, observer: Observer) -> None:
        self._api = api
        self._loop = loop
        self._attachment = attachment
        self._doing = attachment.doing
        self._observer = observer
        self._scaling = Scaling(partial(self._trouble, "scale"))
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._close_timeout = CLOSE_TIMEOUT
        self._failing = threading.Lock()
        """Taken by whoever tells of the error; never given back: there is only one."""
        self._over = threading.Event()
        self._ended = threading.Event()
        self._warned: set[str] = set()
        self._generation = 0
        """That of the spec which first had this program as its master."""
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
                self._say_what_stays(why)

    def warn_anew(self) -> None:
        """Somebody begins to wait, and is to be told what was told before, if it is still so."""
        self._warned.clear()

    # -- On the thread

    def _run(self) -> None:
        try:
            self._serve(self._begin())
        except FiberPoolError as error:
            self._fail(error)
        except ApiError as error:
            self._fail(self._explained(error, self._doing))
        except Exception as error:
            self._fault(error)
        for follower in self._followers:
            follower.stop()
        try:
            self._attachment.detach(self._close_timeout)
        except Exception as error:  # the program ends whatever comes
            self._say_what_stays(str(error))
        for follower in self._followers:
            follower.join(1.0)
        if not self._closing.is_set():
            self._loop.call_soon(self._observer.on_end)
        self._ended.set()

    def _begin(self) -> AttachedPool:
        attached = self._attachment.attach(self._closing)
        self._began, self._generation = time.monotonic(), attached.generation
        self._doing = f"scale {self._short_name}"
        renewer = LeaseRenewer(
            attached,
            on_lost=self._fail,
            on_trouble=partial(self._trouble, _RENEW),
            on_refused=partial(self._refused, _RENEW),
            on_fault=self._fault,
        )
        pool = Informer(
            self._api,
            POOLS.path(attached.namespace),
            {"fieldSelector": f"metadata.name={attached.name}"},
            known={attached.name},
            on_change=partial(self._pool_changed, attached, renewer),
            on_trouble=self._pool_trouble,
            on_fault=self._fault,
        )
        pods = Informer(
            self._api,
            PODS.path(attached.namespace),
            {"labelSelector": f"{names.LABEL_POOL_UID}={attached.uid}"},
            on_change=self._pod_changed,
            on_trouble=partial(self._trouble, "watch the pods of"),
            on_fault=self._fault,
        )
        self._followers = [renewer, pool, pods]
        self._loop.call_soon(self._observer.on_attached)
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
        what = f"was not looked at by an operator for {silent:.0f} s"
        advice = (
            "Look whether one runs and serves this namespace (`kubectl get deployments -A -l "
            "app.kubernetes.io/name=fiber-operator`), or install it: `helm install fiber-operator "
            "charts/fiber-operator -n fiber-system --create-namespace`"
        )
        if silent >= OPERATOR_ABSENT:
            raise self._error("NoOperator", f"{what}. {advice}")
        if silent < OPERATOR_SLOW:
            return OPERATOR_SLOW - silent
        self._warn("no operator", f"{self._pool} {what}. {advice}")
        return OPERATOR_ABSENT - silent

    # -- On the threads that follow it

    def _pool_changed(
        self, attached: AttachedPool, renewer: LeaseRenewer, name: str, found: Body | None
    ) -> None:
        if loss := attached.loss(found):
            self._fail(renewer.explain(loss))
            return
        assert found is not None
        status = found.get("status") or {}
        if not self._observed and status.get("observedGeneration", 0) >= self._generation:
            self._observed = True
            self._wake.set()
        self._warned -= {kind.__name__ for kind in (Unreachable, ServerError, TooManyRequests)}
        if self._observed:  # else it may be about the master before
            self._loop.call_soon(self._observer.on_status, status)

    def _pool_trouble(self, error: ApiError) -> None:
        if isinstance(error, Forbidden) and not self._observed:
            # Its status would never be known, and silence be taken for the operator's.
            self._refused(_WATCH, error)
            return
        self._began = time.monotonic()  # of an operator nothing could be heard either
        self._trouble(_WATCH, error)

    def _pod_changed(self, name: str, pod: Body | None) -> None:
        if pod is None and self._scaling.gone(name):
            self._wake.set()
        self._loop.call_soon(self._observer.on_pod, name, pod)

    # -- On any of them

    def _trouble(self, doing: str, error: ApiError) -> None:
        """``doing``: what cannot be done, in words that the pool follows."""
        if not self._closing.is_set():
            # One that fails in general fails in all that is done; of rights there are several.
            kind = type(error).__name__
            what = kind if isinstance(error, Transient) else f"{kind}: {doing}"
            self._warn(what, str(self._explained(error, f"{doing} {self._short_name}")))

    def _warn(self, what: str, message: str) -> None:
        """Once, until it has passed."""
        if what not in self._warned:
            self._warned.add(what)
            self._loop.call_soon(self._observer.on_warning, message)

    def _refused(self, doing: str, error: ApiError) -> None:
        self._fail(self._explained(error, f"{doing} {self._short_name}"))

    def _fault(self, error: Exception) -> None:
        """A fault of ours must not leave anybody waiting."""
        failure = self._error("Internal", f"is given up after an unexpected {error!r}")
        failure.__cause__ = error
        self._fail(failure)

    def _fail(self, error: FiberPoolError) -> None:
        if self._closing.is_set() or not self._failing.acquire(blocking=False):
            return
        self._over.set()
        self._wake.set()
        self._loop.call_soon(self._observer.on_error, error)

    @property
    def _short_name(self) -> str:
        return f"the FiberPool {self._attachment.name!r}"

    @property
    def _pool(self) -> str:
        return f"{self._short_name} in namespace {self._attachment.namespace!r}"

    def _error(self, reason: str, what: str) -> FiberPoolError:
        return FiberPoolError(
            f"{self._pool} {what}",
            pool=self._attachment.name,
            namespace=self._attachment.namespace,
            reason=reason,
        )

    def _explained(self, error: ApiError, doing: str) -> FiberPoolError:
        return explain(
            error,
            doing,
            pool=self._attachment.name,
            namespace=self._attachment.namespace,
            server=self._api.server,
        )

    def _say_what_stays(self, why: str) -> None:
        with contextlib.suppress(Exception):  # stderr may be closed
            sys.stderr.write(
                f"fiber: {self._pool} stays behind: {why}. The operator notices that this program "
                f"is gone; to be quicker: {self._attachment.remedy}\n"
            )
