"""How whoever changed shared memory has its host's hub look, which may wait for that for others."""

from __future__ import annotations

from collections.abc import Callable


class Doorbell:
    """Of one hub.  On the loop's thread, but for ``ring``."""

    def __init__(self, call_soon: Callable[..., None]) -> None:
        self._call_soon = call_soon
        self._listeners: set[Callable[[], None]] = set()

    def listen(self, listener: Callable[[], None]) -> None:
        """Call it whenever the bell is rung, and perhaps for nothing."""
        self._listeners.add(listener)

    def forget(self, listener: Callable[[], None]) -> None:
        """It is not to be called again."""
        self._listeners.discard(listener)

    def ring(self) -> None:
        """Have all listeners look.  Any thread; waits for nothing."""
        self._call_soon(self.rung)

    def rung(self) -> None:
        """They look now."""
        for listener in tuple(self._listeners):
            listener()
