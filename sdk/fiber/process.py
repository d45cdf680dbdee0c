"""``Process``: multiprocessing's class, run by Fiber.

The class is multiprocessing's own BaseProcess underneath, so that ``current_process``,
``active_children``, names, authentication keys and daemon flags are shared with it.
"""

from __future__ import annotations

import os
import weakref
from collections import deque
from collections.abc import Callable
from functools import partial
from multiprocessing import process as _mp
from multiprocessing.process import (
    BaseProcess,
    active_children,
    current_process,
    parent_process,
)
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fiber._runtime.workers import WorkerHandle

__all__ = [
    "BaseProcess",
    "ForkProcess",
    "ForkServerProcess",
    "Process",
    "SpawnProcess",
    "active_children",
    "current_process",
    "parent_process",
]

_ended: deque[weakref.ref[BaseProcess]] = deque()
"""Processes that ended, to be dropped from ``_children`` at the next start.

The loop thread only appends: dropping a process may run the user's finalizers.
"""


class Process(BaseProcess):
    """A process that Fiber starts: a subprocess on a laptop, a child in a pod on a cluster.

    As ``multiprocessing.Process``, with one difference: a daemonic process may have children, which
    end with it.
    """

    _start_method: str | None = None

    def _Popen(self) -> Any:
        from fiber._runtime.start_methods import start_zygote

        start_zygote()
        from fiber._runtime import interrupted_exit
        from fiber._runtime.popen import Popen
        from fiber._runtime.start_methods import zygote_method

        interrupted_exit.prepare()
        return Popen(self, zygote_method(self._start_method), self._on_exit())

    def _on_exit(self) -> Callable[[], None]:
        """Return the function that its ``Popen`` calls once ``returncode`` is set."""
        return partial(_ended.append, weakref.ref(self))

    def start(self) -> None:
        """Start it; return once it has a pid, or waits for a pod."""
        from fiber._runtime.start_methods import check_main

        self._check_closed()  # type: ignore[attr-defined]
        assert self.pid is None, "cannot start a process twice"
        assert self._parent_pid == os.getpid(), (  # type: ignore[attr-defined]
            "can only start a process object created by current process"
        )
        check_main()
        _drop_ended()
        popen: Any = None
        try:
            self._popen = popen = self._Popen()
            self._sentinel = popen.sentinel
            # The child has its arguments.  The parent must not keep them alive.
            del self._target, self._args, self._kwargs  # type: ignore[attr-defined]
            _mp._children.add(self)  # type: ignore[attr-defined]
        except BaseException:
            if popen is not None:
                popen.kill()  # interrupted: the caller has no started process
            raise
        if self._popen.returncode is not None:  # it ended before it was added
            _mp._children.discard(self)  # type: ignore[attr-defined]


def _drop_ended() -> None:
    """Forget ended children.  multiprocessing's ``_cleanup`` polls every child instead."""
    while _ended:
        try:
            process = _ended.popleft()()
        except IndexError:  # another thread was faster
            return
        _mp._children.discard(process)  # type: ignore[attr-defined]


class ForkProcess(Process):
    """A process forked from the zygote."""

    _start_method = "fork"


class ForkServerProcess(Process):
    """A process forked from the zygote."""

    _start_method = "forkserver"


class SpawnProcess(Process):
    """A process in a new interpreter."""

    _start_method = "spawn"


class PoolProcess(Process):
    """The Process object of a pool worker, which ``handle`` starts and watches.

    Its name and start method are those of ``like``, the class of the start method.
    """

    def __init__(self, handle: WorkerHandle, like: type[BaseProcess], **options: Any) -> None:
        super().__init__(**options)
        self._start_method = getattr(like, "_start_method", None)
        role = like.__name__.replace("Process", "PoolWorker")
        self.name = self.name.replace(type(self).__name__, role)
        self.daemon = True
        self._handle: WorkerHandle | None = handle

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_handle": None}

    @property
    def user_parts(self) -> dict[str, Any]:
        """Parts of the worker that the pool's user gave, by the names that messages use."""
        args: tuple[Any, ...] = self._args  # type: ignore[attr-defined]
        if not args:  # they are pickled already, and go beside the process
            return {}
        initializer, initargs, retryable = args
        return {
            "the initializer of the pool": initializer,
            **{f"initargs[{at}] of the pool": value for at, value in enumerate(initargs)},
            "retry_exceptions of the pool": retryable,
        }

    def _Popen(self) -> WorkerHandle:
        from fiber._runtime.start_methods import zygote_method

        assert self._handle is not None
        self._handle.launch(self, zygote_method(self._start_method))
        return self._handle

    @property
    def sentinel(self) -> int:
        """Descriptor that becomes ready when the process ends, as in multiprocessing."""
        self._check_closed()  # type: ignore[attr-defined]
        assert self._handle is not None
        return self._handle.exit_descriptor()


def process_type(method: str) -> type[Process]:
    """Return the class of processes of a start method."""
    types: tuple[type[Process], ...] = (ForkProcess, ForkServerProcess, SpawnProcess)
    return {cls._start_method or "": cls for cls in types}[method]


def _disown() -> None:
    """Forget the children of the parent, in a process that was forked without Fiber."""
    children: set[BaseProcess] = _mp._children  # type: ignore[attr-defined]
    children -= {child for child in children if isinstance(child, Process)}


os.register_at_fork(after_in_child=_disown)
