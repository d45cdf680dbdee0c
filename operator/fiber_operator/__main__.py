"""``python -m fiber_operator``: run the operator until SIGTERM.  Its settings: ``settings.py``."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import signal
import sys

import prometheus_client

from fiber_operator import logs
from fiber_operator.process import OperatorProcess
from fiber_operator.settings import OperatorSettings, SettingsError

GARBAGE = 10_000
"""New objects after which Python's garbage collector runs."""

DEPTH = 30_000
"""Python's limit of recursion.  Kubernetes accepts documents that are nested ten thousand deep.  At
Python's default limit, one such pool would make the list of all pools unreadable."""

log = logging.getLogger("fiber_operator")


async def _operate(settings: OperatorSettings) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    await OperatorProcess(settings).run(stop)


def main() -> int:
    """Run the process.  Return the exit status: 0 after a signal, 2 if the settings are wrong."""
    try:
        settings = OperatorSettings.from_environment(os.environ)
    except SettingsError as error:
        print(f"fiber_operator: {error}", file=sys.stderr)
        return 2
    logs.set_up(settings.log_level, settings.log_format)
    sys.setrecursionlimit(DEPTH)
    # They would double the lines of /metrics.  The library types only a part of itself.
    prometheus_client.disable_created_metrics()  # type: ignore[no-untyped-call]
    # A list of pods makes so many objects that the collector would run many times, and look at all
    # objects of the libraries each time.  That took two thirds of the time of parsing.
    gc.freeze()
    gc.set_threshold(GARBAGE)
    try:
        asyncio.run(_operate(settings))
    except Exception:
        log.exception("the operator failed")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
