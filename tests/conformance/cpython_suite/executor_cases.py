"""CPython's tests of process pool executors, with ``fiber.Executor`` in their place.

Up to Python 3.11 they are one module, from then on a package of several.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
import types
import unittest
from concurrent import futures
from typing import Any

import fiber

from .build import Case
from .tiers import EXECUTORS_NOT_APPLICABLE

SOURCE = "test.test_concurrent_futures"

MIXINS = (
    "ProcessPoolExecutorTest",
    "ProcessPoolShutdownTest",
    "ExecutorDeadlockTest",
    "WaitTests",
    "AsCompletedTests",
    "InitializerMixin",
    "FailingInitializerMixin",
)

METHOD = os.environ.get("MP_START_METHOD", "forkserver")

CASES: list[Case] = []
FALLBACKS: set[str] = set()
MISSING: set[str] = set()


def source_modules() -> list[types.ModuleType]:
    """CPython's modules, the package first."""
    package = importlib.import_module(SOURCE)
    names = [found.name for found in pkgutil.iter_modules(getattr(package, "__path__", ()))]
    return [package, *(importlib.import_module(f"{SOURCE}.{name}") for name in names)]


def redirect(module: types.ModuleType) -> None:
    """Have ``futures.ProcessPoolExecutor``, and that of other interpreters, be Fiber's."""
    if getattr(module, "futures", None) is futures:
        stand_in = types.ModuleType(futures.__name__)
        vars(stand_in).update({name: getattr(futures, name) for name in futures.__all__})
        vars(stand_in).update(ProcessPoolExecutor=fiber.Executor, process=futures.process)
        vars(module)["futures"] = stand_in
    run = getattr(module, "assert_python_ok", None)
    if run is not None:
        vars(module)["assert_python_ok"] = lambda *arguments: run(*map(redirected, arguments))


def redirected(script: str) -> str:
    """Return the source that another interpreter runs."""
    for name in ("concurrent.futures", "multiprocessing"):
        script = script.replace(f"from {name} import", "from fiber import")
    return script


def build() -> None:
    """Each of CPython's mixins as a class of this module."""
    found: dict[str, Any] = {}
    for module in source_modules():
        redirect(module)
        found |= vars(module)
    body = {
        "executor_type": fiber.Executor,
        "ctx": METHOD,
        "get_context": lambda self: fiber.get_context(self.ctx),
    }
    with_fiber = type("FiberMixin", (found["ExecutorMixin"],), body)
    for name in MIXINS:
        # Without CPython's base class, whose end of each test reaps children and counts threads.
        built = type(name, (found[name], with_fiber, unittest.TestCase), {"__module__": __name__})
        globals()[name] = built
        for method in unittest.TestLoader().getTestCaseNames(built):
            left_out = f"{name}.{method}" in EXECUTORS_NOT_APPLICABLE
            CASES.append(Case(name, name, None, method, "na" if left_out else "core"))


build()
