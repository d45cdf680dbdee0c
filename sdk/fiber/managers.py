"""multiprocessing's manager classes by name; Fiber runs no manager yet.

Programs may import, subclass and register as they do there; whoever makes a manager is refused.
"""

from __future__ import annotations

from collections.abc import Callable
from multiprocessing.managers import BaseProxy, RemoteError, Token
from typing import Any

from fiber._hub.absent import absent, refuse

__all__ = [
    "BaseManager",
    "BaseProxy",
    "Manager",
    "RemoteError",
    "SharedMemoryManager",
    "SyncManager",
    "Token",
]

Manager = absent("Manager")


class BaseManager:
    """The name to subclass; making one raises an error that says what to use."""

    def __init__(self, *_args: Any, **_options: Any) -> None:
        refuse("Manager")

    @classmethod
    def register(
        cls, typeid: str, callable: Callable[..., Any] | None = None, **_options: Any
    ) -> None:
        """Accepted, so that modules which define managers can be imported."""


class SyncManager(BaseManager):
    """As ``BaseManager``."""


class SharedMemoryManager(BaseManager):
    """As ``BaseManager``."""
