"""Resources of the workers of a pool, where hosts are made for them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fiber.resources import Resources, merged, resources_of


class WorkerResources:
    """Decided by the first task: its function's wishes, added to the pool's own.

    No lock: of several threads whose tasks are the first, one decides.
    """

    def __init__(self, own: Resources) -> None:
        self._own = own
        self._chosen: dict[str, Resources] = {}

    @property
    def chosen(self) -> Resources:
        """Resources that workers get.  The first use settles them."""
        return self._chosen.setdefault("resources", self._own)

    def choose_for(self, function: Callable[..., Any]) -> None:
        """Let the workers suit ``function``; ValueError if they are of another kind already."""
        wishes = resources_of(function)
        wanted = merged(self._own, wishes)
        chosen = self._chosen.setdefault("resources", wanted)
        if wishes != Resources() and merged(chosen, wishes) != chosen:
            raise ValueError(
                f"this pool's workers have {chosen}, and {function!r} wants {wanted}: all workers "
                "of a pool have what its first task wished. Make another pool for this function."
            )
