"""Doorbell of a hub: a process that changed shared memory rings, and the hub looks."""

from __future__ import annotations

from collections.abc import Callable


class Doorbell:
    """Doorbell of one hub.  Runs on the loop's thread, but for ``ring``."""

    def __init__(self, call_soon: Callable[..., None]) -> None:
        self._call_soon = call_soon
        self._listeners: set[Callable[[], None]] = set()

    def listen(self, listener: Callable[[], None]) -> None:
        """Call it whenever the bell is rung, and perhaps for nothing."""
        self._listeners.add(listener)

    def forget(self, listener: Callable[[], None]) -> None:
        """Stop calling ``listener``."""
        self._listeners.discard(listener)

    def ring(self) -> None:
        """Have all listeners look.  Any thread; waits for nothing."""
        self._call_soon(self.rung)

    def rung(self) -> None:
        """Call all listeners."""
        for listener in tuple(self._listeners):
            listener()
