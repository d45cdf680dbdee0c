"""Options of a pool, and their checks.  An error names the option."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple

from fiber import config, cpu
from fiber._engine.tasks import Limits
from fiber.resources import Resources

LARGEST_CHUNK = 2**32 - 1
"""Largest number of tasks in a chunk that a message can express."""


NO_WISHES = Resources()

IDLE_TIMEOUT = 60.0
"""Seconds after which an idle worker above the minimum ends."""


class PoolOptions(NamedTuple):
    """Options of a pool.  ``fiber.pool.Pool`` documents each."""

    new_process: Callable[..., BaseProcess]
    """Function that makes the Process object for a WorkerHandle."""
    initializer: Callable[..., object] | None = None
    initargs: tuple[Any, ...] = ()
    minimum: int = 1
    maximum: int = 1
    max_tasks: int | None = None
    """Tasks, or chunks of them, after which a worker is replaced."""
    limits: Limits = Limits()
    """Limits of how often a task runs again whose worker is lost."""
    retryable: tuple[type[BaseException], ...] = ()
    idle_timeout: float = IDLE_TIMEOUT
    resources: Resources = NO_WISHES
    """Wishes of workers for their hosts, beside those of the first task's function."""
    calls_back_at_end: bool = False
    """True if callbacks run for calls that termination fails, unlike in multiprocessing."""
    closes_streams: bool = False
    """True if a closed pool reads no further input of maps with ``buffersize``."""
    refusal: Callable[[], Exception] = partial(ValueError, "Pool not running")
    """Function that makes the error for calls of a closed pool."""


def whole(name: str, value: Any) -> int:
    """Return ``value`` as an int.  True and False are refused."""
    if isinstance(value, bool) or not hasattr(type(value), "__index__"):
        raise TypeError(f"{name} must be a whole number, not {value!r}")
    return operator.index(value)


def seconds(name: str, value: Any) -> float | None:
    """Return ``value`` as a number of seconds; None, and infinity, stand for no limit."""
    if value is None:
        return None
    kind = type(value)
    if kind is bool or not (hasattr(kind, "__float__") or hasattr(kind, "__index__")):
        raise TypeError(f"{name} must be a number of seconds or None, not {value!r}")
    number = float(value)
    if not number > 0:
        raise ValueError(f"{name} must be a number of seconds above 0, not {value!r}")
    return None if number == math.inf else number


def sizes(processes: int | None, low: int | None, high: int | None) -> tuple[int, int]:
    """Return the smallest and the largest number of workers."""
    if low is None and high is None:
        count = cpu.cpu_count() if processes is None else whole("processes", processes)
        if count < 1:
            raise ValueError("Number of processes must be at least 1")
        return count, count
    if processes is not None:
        raise ValueError(
            "processes= is a fixed number of workers: give it, or min_workers= and max_workers="
        )
    low = 1 if low is None else whole("min_workers", low)
    high = max(low, cpu.cpu_count()) if high is None else whole("max_workers", high)
    if not 0 <= low <= high or high < 1:
        raise ValueError(
            f"min_workers={low} and max_workers={high}: expected 0 <= min_workers <= max_workers, "
            "and max_workers >= 1"
        )
    return low, high


def positive(name: str, value: Any) -> int | None:
    """Return ``value`` as an int of at least 1; None stays None."""
    if value is None:
        return None
    count = whole(name, value)
    if count < 1:
        raise ValueError(f"{name} must be greater than 0, not {value!r}")
    return count


def max_tasks(value: Any) -> int | None:
    """Return the number of tasks that a worker may run; None stands for any number."""
    if value is not None and (not isinstance(value, int) or value <= 0):
        raise ValueError(f"maxtasksperchild must be a positive int or None, not {value!r}")
    return value


def limits(retries: Any, disruptions: Any) -> Limits:
    """Return how often a task may run again; None stands for the configuration's value.

    Without retries a task runs once, unless ``disruptions`` allows more.
    """
    configured = config.current()
    again = configured.retries if retries is None else _times("retries", retries)
    if disruptions is not None:
        return Limits(again, _times("disruptions", disruptions))
    return Limits(again, configured.disruptions if again else 0)


def _times(name: str, value: Any) -> int:
    count = whole(name, value)
    if count < 0:
        raise ValueError(f"{name} must be a whole number of at least 0, not {value!r}")
    return count


def exceptions(
    wanted: type[BaseException] | Sequence[type[BaseException]],
) -> tuple[type[BaseException], ...]:
    """Return exception classes as a tuple, from one class or several."""
    classes: tuple[Any, ...] = (wanted,) if isinstance(wanted, type) else tuple(wanted)
    for cls in classes:
        if not (isinstance(cls, type) and issubclass(cls, BaseException)):
            raise TypeError(f"retry_exceptions must be exception classes, not {cls!r}")
    return classes


def label(progress: Any, name: str) -> str:
    """Return the label of a map whose call asks to show its progress; else an empty text."""
    if progress is not None and not isinstance(progress, bool | str):
        raise TypeError(f"progress must be True, False or a text, not {progress!r}")
    return progress if isinstance(progress, str) else name if progress else ""


def chunksize(value: Any) -> int:
    """Return the number of items that travel together."""
    size = whole("chunksize", value)
    if size < 1:
        raise ValueError(f"Chunksize must be 1+, not {value!r}")
    return min(size, LARGEST_CHUNK)


def buffersize(value: Any) -> int | None:
    """Return the number of items to read ahead; None stands for no limit."""
    if value is None:
        return None
    size = whole("buffersize", value)
    if size < 1:
        raise ValueError(f"buffersize must be 1+, not {value!r}")
    return size
