"""Contexts: all of multiprocessing's functions, for one start method.

``fiber`` itself exposes the methods of the default context, as multiprocessing does.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from multiprocessing import process as _mp_process
from multiprocessing import spawn, util
from multiprocessing.context import (
    AuthenticationError,
    BufferTooShort,
    ProcessError,
    TimeoutError,
    assert_spawning,
    get_spawning_popen,
    set_spawning_popen,
)
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar, overload

from fiber import config, cpu
from fiber import process as _process
from fiber._runtime import start_methods
from fiber.process import ForkProcess, ForkServerProcess, Process, SpawnProcess

if TYPE_CHECKING:
    import ctypes
    import logging
    from _ctypes import _CData
    from ctypes import _SimpleCData, c_char
    from types import ModuleType

    from fiber.connection import Connection
    from fiber.managers import SyncManager
    from fiber.pool import Pool
    from fiber.queues import JoinableQueue, Queue, SimpleQueue
    from fiber.sharedctypes import (
        Locked,
        Size,
        Synchronized,
        SynchronizedArray,
        SynchronizedBase,
        SynchronizedString,
    )
    from fiber.synchronize import (
        Barrier,
        BoundedSemaphore,
        Condition,
        Event,
        Lock,
        LockLike,
        RLock,
        Semaphore,
    )

    _CT = TypeVar("_CT", bound=_CData)
_T = TypeVar("_T")

__all__ = [
    "BaseContext",
    "DefaultContext",
    "ForkContext",
    "ForkProcess",
    "ForkServerContext",
    "ForkServerProcess",
    "SpawnContext",
    "SpawnProcess",
    "assert_spawning",
    "get_spawning_popen",
    "set_spawning_popen",
]


class BaseContext:
    """multiprocessing's functions and classes for one start method."""

    ProcessError = ProcessError
    BufferTooShort = BufferTooShort
    TimeoutError = TimeoutError
    AuthenticationError = AuthenticationError
    Process: ClassVar[type[_process.Process]] = Process

    current_process = staticmethod(_mp_process.current_process)
    parent_process = staticmethod(_mp_process.parent_process)
    active_children = staticmethod(_mp_process.active_children)

    def __init__(self, method: str | None = None) -> None:
        self._method = method

    def __repr__(self) -> str:  # part of that of fiber.Pool, a bound method
        return f"fiber.get_context({self._method!r})" if self._method else "fiber"

    def cpu_count(self) -> int:
        """Return the number of processors that its affinity and its cgroup's quota allow."""
        return cpu.cpu_count()

    # Communication

    def Pipe(self, duplex: bool = True) -> tuple[Connection[Any, Any], Connection[Any, Any]]:
        """Return two connected ends of a pipe."""
        from fiber.connection import Pipe

        config.use()
        return Pipe(duplex)

    def Queue(self, maxsize: int = 0) -> Queue[Any]:
        """Return a queue for any number of processes."""
        from fiber.queues import Queue

        config.use()
        return Queue(maxsize)

    def JoinableQueue(self, maxsize: int = 0) -> JoinableQueue[Any]:
        """Return a queue with ``task_done`` and ``join``."""
        from fiber.queues import JoinableQueue

        config.use()
        return JoinableQueue(maxsize)

    def SimpleQueue(self) -> SimpleQueue[Any]:
        """Return a queue without a feeder thread."""
        from fiber.queues import SimpleQueue

        config.use()
        return SimpleQueue()

    # Synchronization

    def Lock(self) -> Lock:
        """Return a mutex."""
        from fiber.synchronize import Lock

        config.use()
        return Lock()

    def RLock(self) -> RLock:
        """Return a mutex that its holder may acquire again."""
        from fiber.synchronize import RLock

        config.use()
        return RLock()

    def Event(self) -> Event:
        """Return a flag to wait for."""
        from fiber.synchronize import Event

        config.use()
        return Event()

    def Condition(self, lock: LockLike | None = None) -> Condition:
        """Return a condition: a lock whose holders may wait and notify."""
        from fiber.synchronize import Condition

        config.use()
        return Condition(lock)

    def Barrier(
        self,
        parties: int,
        action: Callable[[], object] | None = None,
        timeout: float | None = None,
    ) -> Barrier:
        """Return a barrier, at which threads of any process wait for each other."""
        from fiber.synchronize import Barrier

        config.use()
        return Barrier(parties, action, timeout)

    def Semaphore(self, value: int = 1) -> Semaphore:
        """Return a semaphore."""
        from fiber.synchronize import Semaphore

        config.use()
        return Semaphore(value)

    def BoundedSemaphore(self, value: int = 1) -> BoundedSemaphore:
        """Return a semaphore that cannot be released more often than it was acquired."""
        from fiber.synchronize import BoundedSemaphore

        config.use()
        return BoundedSemaphore(value)

    # Shared memory

    @overload
    def Value(
        self, typecode_or_type: type[_SimpleCData[_T]], *args: Any, lock: Locked = True
    ) -> Synchronized[_T]: ...

    @overload
    def Value(self, typecode_or_type: type[_CT], *args: Any, lock: Literal[False]) -> _CT: ...

    @overload
    def Value(
        self, typecode_or_type: type[_CT], *args: Any, lock: Locked = True
    ) -> SynchronizedBase[_CT]: ...

    @overload
    def Value(
        self, typecode_or_type: str, *args: Any, lock: Locked = True
    ) -> Synchronized[Any]: ...

    @overload
    def Value(
        self, typecode_or_type: str | type[_CData], *args: Any, lock: Locked | bool = True
    ) -> Any: ...

    def Value(self, typecode_or_type: Any, *args: Any, lock: Any = True) -> Any:
        """Return a ctypes object in shared memory, with a lock."""
        from fiber.sharedctypes import Value

        config.use()
        return Value(typecode_or_type, *args, lock=lock)

    @overload
    def Array(
        self, typecode_or_type: type[_CT], size_or_initializer: Size, *, lock: Literal[False]
    ) -> ctypes.Array[_CT]: ...

    @overload
    def Array(
        self, typecode_or_type: type[c_char], size_or_initializer: Size, *, lock: Locked = True
    ) -> SynchronizedString: ...

    @overload
    def Array(
        self,
        typecode_or_type: type[_SimpleCData[_T]],
        size_or_initializer: Size,
        *,
        lock: Locked = True,
    ) -> SynchronizedArray[_T]: ...

    @overload
    def Array(
        self, typecode_or_type: str, size_or_initializer: Size, *, lock: Locked = True
    ) -> SynchronizedArray[Any]: ...

    @overload
    def Array(
        self,
        typecode_or_type: str | type[_CData],
        size_or_initializer: Size,
        *,
        lock: Locked | bool = True,
    ) -> Any: ...

    def Array(self, typecode_or_type: Any, size_or_initializer: Size, *, lock: Any = True) -> Any:
        """Return a ctypes array in shared memory, with a lock."""
        from fiber.sharedctypes import Array

        config.use()
        return Array(typecode_or_type, size_or_initializer, lock=lock)

    @overload
    def RawValue(self, typecode_or_type: type[_CT], *args: Any) -> _CT: ...

    @overload
    def RawValue(self, typecode_or_type: str, *args: Any) -> Any: ...

    def RawValue(self, typecode_or_type: Any, *args: Any) -> Any:
        """Return a ctypes object in shared memory."""
        from fiber.sharedctypes import RawValue

        config.use()
        return RawValue(typecode_or_type, *args)

    @overload
    def RawArray(
        self, typecode_or_type: type[_CT], size_or_initializer: Size
    ) -> ctypes.Array[_CT]: ...

    @overload
    def RawArray(self, typecode_or_type: str, size_or_initializer: Size) -> Any: ...

    def RawArray(self, typecode_or_type: Any, size_or_initializer: Size) -> Any:
        """Return a ctypes array in shared memory."""
        from fiber.sharedctypes import RawArray

        config.use()
        return RawArray(typecode_or_type, size_or_initializer)

    # Managers

    def Manager(self) -> SyncManager:
        """Return a started manager that serves all types of multiprocessing's."""
        from fiber.managers import SyncManager

        manager = SyncManager(ctx=self.get_context())
        manager.start()
        return manager

    # Work

    def Pool(
        self,
        processes: int | None = None,
        initializer: Callable[..., object] | None = None,
        initargs: Iterable[Any] = (),
        maxtasksperchild: int | None = None,
        *,
        min_workers: int | None = None,
        max_workers: int | None = None,
        retries: int | None = None,
        disruptions: int | None = None,
        retry_exceptions: type[BaseException] | Sequence[type[BaseException]] = (),
        error_handling: bool = False,
        task_timeout: float | None = None,
        idle_timeout: float | None = 60.0,
        pool: str | None = None,
    ) -> Pool:
        """Return a pool of workers; ``fiber.pool.Pool`` documents the options."""
        start_methods.start_zygote()
        from fiber.pool import Pool

        return Pool(
            processes,
            initializer,
            initargs,
            maxtasksperchild,
            context=self.get_context(),
            min_workers=min_workers,
            max_workers=max_workers,
            retries=retries,
            disruptions=disruptions,
            retry_exceptions=retry_exceptions,
            error_handling=error_handling,
            task_timeout=task_timeout,
            idle_timeout=idle_timeout,
            pool=pool,
        )

    # Settings

    @overload
    def get_context(self, method: None = None) -> DefaultContext: ...

    @overload
    def get_context(self, method: Literal["spawn"]) -> SpawnContext: ...

    @overload
    def get_context(self, method: Literal["fork"]) -> ForkContext: ...

    @overload
    def get_context(self, method: Literal["forkserver"]) -> ForkServerContext: ...

    @overload
    def get_context(self, method: str | None) -> BaseContext: ...

    def get_context(self, method: str | None = None) -> BaseContext:
        """Return the context of a start method.

        Without ``method`` return this context.  ``fiber`` itself returns that of the method in
        force.
        """
        if method is None:
            return self._in_force()
        if method not in _contexts:
            raise ValueError(f"cannot find context for {method!r}")
        return _contexts[method]

    def _in_force(self) -> BaseContext:
        return self

    @overload
    def get_start_method(self, allow_none: Literal[False] = False) -> str: ...

    @overload
    def get_start_method(self, allow_none: bool) -> str | None: ...

    def get_start_method(self, allow_none: bool = False) -> str | None:
        """Return the start method; with ``allow_none`` None if none was set or used."""
        return self._start_method(allow_none)

    def _start_method(self, allow_none: bool) -> str | None:
        return self._method

    def set_start_method(self, method: str | None, force: bool = False) -> None:
        """Refuse: only the default context's start method can be set."""
        raise ValueError("cannot set start method of concrete context")

    def get_all_start_methods(self) -> list[str]:
        """Return the names of the start methods, the default first."""
        return list(start_methods.START_METHODS)

    def set_executable(self, executable: str | bytes | os.PathLike[str]) -> None:
        """Set the interpreter for processes started with ``spawn`` on this host."""
        spawn.set_executable(os.fsdecode(executable))

    def set_forkserver_preload(self, module_names: list[str]) -> None:
        """Set the modules that the zygote imports before it forks.

        Call it before the first start: later calls have no effect.
        """
        if not all(isinstance(name, str) for name in module_names):
            raise TypeError("module_names must be a list of strings")
        start_methods.preload[:] = module_names

    def freeze_support(self) -> None:
        """Do nothing: frozen executables exist on Windows only."""

    def allow_connection_pickling(self) -> None:
        """Do nothing: connections always pickle."""

    def get_logger(self) -> logging.Logger:
        """Return multiprocessing's logger, which Fiber shares."""
        return util.get_logger()

    def log_to_stderr(self, level: int | str | None = None) -> logging.Logger:
        """Show the logger's records on stderr."""
        return util.log_to_stderr(level)

    @property
    def reducer(self) -> ModuleType:
        """Module that pickles objects."""
        from fiber import reduction

        return reduction


