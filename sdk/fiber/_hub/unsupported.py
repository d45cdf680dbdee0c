"""What multiprocessing has and Fiber has not yet: said once, in the same words everywhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn

from fiber.errors import NotInFiber

_INSTEAD = {
    "Lock": "use Semaphore(1)",
    "RLock": "use Semaphore(1), acquired once by each holder",
    "Condition": "use an Event, or a Queue that carries what is waited for",
    "Barrier": "use a Semaphore for arrivals and an Event for the release",
    "Value": "send the value through a Pipe or Queue",
    "Array": "send the array through a Pipe or Queue; NumPy arrays are not copied into the pickle",
    "RawValue": "send the value through a Pipe or Queue",
    "RawArray": "send the array through a Pipe or Queue",
    "copy": "send the object through a Pipe or Queue",
    "synchronized": "send the object through a Pipe or Queue",
    "SharedMemory": "send the buffer through a Pipe or Queue",
    "ShareableList": "send the list through a Pipe or Queue",
}


def refuse(name: str) -> NoReturn:
    """Raise the error for ``name``."""
    raise NotInFiber(
        f"Fiber has no {name} yet: it shares no memory and no locks. Please {_INSTEAD[name]}."
    )


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
