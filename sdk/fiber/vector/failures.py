"""Errors of environments, on their way from a worker to its learner."""

from __future__ import annotations

import pickle
import traceback
from typing import NamedTuple

from fiber._agent.travelling import encode_error
from fiber._exceptions import add_note

ATTEMPTS = 3
"""Number of times in a row that an environment is made anew without having done anything."""


class Failure(NamedTuple):
    """Error that one environment raised."""

    row: int
    doing: str
    error: bytes
    """The pickled exception."""

    @classmethod
    def of(cls, row: int, doing: str, error: BaseException) -> Failure:
        """Return the failure of the environment in ``row``.  Called in its worker."""
        return cls(row, doing, encode_error(error))

    def exception(self, whose: str) -> Exception:
        """Return the exception to raise, with a note that names the environment."""
        error: Exception = pickle.loads(self.error)
        add_note(error, f"{self.doing} of {whose}")
        return error


def summary(error: BaseException) -> str:
    """Return the last line of the traceback of ``error``."""
    return "".join(traceback.format_exception_only(error)).strip()
