"""The functions that a pool applies, pickled once however often they are mapped."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

from fiber import reduction
from fiber._engine.chunks import Pace
from fiber._hub.handles import GrantSet
from fiber._wire import work

FUNCTIONS = 128
"""Functions that are recognized when they come again."""

FUNCTION_SIZE = 1 << 16
"""Bytes of a pickled function up to which it is."""


class Function:
    """A function that workers are asked to apply, pickled once."""

    __slots__ = ("buffers", "data", "grants", "id", "name", "pace")

    def __init__(
        self,
        id_: int,
        name: str,
        data: bytes,
        buffers: Sequence[memoryview],
        grants: GrantSet | None,
        pace: Pace | None = None,
    ) -> None:
        self.grants = grants
        self.id = id_
        self.name = name
        self.data = data
        self.buffers = buffers
        self.pace = pace


def name_of(function: Any) -> str:
    """Return the name of a function, for messages."""
    return getattr(function, "__qualname__", None) or repr(function)


class FunctionCache:
    """Recognizes functions.  Any thread."""

    def __init__(self) -> None:
        self._known: dict[bytes, Function] = {}
        self._ids = itertools.count(1)

    def get(self, function: Callable[..., Any]) -> Function:
        """``function``, pickled; one that pickles as an earlier one did is the same."""
        try:
            data, buffers, grants = reduction.encode_reusable(function)
        except reduction.REFUSALS as error:
            what = f"the function {name_of(function)}"
            raise reduction.blame({what: function}, error) from error
        known = self._known.get(data)
        if known is not None:
            return known
        sent = work.beside((data, buffers))
        made = Function(next(self._ids), name_of(function), *sent, grants)
        if not buffers and grants is None and len(data) <= FUNCTION_SIZE:
            if len(self._known) >= FUNCTIONS:
                self._known.clear()  # in one step: several threads may be here
            self._known[data] = made
        return made
