"""What multiprocessing has and Fiber has not yet: said once, in the same words everywhere."""

from __future__ import annotations

from typing import NoReturn

from fiber.errors import NotInFiber

_INSTEAD = {
    "SharedMemoryManager": "make a SharedMemory and unlink it",
}


def refuse(name: str) -> NoReturn:
    """Raise the error for ``name``."""
    raise NotInFiber(f"Fiber has no {name} yet. Please {_INSTEAD[name]}.")
