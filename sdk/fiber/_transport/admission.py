"""How many may stand between the door and the proof of who they are.

A stranger must cost neither descriptors nor anybody's time.  So there is a bound on all, and one on
those from one address.  Where it is reached, a newcomer takes the place of the one who has been
there longest, from the same address or else from the address with the most; but not before that one
has had a fair chance.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import NamedTuple

_FAIR_CHANCE = 1.0
"""Seconds that nobody is sent away for a newcomer; a handshake takes some hundredths of one."""


class Verdict(NamedTuple):
    """Whether a newcomer comes in, and who has to leave for it."""

    admitted: bool
    leaves: Hashable | None = None


class Admission:
    """Who is there, from where and since when.  Pure: the caller tells the time."""

    def __init__(self, total: int, per_address: int) -> None:
        self._total = total
        self._per_address = per_address
        self._waiting: dict[str, dict[Hashable, float]] = {}
        self._addresses: dict[Hashable, str] = {}

    def __len__(self) -> int:
        return len(self._addresses)

    def enter(self, newcomer: Hashable, address: str, now: float) -> Verdict:
        """``newcomer`` asks to come in."""
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
        """That one has proved itself, or is gone."""
        address = self._addresses.pop(one, None)
        if address is not None:
            crowd = self._waiting[address]
            del crowd[one]
            if not crowd:
                del self._waiting[address]

    def _crowd(self, address: str) -> dict[Hashable, float] | None:
        """Those of whom one has to make room, if there is none."""
        own = self._waiting.get(address, {})
        if len(own) >= self._per_address:
            return own
        if len(self) >= self._total:
            return max(self._waiting.values(), key=lambda crowd: (len(crowd), -_oldest(crowd)))
        return None


def _oldest(crowd: dict[Hashable, float]) -> float:
    return next(iter(crowd.values()))
