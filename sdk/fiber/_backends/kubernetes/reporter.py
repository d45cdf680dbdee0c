"""Reports of troubles with a FiberPool, each once while it lasts."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Callable

from fiber._backends.kubernetes.api_errors import (
    ApiError,
    ServerError,
    TooManyRequests,
    Transient,
    Unreachable,
    explain,
)
from fiber._backends.kubernetes.problems import PoolName
from fiber._transport.loop import Loop
from fiber.errors import FiberPoolError

_EXPIRED = "Lease expired"


class Reporter:
    """Any thread may call; ``on_warning`` and ``on_error`` are told on the loop's.

    There is one error at most.  ``on_failure`` is called after it, on the thread that found it.
    """

    def __init__(
        self,
        loop: Loop,
        pool: PoolName,
        server: str,
        *,
        on_warning: Callable[[str], None],
        on_error: Callable[[FiberPoolError], None],
        on_failure: Callable[[], None],
    ) -> None:
        self._loop = loop
        self._pool = pool
        self._server = server
        self._on_warning = on_warning
        self._on_error = on_error
        self._on_failure = on_failure
        self._failing = threading.Lock()
        """Taken by whoever tells of the error, and never given back."""
        self._warned: set[str] = set()
        self._muted = False

    def mute(self) -> None:
        """The pool is given back: nobody wants to know any more."""
        self._muted = True

    def answered(self) -> None:
        """The API server is well: if it fails again that is news."""
        kinds = {kind.__name__ for kind in (Unreachable, ServerError, TooManyRequests)}
        self._warned -= {*kinds, _EXPIRED}

    def warn_anew(self) -> None:
        """Somebody begins to wait, and is to be told what was told before, if it is still so."""
        self._warned.clear()

    def warn(self, what: str, message: str) -> None:
        """``what`` names that of which one warning is enough until it has passed."""
        if not self._muted and what not in self._warned:
            self._warned.add(what)
            self._loop.call_soon(self._on_warning, message)

    def trouble(self, doing: str, error: ApiError) -> None:
        """Report an error that may pass.  ``doing``: the action, before the name of the pool."""
        # One that fails in general fails in all that is done; of rights there are several.
        kind = type(error).__name__
        what = kind if isinstance(error, Transient) else f"{kind}: {doing}"
        self.warn(what, str(self._explained(doing, error)))

    def expired(self, seconds: float) -> None:
        """Tell that the Lease has not been renewed for its duration."""
        what = (
            f"may get another master: this program has not renewed its Lease for {seconds:.0f} s. "
            "Its agents dial anew: they come back with their work, or go to the next master. See "
            "that this program can reach the API server"
        )
        self.warn(_EXPIRED, str(self.error("LeaseExpired", what)))

    def refused(self, doing: str, error: ApiError) -> None:
        """Report an error that will not pass."""
        self.fail(self._explained(doing, error))

    def fault(self, error: Exception) -> None:
        """A fault of ours must not leave anybody waiting."""
        failure = self.error("Internal", f"is given up after an unexpected {error!r}")
        failure.__cause__ = error
        self.fail(failure)

    def fail(self, error: FiberPoolError) -> None:
        """Report that the pool has failed."""
        if not self._muted and self._failing.acquire(blocking=False):
            self._loop.call_soon(self._on_error, error)
            self._on_failure()  # whatever that leads to is told later

    def error(self, reason: str, what: str) -> FiberPoolError:
        """``what``: what is the matter, in words that follow the pool."""
        name, namespace = self._pool
        message = f"{self._pool} {what}"
        return FiberPoolError(message, pool=name, namespace=namespace, reason=reason)

    def _explained(self, doing: str, error: ApiError) -> FiberPoolError:
        name, namespace = self._pool
        doing = f"{doing} the FiberPool {name!r}"
        return explain(error, doing, pool=name, namespace=namespace, server=self._server)

    def say_what_stays(self, why: str, remedy: str) -> None:
        """Say on stderr what stays behind.  ``remedy`` is the command that removes it."""
        with contextlib.suppress(Exception):  # stderr may be closed
            sys.stderr.write(
                f"fiber: {self._pool} stays behind: {why}. The operator notices that this program "
                f"is gone; to be quicker: {remedy}\n"
            )