class ForkContext(BaseContext):
    """The context of the start method ``fork``."""

    Process: ClassVar[type[ForkProcess]] = ForkProcess

    def __init__(self) -> None:
        super().__init__("fork")


class ForkServerContext(BaseContext):
    """The context of the start method ``forkserver``."""

    Process: ClassVar[type[ForkServerProcess]] = ForkServerProcess

    def __init__(self) -> None:
        super().__init__("forkserver")


class SpawnContext(BaseContext):
    """The context of the start method ``spawn``."""

    Process: ClassVar[type[SpawnProcess]] = SpawnProcess

    def __init__(self) -> None:
        super().__init__("spawn")


class DefaultContext(BaseContext):
    """The context behind ``fiber`` itself: its start method can be set, once."""

    def _in_force(self) -> BaseContext:
        return _contexts[start_methods.chosen or start_methods.START_METHODS[0]]

    def _start_method(self, allow_none: bool) -> str | None:
        return start_methods.chosen if allow_none else start_methods.settle()

    def set_start_method(self, method: str | None, force: bool = False) -> None:
        """Set the start method; RuntimeError if it is set already and not ``force``."""
        if start_methods.chosen is not None and not force:
            raise RuntimeError("context has already been set")
        if method is not None:
            self.get_context(method)
        elif not force:
            raise ValueError("cannot find context for None")
        start_methods.choose(method)


_contexts: dict[str, BaseContext] = {
    "fork": ForkContext(),
    "forkserver": ForkServerContext(),
    "spawn": SpawnContext(),
}
default: DefaultContext = DefaultContext()
