"""Reading of the program's activity from another thread than the loop's."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from typing import Any, TypeVar, cast

from fiber._engine.activity import Activity
from fiber._exceptions import fresh
from fiber._runtime.children import Children
from fiber._transport.loop import Loop
from fiber.errors import FiberError

T = TypeVar("T")

_PATIENCE = 5.0
"""Seconds in which the loop answers."""


def on_loop(loop: Loop, function: Callable[[], T]) -> T:
    """Return the result of a function that runs on the loop thread, or raise its error."""
    if loop.on_thread():  # as in a finalizer that runs there
        return function()
    if loop.broken:
        raise FiberError("the program's event loop has ended, so its activity cannot be read")
    answers: queue.SimpleQueue[tuple[T | None, Exception | None]] = queue.SimpleQueue()

    def run() -> None:
        try:
            answers.put((function(), None))
        except Exception as error:
            answers.put((None, error))

    loop.call_soon(run)
    try:
        result, error = answers.get(timeout=_PATIENCE)
    except queue.Empty:
        raise FiberError(
            f"the program's event loop has not answered within {_PATIENCE:.0f} s"
        ) from None
    if error is not None:
        raise fresh(error)
    return cast("T", result)


def snapshot(activity: Activity, children: Children, now: float, since: int = 0) -> dict[str, Any]:
    """Return a snapshot of the activity with two more facts.  Runs on the loop thread.

    ``start``  unix time of the activity's beginning
    ``busy``   pairs for the children with tasks that they have not answered: ``id``, and time since
    when, in seconds after the beginning
    """
    activity.refresh()
    busy = []
    for child in children:
        record, busy_since = child.owner.record, child.owner.busy_since
        if record is not None and busy_since is not None:
            busy.append([record.id, max(busy_since, record.noted) - activity.start])
    start = time.time() - (now - activity.start)
    return {"start": start, "busy": busy, **activity.snapshot(now, since)}


def read_activity(loop: Loop, activity: Activity, children: Children) -> dict[str, Any]:
    """Return the whole activity until now.  Runs on any thread."""
    return on_loop(loop, lambda: snapshot(activity, children, loop.now()))


def no_activity() -> dict[str, Any]:
    """Return the activity of a program that has made no process yet."""
    now = time.monotonic()
    return {"start": time.time(), "busy": [], **Activity(now).snapshot(now)}
