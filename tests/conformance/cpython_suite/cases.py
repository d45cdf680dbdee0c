"""CPython's test classes, rebuilt for ``$MP_MODULE``; importing this module builds them.

Children import it too, when they unpickle a target, so all names here must be importable.
"""

from __future__ import annotations

import importlib
import os
import signal
import threading
import types
from typing import Any

from .build import Builder, Case, load_source
from .redirect import Redirection

MODULE_NAME = os.environ.get("MP_MODULE", "multiprocessing")
START_METHOD = os.environ.get("MP_START_METHOD", "spawn")
TIERS = frozenset(os.environ.get("MP_TIERS", "core,local").split(","))


def stand_in(name: str) -> types.ModuleType:
    """Return what a pickled reference to ``multiprocessing[.x]`` becomes in the process that loads
    it.
    """
    return _redirection.stand_in(name)


_redirection = Redirection(MODULE_NAME, stand_in)
_source: Any = load_source(_redirection)
under_test: Any = importlib.import_module(MODULE_NAME)


# Replacements for helpers of the test module that use internals of the standard library.


class _DummyList:
    """A shared counter that appends and has a length; CPython's is made of its mmap heap."""

    def __init__(self) -> None:
        self._value = under_test.Value("i", 0)

    def append(self, _: object) -> None:
        with self._value.get_lock():
            self._value.value += 1

    def __len__(self) -> int:
        with self._value.get_lock():
            return int(self._value.value)


def unpickleable_result() -> Any:
    """CPython returns a lambda, which cloudpickle can save; nothing saves a generator."""
    return (number for number in range(0))


def close_queue(queue: Any) -> None:
    for name in ("close", "join_thread"):
        if hasattr(queue, name):
            getattr(queue, name)()


_check_invariant = _source._TestCondition.check_invariant


def _check_invariant_if_it_counts(self: Any, condition: Any) -> None:
    if hasattr(condition, "_sleeping_count"):
        _check_invariant(self, condition)


_source._DummyList = _DummyList
_source.unpickleable_result = unpickleable_result
_source.close_queue = close_queue
_source._TestCondition.check_invariant = _check_invariant_if_it_counts

CASES: list[Case] = Builder(_source, _redirection, globals(), TIERS).build()
FALLBACKS = _redirection.fallbacks
MISSING = _redirection.missing

_previous_method: str | None = None


def setUpModule() -> None:
    global _previous_method
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell started us with "&"
        signal.signal(signal.SIGINT, signal.default_int_handler)
    _previous_method = under_test.get_start_method(allow_none=True)
    under_test.set_start_method(START_METHOD, force=True)
    under_test.get_logger().setLevel(_source.LOG_LEVEL)


def tearDownModule() -> None:
    under_test.set_start_method(_previous_method, force=True)
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and not thread.daemon:
            thread.join(0.1)
