"""Result of acquiring a lock whose last holder died."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self, cast

if TYPE_CHECKING:
    # No class can inherit from bool, and `acquire` returns a bool to those who do not care.
    _Bool = bool
else:
    _Bool = int


class Abandoned(_Bool):  # type: ignore[misc]  # bool is final
    """The result of an ``acquire`` that got what another process held when it ended.

    It is true and equal to True, so nobody has to know of it.  What the lock guards may be half
    changed: who cares tells it by ``isinstance(lock.acquire(), Abandoned)``.
    """

    holder: str
    """The process that ended."""

    def __new__(cls, holder: str) -> Self:
        self: Any = super().__new__(cls, 1)
        self.holder = holder
        return cast(Self, self)

    def __repr__(self) -> str:
        return f"Abandoned(holder={self.holder!r})"

    def __reduce__(self) -> tuple[type[Self], tuple[str]]:
        return type(self), (self.holder,)
