"""Pickling of values that their receiver may keep."""

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
    """Return a stand-in for ``value`` in a message.  The receiver gets its own copy of the arrays.

    Otherwise large arrays lie beside the pickle, and the learner reads them where the worker wrote
    them (``Connection._recv_pickled``).  That is right for arrays that the learner copies at once,
    and wrong for values that its user may keep.
    """
    return cast(_Value, _InBand(value))
