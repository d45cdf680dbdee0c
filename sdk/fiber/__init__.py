"""Python's multiprocessing, whose processes can run under agents on other machines.

``import fiber as mp``: the names, signatures and semantics are multiprocessing's.  Importing has no
effect; the first process, pool, pipe or queue starts what it needs.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import TYPE_CHECKING

__version__ = "0.1.0.dev0"

__all__ = [
    "SUBDEBUG",
    "SUBWARNING",
    "AdoptionError",
    "AgentLost",
    "Array",
    "AuthenticationError",
    "Barrier",
    "BaseManager",
    "BoundedSemaphore",
    "BufferTooShort",
    "Condition",
    "Config",
    "ConfigError",
    "ConnectionClosed",
    "Event",
    "Executor",
    "FiberError",
    "FiberPoolError",
    "FileTooLarge",
    "JoinableQueue",
    "LinkError",
    "Lock",
    "Manager",
    "MemberLost",
    "Pipe",
    "Pool",
    "Process",
    "ProcessError",
    "ProgramTooLarge",
    "Queue",
    "RLock",
    "RawArray",
    "RawValue",
    "Ring",
    "Semaphore",
    "SimpleQueue",
    "StartError",
    "Summary",
    "TimeoutError",
    "TooManyOpenFiles",
    "UnpicklableError",
    "Value",
    "VersionMismatch",
    "WorkerDied",
    "active_children",
    "adopt",
    "allow_connection_pickling",
    "cpu_count",
    "current_process",
    "freeze_support",
    "get_all_start_methods",
    "get_context",
    "get_logger",
    "get_start_method",
    "init",
    "log_to_stderr",
    "meta",
    "parent_process",
    "reducer",
    "set_executable",
    "set_forkserver_preload",
    "set_start_method",
    "summary",
    "timeline",
]

if TYPE_CHECKING:
    from fiber import adoption as adoption
    from fiber import config as config
    from fiber import connection as connection
    from fiber import context as context
    from fiber import cpu as cpu
    from fiber import dummy as dummy
    from fiber import errors as errors
    from fiber import futures as futures
    from fiber import managers as managers
    from fiber import pool as pool
    from fiber import process as process
    from fiber import profiling as profiling
    from fiber import queues as queues
    from fiber import reduction as reducer
    from fiber import reduction as reduction
    from fiber import resource_tracker as resource_tracker
    from fiber import resources as resources
    from fiber import results as results
    from fiber import ring as ring
    from fiber import shared_memory as shared_memory
    from fiber import sharedctypes as sharedctypes
    from fiber import shipping as shipping
    from fiber import spawn as spawn
    from fiber import synchronize as synchronize
    from fiber import util as util
    from fiber import vector as vector
    from fiber.adoption import adopt
    from fiber.config import Config, init
    from fiber.errors import (
        AdoptionError,
        AgentLost,
        AuthenticationError,
        BufferTooShort,
        ConfigError,
        ConnectionClosed,
        FiberError,
        FiberPoolError,
        FileTooLarge,
        LinkError,
        MemberLost,
        ProcessError,
        ProgramTooLarge,
        StartError,
        TimeoutError,
        TooManyOpenFiles,
        UnpicklableError,
        VersionMismatch,
        WorkerDied,
    )
    from fiber.futures import Executor
    from fiber.managers import BaseManager
    from fiber.process import Process, active_children, current_process, parent_process
    from fiber.profiling import Summary, summary, timeline
    from fiber.queues import JoinableQueue, Queue, SimpleQueue
    from fiber.resources import meta
    from fiber.ring import Ring
    from fiber.util import SUBDEBUG, SUBWARNING

    Array = context.default.Array
    Barrier = context.default.Barrier
    BoundedSemaphore = context.default.BoundedSemaphore
    Condition = context.default.Condition
    Event = context.default.Event
    Lock = context.default.Lock
    Manager = context.default.Manager
    Pipe = context.default.Pipe
    Pool = context.default.Pool
    RLock = context.default.RLock
    RawArray = context.default.RawArray
    RawValue = context.default.RawValue
    Semaphore = context.default.Semaphore
    Value = context.default.Value
    allow_connection_pickling = context.default.allow_connection_pickling
    cpu_count = context.default.cpu_count
    freeze_support = context.default.freeze_support
    get_all_start_methods = context.default.get_all_start_methods
    get_context = context.default.get_context
    get_logger = context.default.get_logger
    get_start_method = context.default.get_start_method
    log_to_stderr = context.default.log_to_stderr
    set_executable = context.default.set_executable
    set_forkserver_preload = context.default.set_forkserver_preload
    set_start_method = context.default.set_start_method

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
        "profiling",
        "queues",
        "reduction",
        "resource_tracker",
        "resources",
        "results",
        "ring",
        "shared_memory",
        "sharedctypes",
        "shipping",
        "spawn",
        "synchronize",
        "util",
        "vector",
    }
)

_OTHER_FILES = frozenset({"agent", "joblib", "launcher"})

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
    "Summary": "profiling",
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
    "summary": "profiling",
    "timeline": "profiling",
}


if not TYPE_CHECKING:  # a type checker would accept any name

    def __getattr__(name: str) -> object:
        """Look up a name at its first use, so that ``import fiber`` is fast."""
        _tell_where_it_started()
        if name in _HOMES:
            value = getattr(importlib.import_module(f"fiber.{_HOMES[name]}"), name)
        elif name in __all__:
            value = getattr(importlib.import_module("fiber.context").default, name)
        elif name in _SUBMODULES:
            return importlib.import_module(f"fiber.{name}")
        else:
            raise AttributeError(f"module 'fiber' has no attribute {name!r}")
        globals()[name] = value
        return value


def _working_directory() -> str | None:
    try:
        return os.getcwd()
    except OSError:  # it was removed
        return None


_started_in = None if "multiprocessing.process" in sys.modules else _working_directory()
"""Directory in which the program imported Fiber."""


def _tell_where_it_started() -> None:
    """Tell multiprocessing the directory in which the program imported Fiber.

    multiprocessing is imported later, when the program may have changed its directory.  Relative
    paths of modules and of the main file are relative to this one.
    """
    global _started_in
    if _started_in is not None:
        from multiprocessing import process

        process.ORIGINAL_DIR, _started_in = _started_in, None  # type: ignore[attr-defined]


def __dir__() -> list[str]:
    return sorted({*__all__, *_SUBMODULES, "__version__"})


def _find_foreign_files() -> None:
    """Warn if another distribution has installed modules in this package."""
    try:
        names = os.listdir(__path__[0])
    except OSError:  # an archive
        return
    modules = {name[:-3] for name in names if name.endswith(".py") and not name.startswith("_")}
    if foreign := modules - _SUBMODULES - _OTHER_FILES:
        from fiber import _installation

        _installation.warn_of_foreign_files(__path__[0], [f"{name}.py" for name in foreign])


_find_foreign_files()
