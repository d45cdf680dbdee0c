"""Python's multiprocessing, whose processes can run under agents on other machines.

``import fiber as mp``: the names, signatures and semantics are multiprocessing's.  Importing has no
effect; the first process, pool, pipe or queue starts what it needs.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0.dev0"

if TYPE_CHECKING:
    from fiber.adoption import adopt as adopt
    from fiber.config import Config as Config
    from fiber.config import init as init
    from fiber.errors import AdoptionError as AdoptionError
    from fiber.errors import AgentLost as AgentLost
    from fiber.errors import AuthenticationError as AuthenticationError
    from fiber.errors import BufferTooShort as BufferTooShort
    from fiber.errors import ConfigError as ConfigError
    from fiber.errors import ConnectionClosed as ConnectionClosed
    from fiber.errors import FiberError as FiberError
    from fiber.errors import FiberPoolError as FiberPoolError
    from fiber.errors import FileTooLarge as FileTooLarge
    from fiber.errors import LinkError as LinkError
    from fiber.errors import MemberLost as MemberLost
    from fiber.errors import ProcessError as ProcessError
    from fiber.errors import ProgramTooLarge as ProgramTooLarge
    from fiber.errors import StartError as StartError
    from fiber.errors import TimeoutError as TimeoutError
    from fiber.errors import TooManyOpenFiles as TooManyOpenFiles
    from fiber.errors import UnpicklableError as UnpicklableError
    from fiber.errors import VersionMismatch as VersionMismatch
    from fiber.errors import WorkerDied as WorkerDied
    from fiber.futures import Executor as Executor
    from fiber.managers import BaseManager as BaseManager
    from fiber.process import Process as Process
    from fiber.process import active_children as active_children
    from fiber.process import current_process as current_process
    from fiber.process import parent_process as parent_process
    from fiber.resources import meta as meta
    from fiber.ring import Ring as Ring
    from fiber.util import SUBDEBUG as SUBDEBUG
    from fiber.util import SUBWARNING as SUBWARNING

_SUBMODULES = frozenset(
    {
        "adoption",
        "config",
        "connection",
        "context",
        "cpu",
        "dummy",
        "errors",
        "futures",
        "managers",
        "pool",
        "process",
        "queues",
        "reduction",
        "resource_tracker",
        "resources",
        "results",
        "ring",
        "shared_memory",
        "sharedctypes",
        "spawn",
        "synchronize",
        "util",
        "vector",
    }
)

_METHODS_OF_THE_DEFAULT_CONTEXT = frozenset(
    {
        "Array",
        "Barrier",
        "BoundedSemaphore",
        "Condition",
        "Event",
        "JoinableQueue",
        "Lock",
        "Manager",
        "Pipe",
        "Pool",
        "Queue",
        "RLock",
        "RawArray",
        "RawValue",
        "Semaphore",
        "SimpleQueue",
        "Value",
        "allow_connection_pickling",
        "cpu_count",
        "freeze_support",
        "get_all_start_methods",
        "get_context",
        "get_logger",
        "get_start_method",
        "log_to_stderr",
        "reducer",
        "set_executable",
        "set_forkserver_preload",
        "set_start_method",
    }
)

_HOMES = {
    "AdoptionError": "errors",
    "AgentLost": "errors",
    "AuthenticationError": "errors",
    "BaseManager": "managers",
    "BufferTooShort": "errors",
    "Config": "config",
    "ConfigError": "errors",
    "ConnectionClosed": "errors",
    "Executor": "futures",
    "FiberError": "errors",
    "FiberPoolError": "errors",
    "FileTooLarge": "errors",
    "LinkError": "errors",
    "MemberLost": "errors",
    "Process": "process",
    "ProcessError": "errors",
    "ProgramTooLarge": "errors",
    "Ring": "ring",
    "SUBDEBUG": "util",
    "SUBWARNING": "util",
    "StartError": "errors",
    "TimeoutError": "errors",
    "TooManyOpenFiles": "errors",
    "UnpicklableError": "errors",
    "VersionMismatch": "errors",
    "WorkerDied": "errors",
    "active_children": "process",
    "adopt": "adoption",
    "current_process": "process",
    "init": "config",
    "meta": "resources",
    "parent_process": "process",
}

__all__ = sorted([*_METHODS_OF_THE_DEFAULT_CONTEXT, *_HOMES])  # noqa: PLE0605 - computed once


def __getattr__(name: str) -> Any:
    """Names are looked up when first used, so that importing Fiber costs nothing."""
    if name in _METHODS_OF_THE_DEFAULT_CONTEXT:
        value = getattr(importlib.import_module("fiber.context").default, name)
    elif name in _HOMES:
        value = getattr(importlib.import_module(f"fiber.{_HOMES[name]}"), name)
    elif name in _SUBMODULES:
        return importlib.import_module(f"fiber.{name}")
    else:
        raise AttributeError(f"module 'fiber' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, *_SUBMODULES, "__version__"})
