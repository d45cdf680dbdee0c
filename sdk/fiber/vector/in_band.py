"""What a worker sends for good."""

from __future__ import annotations

import pickle
from typing import Any, TypeVar, cast

from fiber import reduction

_Value = TypeVar("_Value")


class _InBand:
    def __init__(self, value: Any) -> None:
        self._value = value

    def __reduce__(self) -> tuple[Any, ...]:
        return pickle.loads, (reduction.dumps(self._value, protocol=5),)


def in_band(value: _Value) -> _Value:
    """What is pickled for ``value`` in a message so that its receiver has memory of its own for it.

    Otherwise large arrays lie beside the pickle, and a learner reads them where the worker wrote
    them (``Connection._recv_pickled``).  That is for what it copies at once, and not for what its
    user may keep.
    """
    return cast(_Value, _InBand(value))
