"""Pickles of objects whose classes came by value from the program's ``__main__``.

Classes and functions of a notebook, ``python -c`` or a script travel by value, through cloudpickle,
to workers that cannot import them.  On the way back they must not travel by value: the program
would get copies of its classes, which fail ``isinstance`` and ``except``.  So classes and functions
of ``__main__`` go back by name, and the program looks up the originals.
"""

from __future__ import annotations

import io
import operator
import pickle
import sys
from collections import ChainMap
from collections.abc import Callable
from functools import lru_cache
from multiprocessing.reduction import ForkingPickler
from types import FunctionType
from typing import Any, cast


def dumps(
    obj: Any,
    protocol: int | None = None,
    buffer_callback: Callable[[pickle.PickleBuffer], Any] | None = None,
) -> bytes:
    """Pickle ``obj`` for the program whose ``__main__`` came here by value."""
    file = io.BytesIO()
    protocol = protocol or pickle.DEFAULT_PROTOCOL
    _by_reference()(file, protocol, buffer_callback=buffer_callback).dump(obj)
    return file.getvalue()


def reduce_file(file: io.TextIOWrapper) -> Any:
    """Refuse open files.  Without this function, cloudpickle would copy their contents."""
    for stream in ("stdout", "stderr"):
        if file is getattr(sys, stream):
            return getattr, (sys, stream)
    name = getattr(file, "name", file)  # a file in memory has none
    raise TypeError(
        f"cannot pickle the open file {name!r}: pass its path and open it where it is used"
    )


def find(name: str, tracker_id: str | None) -> Any:
    """Return the object that ``__main__`` calls ``name``.

    In this process a class may itself have come by value.  Then cloudpickle knows it by
    ``tracker_id``.
    """
    if tracker_id is not None and (known := _classes_by_tracker_id().get(tracker_id)) is not None:
        return known
    try:
        return operator.attrgetter(name)(sys.modules["__main__"])
    except AttributeError:
        raise AttributeError(
            f"a task returned or raised an object of __main__.{name}, which this program does not "
            "have: define it where the pool is, or in a module that both can import"
        ) from None


def pickler(file: io.BytesIO, reducers: dict[type, Any]) -> pickle.Pickler:
    """Return a pickler as in ``dumps``; ``reducers`` take precedence over its other reducers."""
    made: pickle.Pickler = _by_reference()(file, pickle.HIGHEST_PROTOCOL, reducers)
    return made


@lru_cache(maxsize=1)
def _by_reference() -> Any:
    import cloudpickle

    class ByReference(cloudpickle.Pickler):  # type: ignore[misc]
        def __init__(
            self,
            file: io.BytesIO,
            protocol: int,
            reducers: dict[type, Any] | None = None,
            buffer_callback: Callable[[pickle.PickleBuffer], Any] | None = None,
        ) -> None:
            own = (
                {} if reducers is None else reducers,
                cast("Any", ForkingPickler)._extra_reducers,
                {io.TextIOWrapper: reduce_file},
            )
            self.dispatch_table = ChainMap(*own, cloudpickle.Pickler.dispatch_table)
            super().__init__(file, protocol, buffer_callback)  # reads the table, once

        def reducer_override(self, obj: Any) -> Any:
            if isinstance(obj, type | FunctionType) and obj.__module__ == "__main__":
                tracker_id = _tracker_id(obj)
                if tracker_id is not None or "<" not in obj.__qualname__:
                    return find, (obj.__qualname__, tracker_id)
            return super().reducer_override(obj)

    return ByReference


def _tracker_id(obj: Any) -> str | None:
    """Return cloudpickle's id of a class that came by value, the same in every process."""
    from cloudpickle import cloudpickle

    marks = getattr(cloudpickle, "_DYNAMIC_CLASS_TRACKER_BY_CLASS", {})
    return marks.get(obj) if isinstance(obj, type) else None


def _classes_by_tracker_id() -> Any:
    from cloudpickle import cloudpickle

    return getattr(cloudpickle, "_DYNAMIC_CLASS_TRACKER_BY_ID", {})
