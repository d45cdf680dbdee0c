"""What multiprocessing has and Fiber has not yet: said once, in the same words everywhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn

from fiber.errors import NotInFiber

_INSTEAD = {
    "Condition": "use an Event, or a Queue that carries what is waited for",
    "Barrier": "use a Semaphore for arrivals and an Event for the release",
}


def refuse(name: str) -> NoReturn:
    """Raise the error for ``name``."""
    raise NotInFiber(f"Fiber has no {name} yet. Please {_INSTEAD[name]}.")


def unsupported(name: str) -> Callable[..., Any]:
    """A function that stands where multiprocessing has a function ``name``, and refuses."""

    def stand_in(*_args: Any, **_options: Any) -> NoReturn:
        refuse(name)

    stand_in.__name__ = stand_in.__qualname__ = name
    stand_in.__doc__ = f"Not there yet: {_INSTEAD[name]}."
    return stand_in


class Unsupported:
    """Base of the classes that stand where multiprocessing has one, for annotations and
    ``isinstance``: whoever makes an object is refused.
    """

    _name: str

    def __init_subclass__(cls) -> None:
        if cls.__name__ in _INSTEAD:  # not a user's subclass of one of them
            cls._name = cls.__name__
            cls.__doc__ = f"Not there yet: {_INSTEAD[cls._name]}."

    def __init__(self, *_args: Any, **_options: Any) -> None:
        refuse(self._name)
