"""Sending back what was defined in a ``__main__`` that travels by value.

What a notebook, ``python -c`` or a script defines reaches workers that cannot import it by value,
through cloudpickle.  It must not come back so: the program would get copies of its own classes,
which ``isinstance`` and ``except`` do not know.  So classes and functions of ``__main__`` go back
by name, and the program finds its own.
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


def find(name: str, tracker_id: str | None) -> Any:
    """What ``__main__`` calls ``name``.

    Here, or in a process between here and there, it may have come by value itself: then it is what
    cloudpickle knows by ``tracker_id``.
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
    """Make a pickler as ``dumps`` has it, with reducers that go before its others."""
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
            )
            self.dispatch_table = ChainMap(*own, cloudpickle.Pickler.dispatch_table)
            super().__init__(file, protocol, buffer_callback)  # which reads the table once

        def reducer_override(self, obj: Any) -> Any:
            if isinstance(obj, type | FunctionType) and obj.__module__ == "__main__":
                tracker_id = _tracker_id(obj)
                if tracker_id is not None or "<" not in obj.__qualname__:
                    return find, (obj.__qualname__, tracker_id)
            return super().reducer_override(obj)

    return ByReference


def _tracker_id(obj: Any) -> str | None:
    """What cloudpickle calls a class that came by value, in every process that it came through."""
    from cloudpickle import cloudpickle

    marks = getattr(cloudpickle, "_DYNAMIC_CLASS_TRACKER_BY_CLASS", {})
    return marks.get(obj) if isinstance(obj, type) else None


def _classes_by_tracker_id() -> Any:
    from cloudpickle import cloudpickle

    return getattr(cloudpickle, "_DYNAMIC_CLASS_TRACKER_BY_ID", {})
