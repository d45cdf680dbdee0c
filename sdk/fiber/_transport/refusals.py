"""Which refusals are told: whoever varies his address or his fault must not fill the log."""

from __future__ import annotations

_MOST = 256
"""Refusals that are remembered; above that nothing new is told."""

_FORGET = 300.0
"""Seconds after which the same is told again."""


class Refusals:
    """Who was told of, and when.  Pure: the caller tells the time."""

    def __init__(self) -> None:
        self._told: dict[tuple[str, str], float] = {}

    def is_news(self, address: str, reason: str, now: float) -> bool:
        """Whether to tell that somebody from ``address`` is refused for ``reason``; asked once."""
        self._forget(now)
        if (address, reason) in self._told or len(self._told) >= _MOST:
            return False
        self._told[address, reason] = now
        return True

    def _forget(self, now: float) -> None:
        for refusal, told in list(self._told.items()):
            if now - told < _FORGET:
                return  # the others were told later
            del self._told[refusal]
