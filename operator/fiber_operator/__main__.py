"""``python -m fiber_operator``: run the operator until SIGTERM.  Settings: see ``settings``."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys

import prometheus_client

from fiber_operator import logs
from fiber_operator.program import Program
from fiber_operator.settings import Settings, SettingsError

log = logging.getLogger("fiber_operator")


async def _operate(settings: Settings) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    await Program(settings).run(stop)


def main() -> int:
    """The process; the exit status is 0 after a signal, 2 if the settings make no sense."""
    try:
        settings = Settings.from_environment(os.environ)
    except SettingsError as error:
        print(f"fiber_operator: {error}", file=sys.stderr)
        return 2
    logs.set_up(settings.log_level, settings.log_format)
    # Twice the lines for nothing that anybody asks for. The library types only a part of itself.
    prometheus_client.disable_created_metrics()  # type: ignore[no-untyped-call]
    try:
        asyncio.run(_operate(settings))
    except Exception:
        log.exception("the operator failed")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
