"""What who acquires a lock is told when the one before died with it."""

from __future__ import annotations

from typing import Self


class Abandoned(int):
    """The result of an ``acquire`` that got what another process held when it ended.

    It is true and equal to True, so nobody has to know of it.  What the lock guards may be half
    changed: who cares tells it by ``isinstance(lock.acquire(), Abandoned)``.
    """

    holder: str
    """The process that ended."""

    def __new__(cls, holder: str) -> Self:
        self = super().__new__(cls, 1)
        self.holder = holder
        return self

    def __repr__(self) -> str:
        return f"Abandoned(holder={self.holder!r})"

    def __reduce__(self) -> tuple[type[Self], tuple[str]]:
        return type(self), (self.holder,)
