"""The logger ``fiber``, a child of multiprocessing's logger once that exists."""

from __future__ import annotations

import contextlib
import sys
from multiprocessing import util
from typing import Any

_mp: Any = util  # typeshed does not list its private names

USUAL = "WARNING"
"""Level at which Fiber sets up no handler."""


def debug(message: str, *args: object) -> None:
    """Log an event.  Does nothing if ``logging`` is not imported."""
    # Another thread may be importing the module at this moment.
    get_logger: Any = getattr(sys.modules.get("logging"), "getLogger", None)
    if get_logger is None:
        return
    logger = get_logger("fiber")
    if _mp._logger is not None:
        logger.parent = _mp._logger  # from now on its level and handlers count
    try:
        logger.debug(message, *args)
    except Exception:  # an error of the user's handler must not end Fiber's threads
        import traceback

        with contextlib.suppress(Exception):
            traceback.print_exc()


def show(level: str) -> None:
    """Show records of ``level`` and above on stderr, in children too, as ``log_to_stderr`` does."""
    if level == USUAL:
        return
    if _mp._log_to_stderr:
        util.get_logger().setLevel(level)
    else:
        util.log_to_stderr(level)
