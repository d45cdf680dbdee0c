"""Choice of the refusals that are logged.

Strangers that vary their address or their fault must not fill the log, and must not keep refusals
of the program's own agents out of it.
"""

from __future__ import annotations

_MOST = 256
"""Limit of remembered refusals: of strangers, and of the program's own agents."""

_FORGET = 300.0
"""Seconds until the same refusal is logged again, and between two summaries of strangers."""


class Refusals:
    """Refusals that were logged, and when.  Pure: the caller passes the time.

    An own agent is one that has proved to have the pool's credentials.
    """

    def __init__(self) -> None:
        self._strangers: dict[tuple[str, str], float] = {}
        self._own: dict[tuple[str, str], float] = {}
        self._untold = 0
        self._next_summary = 0.0

    def news(self, host: str, origin: str, reason: str, now: float, *, own: bool = False) -> str:
        """Return the line to log for a refusal; empty if the same was logged lately.

        ``own`` marks a refusal of an agent of the program: no number of strangers suppresses it.
        """
        told = self._own if own else self._strangers
        _forget(told, now)
        if (host, reason) in told:
            return ""
        if len(told) >= _MOST:
            if not own:
                return self._summary(origin, reason, now)
            del told[next(iter(told))]
        told[host, reason] = now
        return f"{reason} ({origin})" if own else f"{origin} was turned away: {reason}"

    def _summary(self, origin: str, reason: str, now: float) -> str:
        self._untold += 1
        if now < self._next_summary:
            return ""
        count, self._untold = self._untold, 0
        self._next_summary = now + _FORGET
        return (
            f"strangers come from many addresses: {count} more turned away, the last was {origin} "
            f"({reason}). The next line about them comes in {_FORGET / 60:.0f} minutes"
        )


def _forget(told: dict[tuple[str, str], float], now: float) -> None:
    for refusal, when in list(told.items()):
        if now - when < _FORGET:
            return  # the others were told later
        del told[refusal]
