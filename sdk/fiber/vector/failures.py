"""Errors of environments, on their way from a worker to its learner."""

from __future__ import annotations

import pickle
import traceback
from typing import NamedTuple

from fiber._agent.travelling import encode_error
from fiber._exceptions import add_note

ATTEMPTS = 3
"""How often in a row what fails is made anew before it has done anything."""


class Failure(NamedTuple):
    """What one environment raised."""

    row: int
    doing: str
    error: bytes
    """The pickled exception."""

    @classmethod
    def of(cls, row: int, doing: str, error: BaseException) -> Failure:
        """In a worker: ``error`` was raised by the environment in ``row``."""
        return cls(row, doing, encode_error(error))

    def exception(self, whose: str) -> Exception:
        """What to raise: the exception itself, with a note of the environment that it is of."""
        error: Exception = pickle.loads(self.error)
        add_note(error, f"{self.doing} of {whose}")
        return error


def summary(error: BaseException) -> str:
    """The last line of its traceback."""
    return "".join(traceback.format_exception_only(error)).strip()
