"""Preparation of a FiberPool, on a thread, since it waits for the API server."""

from __future__ import annotations

import threading
from collections.abc import Callable

from fiber._backends.kubernetes.program import PreparedPool
from fiber._transport.loop import Loop
from fiber.errors import FiberError


class Preparation:
    """Calls ``prepare`` once, and on the loop's thread ``on_prepared`` with what it returns or
    ``on_failed`` with what it raises.
    """

    def __init__(
        self,
        loop: Loop,
        prepare: Callable[[], PreparedPool],
        *,
        on_prepared: Callable[[PreparedPool], None],
        on_failed: Callable[[FiberError], None],
    ) -> None:
        self._loop = loop
        self._prepare = prepare
        self._on_prepared = on_prepared
        self._on_failed = on_failed
        self._thread = threading.Thread(target=self._run, name="fiber-prepare", daemon=True)

    def start(self) -> None:
        """Begin.  On the loop's thread."""
        try:
            self._thread.start()
        except RuntimeError as error:  # the system has no room for it
            self._on_failed(_unexpected(error))

    def join(self, timeout: float) -> None:
        """Wait until it is over."""
        self._thread.join(timeout)

    def _run(self) -> None:
        try:
            prepared = self._prepare()
        except FiberError as error:
            self._loop.call_soon(self._on_failed, error)
        except Exception as error:  # a fault of ours must not leave anybody waiting
            self._loop.call_soon(self._on_failed, _unexpected(error))
        else:
            self._loop.call_soon(self._on_prepared, prepared)


def _unexpected(error: Exception) -> FiberError:
    failure = FiberError(f"no pods can be asked for, after an unexpected {error!r}")
    failure.__cause__ = error
    return failure
