"""multiprocessing's manager classes by name; Fiber runs no manager yet.

Programs may import, subclass and register as they do there; whoever makes a manager is refused.
The classes of proxies, of which nothing makes one here, are multiprocessing's.
"""

from __future__ import annotations

from collections.abc import Callable
from multiprocessing import managers as mp_managers
from multiprocessing.managers import (
    BaseProxy,
    DictProxy,
    ListProxy,
    Namespace,
    RemoteError,
    Token,
    ValueProxy,
)
from typing import Any

from fiber._hub.unsupported import refuse, unsupported

__all__ = [
    "AcquirerProxy",
    "ArrayProxy",
    "AutoProxy",
    "BarrierProxy",
    "BaseManager",
    "BaseProxy",
    "ConditionProxy",
    "DictProxy",
    "EventProxy",
    "IteratorProxy",
    "ListProxy",
    "MakeProxyType",
    "Manager",
    "Namespace",
    "NamespaceProxy",
    "PoolProxy",
    "RemoteError",
    "SharedMemoryManager",
    "SyncManager",
    "Token",
    "ValueProxy",
]

Manager = unsupported("Manager")

_untyped: Any = mp_managers  # typeshed has part of it
AcquirerProxy = _untyped.AcquirerProxy
ArrayProxy = _untyped.ArrayProxy
AutoProxy = _untyped.AutoProxy
BarrierProxy = _untyped.BarrierProxy
ConditionProxy = _untyped.ConditionProxy
EventProxy = _untyped.EventProxy
IteratorProxy = _untyped.IteratorProxy
MakeProxyType = _untyped.MakeProxyType
NamespaceProxy = _untyped.NamespaceProxy
PoolProxy = _untyped.PoolProxy


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
