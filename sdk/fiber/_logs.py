"""The logger ``fiber``.  Its records go where multiprocessing's go, once that has a logger."""

from __future__ import annotations

import sys
from multiprocessing import util
from typing import Any

_mp: Any = util  # typeshed does not list its private names

USUAL = "WARNING"
"""The level that nothing has to be done for."""


def debug(message: str, *args: object) -> None:
    """Log an event of Fiber's; free of cost where nobody has imported ``logging``."""
    logging: Any = sys.modules.get("logging")
    if logging is None:
        return
    logger = logging.getLogger("fiber")
    if _mp._logger is not None:
        logger.parent = _mp._logger  # its level and handlers count from here on
    logger.debug(message, *args)


def show(level: str) -> None:
    """Show records of ``level`` and above on stderr, in children too, as ``log_to_stderr`` does."""
    if level == USUAL:
        return
    if _mp._log_to_stderr:
        util.get_logger().setLevel(level)
    else:
        util.log_to_stderr(level)
