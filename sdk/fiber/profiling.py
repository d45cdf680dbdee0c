"""Timeline and summary of what a program's processes did, to see where the time goes.

    with fiber.Pool() as pool:
        pool.map(function, items)
        print(fiber.summary())
        fiber.timeline("run.json")

docs/profiling.md shows how to read them.
"""

from __future__ import annotations

import os

from fiber._runtime import state
from fiber._runtime.summary import (
    Death,
    FunctionTime,
    SlowWorker,
    Summary,
    WorkerShares,
    summarize,
)

__all__ = [
    "Death",
    "FunctionTime",
    "SlowWorker",
    "Summary",
    "WorkerShares",
    "summary",
    "timeline",
]


def timeline(path: str | os.PathLike[str]) -> None:
    """Write what the processes of this program have done so far to a file.

    The suffix chooses the form:

    `.json`, `.json.gz`: a trace, for https://ui.perfetto.dev and chrome://tracing. Each host is a
        process of the trace, and each worker a thread. Times are microseconds after the first
        process, pool, pipe or queue was made.
    `.png`, `.svg`, `.pdf`: a picture with a row for each worker. It needs matplotlib.

    Spans of work that follow each other closely are one span, which counts its tasks, so the file
    of a long run is not larger than some megabytes. An existing file is replaced when the new one
    is complete. Before the first process the timeline is empty.

    ValueError: another suffix. OSError: the file cannot be written; it says why.
    ModuleNotFoundError: matplotlib is not installed. multiprocessing has no such function.
    """
    # The record first: a picture takes a second.
    activity = state.read_activity()
    from fiber._runtime.timeline import public_facts, write_timeline

    write_timeline(os.path.abspath(os.fsdecode(path)), activity, public_facts())


def summary() -> Summary:
    """Return where the time of the workers went so far, with advice where the record proves it.

    `print(fiber.summary())` prints some lines. The fields of the object are documented at
    `Summary`. multiprocessing has no such function.
    """
    return summarize(state.read_activity())
