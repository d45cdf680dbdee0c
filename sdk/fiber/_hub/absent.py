"""What multiprocessing has and Fiber has not yet: said once, in the same words everywhere."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NoReturn

from fiber.errors import FiberError


class NotInFiber(FiberError, NotImplementedError):
    """A part of multiprocessing that this version of Fiber does not have; names what to use."""


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
    "Manager": "keep the object in one process and talk to it through a Pipe or Queue",
}


def refuse(name: str, instead: str = "") -> NoReturn:
    """Raise the error for ``name``."""
    advice = instead or _INSTEAD[name]
    raise NotInFiber(f"Fiber has no {name} yet: it shares no memory and no locks. Please {advice}.")


def absent(name: str) -> Callable[..., Any]:
    """A function that stands where multiprocessing has ``name``, and refuses."""

    def stand_in(*_args: Any, **_options: Any) -> NoReturn:
        refuse(name)

    stand_in.__name__ = stand_in.__qualname__ = name
    stand_in.__doc__ = f"Not there yet: {_INSTEAD[name]}."
    return stand_in
