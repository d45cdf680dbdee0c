"""Imports that a zygote makes once for its children, and the check that forking stays safe.

Only the thread that forks lives on in the child.  If another thread held a lock, or a library needs
its pool of threads, the child then waits for ever.  Some libraries prepare for a fork: the threads
of OpenBLAS end before it and start again when they are needed.  Those of XLA (JAX) and of GNU's
OpenMP do not.  A trial fork tells the two apart: threads that exist after it make forking unsafe.
"""

from __future__ import annotations

import builtins
import contextlib
import gc
import importlib
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from types import ModuleType
from typing import Any, NamedTuple

from fiber._agent import child

_TRIAL_TIMEOUT = 10.0
"""Seconds in which the process of a trial fork must end."""

_SETTLING = 0.1
"""Seconds until a joined thread is gone from /proc."""

_MAIN = "__mp_main__"


class Imports(NamedTuple):
    """Modules to import, and the environment variables for their import."""

    modules: tuple[str, ...]
    environ: dict[bytes, bytes]


class Unfit(NamedTuple):
    """Reason why a zygote must not be forked."""

    reason: str
    """Text for the user; empty if importing the main module fails, which each child reports."""
    safe: Imports
    """Imports for the next zygote: those of the program before the one that starts threads."""


def preload(data: dict[str, Any], only: Imports | None) -> Unfit | None:
    """Import ``only``, or the modules in ``data`` and the main module.

    Return None if forking is safe after that.
    """
    if only is not None:
        os.environb.clear()
        os.environb.update(only.environ)
    child.prepare_paths(data)
    preloader = _Preloader()
    for name in data.get("preload", ()) if only is None else only.modules:
        preloader.load(name)
    if only is None:
        preloader.load_main(data)
    gc.collect()
    gc.freeze()
    return preloader.verdict()


class _Step(NamedTuple):
    """An import that started no threads."""

    modules: tuple[str, ...]
    line: int
    """Line in the main module; 0 for an import from elsewhere."""
    seconds: float
    environ: dict[bytes, bytes]


class _Preloader:
    """Importer of modules that checks after each one for threads that a fork would break."""

    def __init__(self) -> None:
        self._threads = 1
        if not self._is_fit():
            # Every interpreter here starts these threads, so the next zygote would have them too.
            self._threads = _count_threads()
        self._culprit: str | None = None
        self._names = ""
        self._steps: list[_Step] = []
        self._file = ""
        """File of the main module."""
        self._has_failed = False
        self._seconds = 0.0
        self._environ = dict(os.environb)

    def load(self, name: str) -> None:
        """Import the module ``name``."""
        begin = time.perf_counter()
        # A child that needs the module meets the same exception, and reports it.
        with contextlib.suppress(BaseException):
            importlib.import_module(name)
        self._note((name,), 0, time.perf_counter() - begin)
        self._seconds += time.perf_counter() - begin

    def load_main(self, data: dict[str, Any]) -> None:
        """Import the main module, as the children will."""
        begin = time.perf_counter()
        main = data.get("init_main_from_name") or data.get("init_main_from_path") or _MAIN
        try:
            with child.inheriting(), self._checking_imports(main):
                child.prepare_main(data)
        except BaseException:  # a child meets it too, and reports it
            self._has_failed = True
        self._seconds += time.perf_counter() - begin
        self._check(main)

    def verdict(self) -> Unfit | None:
        """Return why this process must not be forked; None if it may be."""
        if self._culprit is None:
            return None
        end = _end_of_leading_imports(self._file)
        safe = [step for step in self._steps if step.line <= end]
        seconds = self._seconds - sum(step.seconds for step in safe)
        reason = (
            f"importing {self._culprit} starts threads ({self._names}), and a process that has "
            "threads cannot be forked safely. Each process makes that import for itself, which "
            f"takes {seconds * 1000:.0f} ms. Start the threads in a function to save that time."
        )
        modules = tuple(module for step in safe for module in step.modules)
        environ = safe[-1].environ if safe else self._environ
        return Unfit("" if self._has_failed else reason, Imports(modules, environ))

    @contextlib.contextmanager
    def _checking_imports(self, main: str) -> Iterator[None]:
        """Check before and after each import statement of the main module."""
        original = builtins.__import__

        def checked(
            name: str,
            globals: Mapping[str, object] | None = None,
            locals: Mapping[str, object] | None = None,
            fromlist: Sequence[str] | None = (),
            level: int = 0,
        ) -> ModuleType:
            if globals is None or globals.get("__name__") != _MAIN:
                return original(name, globals, locals, fromlist or (), level)
            self._check(main)
            begin = time.perf_counter()
            module = original(name, globals, locals, fromlist or (), level)
            seconds = time.perf_counter() - begin
            frame = sys._getframe(1)
            self._file = frame.f_code.co_filename
            whole = module.__name__ if level else name
            parts = [f"{whole}.{part}" for part in fromlist or ()]
            modules = (whole, *(part for part in parts if part in sys.modules))
            self._note(modules, frame.f_lineno, seconds)
            return module

        builtins.__import__ = checked
        try:
            yield
        finally:
            if builtins.__import__ is checked:
                builtins.__import__ = original

    def _note(self, modules: tuple[str, ...], line: int, seconds: float) -> None:
        """Record an import, as safe or as the one that starts threads."""
        if self._check(modules[0]):
            self._steps.append(_Step(modules, line, seconds, dict(os.environb)))

    def _check(self, culprit: str) -> bool:
        """Return whether a fork is still safe.  If that ends, record ``culprit`` as the reason."""
        if self._culprit is None and not self._is_fit():
            self._culprit, self._names = culprit, _names_of_threads()
        return self._culprit is None

    def _is_fit(self) -> bool:
        """Return whether this process is without threads that a fork would break."""
        return _count_threads() <= self._threads or (
            _trial_fork_ends() and _comes_down_to(self._threads)
        )


