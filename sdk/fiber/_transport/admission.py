"""Limits on connections that have not proved themselves yet.

Strangers must not use up the descriptors of the program, nor keep its agents waiting.  So one limit
holds for all pending connections, and one for those from one address.  At a limit, a newcomer
replaces the oldest connection: from the same address, or else from the address with the most
connections.  A connection is not replaced before it has had a fair chance.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import NamedTuple

_FAIR_CHANCE = 1.0
"""Seconds for which a newcomer replaces no connection; a handshake takes some hundredths of one."""


class Verdict(NamedTuple):
    """Decision about a newcomer, and the connection that it replaces, if any."""

    admitted: bool
    leaves: Hashable | None = None


class Admission:
    """Table of pending connections by address and age.  Pure: the caller passes the time."""

    def __init__(self, total: int, per_address: int) -> None:
        self._total = total
        self._per_address = per_address
        self._waiting: dict[str, dict[Hashable, float]] = {}
        self._addresses: dict[Hashable, str] = {}

    def __len__(self) -> int:
        return len(self._addresses)

    def enter(self, newcomer: Hashable, address: str, now: float) -> Verdict:
        """Decide whether ``newcomer`` is admitted."""
        crowd = self._crowd(address)
        leaves = None
        if crowd:
            leaves, since = next(iter(crowd.items()))
            if now - since < _FAIR_CHANCE:
                return Verdict(False)
            self.leave(leaves)
        self._waiting.setdefault(address, {})[newcomer] = now
        self._addresses[newcomer] = address
        return Verdict(True, leaves)

    def leave(self, one: Hashable) -> None:
        """Remove a connection that has proved itself, or has ended."""
        address = self._addresses.pop(one, None)
        if address is not None:
            crowd = self._waiting[address]
            del crowd[one]
            if not crowd:
                del self._waiting[address]

    def _crowd(self, address: str) -> dict[Hashable, float] | None:
        """Return the connections of which one must leave for a newcomer; None if there is room."""
        own = self._waiting.get(address, {})
        if len(own) >= self._per_address:
            return own
        if len(self) >= self._total:
            return max(self._waiting.values(), key=lambda crowd: (len(crowd), -_oldest(crowd)))
        return None


def _oldest(crowd: dict[Hashable, float]) -> float:
    return next(iter(crowd.values()))
