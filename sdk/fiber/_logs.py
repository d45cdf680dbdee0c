"""The logger ``fiber``.  Its records go where multiprocessing's go, once that has a logger."""

from __future__ import annotations

import contextlib
import sys
from multiprocessing import util
from typing import Any

_mp: Any = util  # typeshed does not list its private names

USUAL = "WARNING"
"""The level that nothing has to be done for."""


def debug(message: str, *args: object) -> None:
    """Log an event of Fiber's; free of cost where ``logging`` is not imported."""
    # Another thread may be importing the module at this moment.
    get_logger: Any = getattr(sys.modules.get("logging"), "getLogger", None)
    if get_logger is None:
        return
    logger = get_logger("fiber")
    if _mp._logger is not None:
        logger.parent = _mp._logger  # its level and handlers count from here on
    try:
        logger.debug(message, *args)
    except Exception:  # of a handler of the user's: Fiber's own threads go on
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
