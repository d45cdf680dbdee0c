"""Functions that the workers run. Importable by name from every contender's workers, and cheap to
import."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any


def no_op(item: Any) -> Any:
    """Give the argument back."""
    return item


def size(array: Any) -> int:
    """Take a large argument, give a small result."""
    return int(array.nbytes)


def ones(nbytes: int) -> Any:
    """Take a small argument, give a large result."""
    import numpy as np

    return np.ones(nbytes, np.uint8)


_kept = b""


def content(nbytes: int) -> bytes:
    """Return bytes in memory that was written to, as all data is that a program computed."""
    return b"x" * nbytes


def keep(nbytes: int) -> None:
    """Make the result of ``kept``."""
    global _kept
    _kept = content(nbytes)


def kept() -> bytes:
    """Return a large result that existed before the call."""
    return _kept


def announce(path: str) -> None:
    """Pool initializer: tell the owner of the named pipe that this worker is up."""
    fd = os.open(path, os.O_WRONLY)
    try:
        os.write(fd, b".")
    finally:
        os.close(fd)


def echo(connection: Any, processor: int | None = None) -> None:
    """Send each message back until terminated, on this processor if one is given."""
    if processor is not None:
        os.sched_setaffinity(0, {processor})
    while True:
        connection.send(connection.recv())


def after(seconds: float, item: Any) -> Any:
    """Sleep, then give the argument back."""
    time.sleep(seconds)
    return item


sleep = time.sleep

pretend: Callable[[float], None] = time.sleep
"""Take as long as the work that a task stands for. A fake child is busy for so long instead."""