def _end_of_leading_imports(path: str) -> int:
    """Return the last line of the file's first imports, before code that could change later ones.

    An import may depend on everything that the main module did before it.  These first imports
    depend only on imports, and on variables that the next zygote gets.
    """
    import ast  # rarely needed, and long to import

    try:
        with open(path, "rb") as file:
            statements = ast.parse(file.read()).body
    except (OSError, SyntaxError, ValueError):
        return 0
    end = 0
    for statement in statements:
        match statement:
            case ast.Import() | ast.ImportFrom() | ast.Expr(ast.Constant()):
                pass
            case ast.Assign([ast.Name()], ast.Constant()):
                pass
            case ast.Assign([ast.Subscript(ast.Attribute(ast.Name("os"), "environ"))]):
                pass
            case ast.Expr(ast.Call(ast.Attribute(ast.Attribute(ast.Name("os"), "environ")))):
                pass
            case ast.Expr(ast.Call(ast.Attribute(ast.Attribute(ast.Name("sys"), "path")))):
                pass
            case _:
                break
        end = statement.end_lineno or 0
    return end


def _count_threads() -> int:
    return len(os.listdir("/proc/self/task"))


def _comes_down_to(threads: int) -> bool:
    end = time.monotonic() + _SETTLING
    while _count_threads() > threads:
        if time.monotonic() > end:
            return False
        time.sleep(0.001)
    return True


def _trial_fork_ends() -> bool:
    """Fork, so that some libraries end their threads; return whether the new process ended."""
    try:
        pid = os.fork()
    except OSError:
        return False
    if pid == 0:
        os._exit(0)
    watched = os.pidfd_open(pid)
    try:
        poller = select.poll()
        poller.register(watched, select.POLLIN)
        if not poller.poll(_TRIAL_TIMEOUT * 1000):
            os.kill(pid, signal.SIGKILL)
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    finally:
        os.close(watched)


def _names_of_threads() -> str:
    """Return the names of threads, without that of the first, which unnamed threads share."""
    names = {thread.name for thread in threading.enumerate()} - {threading.main_thread().name}
    for task in os.listdir("/proc/self/task"):
        with contextlib.suppress(OSError), open(f"/proc/self/task/{task}/comm") as comm:
            names.add(comm.read().strip())
    with open("/proc/self/comm") as comm:
        names.discard(comm.read().strip())
    return ", ".join(sorted(names)) or "without names"
