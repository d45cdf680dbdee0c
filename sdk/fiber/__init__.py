"""Python's multiprocessing whose processes are pods.

``import fiber as mp``: the names, signatures and semantics are multiprocessing's.  Importing has no
effect; the first process, pool, pipe or queue starts what it needs.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from multiprocessing.process import active_children, current_process, parent_process

    from fiber.adoption import adopt
    from fiber.config import Config, init
    from fiber.context import (
        AuthenticationError,
        BufferTooShort,
        ProcessError,
        TimeoutError,
    )
    from fiber.errors import FiberError, StartError, WorkerDied
    from fiber.process import Process
    from fiber.resources import meta

_SUBMODULES = frozenset(
    "connection context errors managers pool process queues reduction results sharedctypes synchronize "
    "util".split()
)

_FROM_DEFAULT_CONTEXT = frozenset(
    "AuthenticationError BoundedSemaphore BufferTooShort Event JoinableQueue Pipe Pool ProcessError Queue "
    "Semaphore SimpleQueue TimeoutError active_children allow_connection_pickling cpu_count "
    "current_process freeze_support get_all_start_methods get_context get_logger get_start_method "
    "log_to_stderr parent_process reducer set_executable set_forkserver_preload set_start_method".split()
)

_FROM = {
    "Process": "process",
    "Config": "config",
    "init": "config",
    "adopt": "adoption",
    "meta": "resources",
    "ConfigError": "errors",
    "FiberError": "errors",
    "StartError": "errors",
    "WorkerDied": "errors",
}

__all__ = sorted([*_FROM_DEFAULT_CONTEXT, *_FROM])  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    """Names are looked up when first used, so that importing Fiber costs nothing."""
    if name in _FROM_DEFAULT_CONTEXT:
        value = getattr(importlib.import_module("fiber.context").default, name)
    elif name in _FROM:
        value = getattr(importlib.import_module(f"fiber.{_FROM[name]}"), name)
    elif name in _SUBMODULES:
        return importlib.import_module(f"fiber.{name}")
    else:
        raise AttributeError(f"module 'fiber' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_SUBMODULES})
