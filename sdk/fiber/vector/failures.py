"""Errors of environments, on their way from a worker to its learner."""

from __future__ import annotations

import pickle
import traceback
from multiprocessing.pool import RemoteTraceback  # type: ignore[attr-defined]
from typing import NamedTuple

from fiber import reduction
from fiber.errors import FiberError

ATTEMPTS = 3
"""How often in a row what fails is made anew before it has done anything."""


class Failure(NamedTuple):
    """What one environment raised."""

    row: int
    doing: str
    error: bytes
    """The pickled exception."""
    trace: str

    @classmethod
    def of(cls, row: int, doing: str, error: BaseException) -> Failure:
        """In a worker: ``error`` was raised by the environment in ``row``."""
        trace = "".join(traceback.format_exception(error))
        return cls(row, doing, _pickled(error), trace)

    def exception(self, whose: str) -> Exception:
        """What to raise: the exception itself, with a note of the environment that it is of."""
        try:
            error: Exception = pickle.loads(self.error)
        except Exception:  # its class cannot be imported here
            error = FiberError(self.trace.strip().rpartition("\n")[2])
        error.__cause__ = RemoteTraceback(f'\n"""\n{self.trace}"""')
        error.add_note(f"{self.doing} of {whose}")
        return error


def summary(error: BaseException) -> str:
    """The last line of its traceback."""
    return "".join(traceback.format_exception_only(error)).strip()


def _pickled(error: BaseException) -> bytes:
    """The exception, or what can be said of one that does not survive pickling."""
    try:
        data = reduction.dumps(error)
        pickle.loads(data)
    except Exception:
        return pickle.dumps(FiberError(summary(error)))
    return data
