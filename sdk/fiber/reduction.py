"""How objects become bytes: plain pickle first, cloudpickle where that fails.

multiprocessing's ``ForkingPickler`` and its registered reducers are used as they are, so that what
pickles there pickles here.  Lambdas, closures and classes of an interactive session, which do not
pickle there, travel by value.
"""

from __future__ import annotations

import io
import os
import pickle
import sys
from collections import ChainMap
from collections.abc import Callable
from functools import partial
from multiprocessing import context as mp_context
from multiprocessing import reduction as mp_reduction
from multiprocessing.reduction import ForkingPickler, register
from typing import Any, ClassVar, cast

from fiber._agent import child
from fiber._hub import grants
from fiber._wire import packet
from fiber.errors import UnpicklableError

__all__ = ["AbstractReducer", "ForkingPickler", "Spawning", "dump", "dumps", "register"]

AbstractReducer = mp_reduction.AbstractReducer


class InheritedDescriptor:
    """A descriptor that travels with the start message, as the payload names it."""

    def __init__(self, index: int) -> None:
        self._index = index

    def detach(self) -> int:
        """In the child: the descriptor itself, once."""
        return child.take_descriptor(self._index)


class Spawning:
    """What multiprocessing calls the spawning popen: collects descriptors while a Process is
    pickled.
    """

    DupFd = InheritedDescriptor

    def __init__(self, process: Any) -> None:
        self.process = process
        self.fds: list[int] = []

    def duplicate_for_child(self, fd: int) -> int:
        """Send ``fd`` along; the index under which the child finds it."""
        self.fds.append(os.dup(fd))
        return len(self.fds) - 1

    def reset(self) -> None:
        """Forget what was collected."""
        for fd in self.fds:
            os.close(fd)
        self.fds.clear()


def spawning() -> Any:
    """The Spawning in progress on this thread, None outside of a start on this host."""
    return mp_context.get_spawning_popen()


def dump_process(process: Any, *, same_host: bool) -> tuple[bytes, list[int]]:
    """Pickle a Process that is being started; on the same host its descriptors go along.

    The caller owns the returned descriptors.
    """
    attempt = Spawning(process)
    mp_context.set_spawning_popen(cast("Any", attempt if same_host else RemoteSpawning(process)))
    try:
        payload = dumps(process, before_retry=attempt.reset)
    except (TypeError, AttributeError, pickle.PicklingError) as error:
        blame = _blame(process, error)
        attempt.reset()
        raise blame from error
    except BaseException:
        attempt.reset()
        raise
    finally:
        mp_context.set_spawning_popen(None)
    return payload, attempt.fds


def _blame(process: Any, reason: Exception) -> UnpicklableError:
    """The error that names what of a Process does not pickle."""
    parts = {"the target": process._target}
    parts |= {f"argument {index}": value for index, value in enumerate(process._args)}
    parts |= {f"argument {name!r}": value for name, value in process._kwargs.items()}
    for what, part in parts.items():
        try:
            dumps(part)
        except Exception as error:
            return UnpicklableError(f"{what} of process {process.name!r}", str(error))
    return UnpicklableError(f"process {process.name!r}", str(reason))


class RemoteSpawning:
    """Marks a start on another host: multiprocessing's checks pass, no descriptor can go along."""

    other_host = True

    def __init__(self, process: Any) -> None:
        self.process = process

    def duplicate_for_child(self, fd: int) -> int:
        """Refuse."""
        raise RuntimeError(
            f"descriptor {fd} cannot go to a process on another host: "
            "use Fiber's Pipe and Queue there instead of multiprocessing's or a socket"
        )

    DupFd = duplicate_for_child


def dumps(
    obj: Any,
    protocol: int | None = None,
    *,
    buffer_callback: Callable[[pickle.PickleBuffer], Any] | None = None,
    before_retry: Callable[[], None] = lambda: None,
) -> bytes:
    """Pickle ``obj``, by reference where possible.

    What lives in a ``__main__`` that the reader cannot import goes by value.
    """
    try:
        data = _dump(_Forking, obj, protocol, buffer_callback)
        if not (main_is_out_of_reach() and b"__main__" in data):
            return data
    except Exception:
        # Whether or not cloudpickle can do it, its error says as much.
        pass
    before_retry()
    return _dump(_by_value_pickler(), obj, protocol, buffer_callback)


def encode(obj: Any) -> tuple[bytes, list[memoryview]]:
    """Pickle ``obj`` for a packet: the pickle, and large buffers beside it."""
    grants.begin_attempt()
    try:
        encoded = packet.dumps(obj)
        if not (main_is_out_of_reach() and b"__main__" in encoded[0]):
            return encoded
    except Exception:
        # Whether or not cloudpickle can do it, its error says as much.
        pass
    grants.undo_attempt()
    return packet.dumps(obj, partial(_dump, _by_value_pickler()))


def encode_reusable(obj: Any) -> tuple[bytes, list[memoryview], grants.GrantSet | None]:
    """As ``encode``, for what may be unpickled several times, as a task that runs again.

    Connections and queues in it can be unpickled for as long as the third value is kept.
    """
    payload, buffers = encode(obj)
    if not grants.granted():
        return payload, buffers, None
    grants.undo_attempt()
    with grants.collecting_grants() as kept:
        payload, buffers = encode(obj)
    return payload, buffers, kept


def dump(obj: Any, file: Any, protocol: int | None = None) -> None:
    """Write the pickle of ``obj`` to ``file``."""
    file.write(dumps(obj, protocol))


def main_is_out_of_reach() -> bool:
    """Whether those who read our pickles cannot import our ``__main__`` from a file or by name."""
    if _readers_are_remote:
        return True
    main = sys.modules.get("__main__")
    return getattr(main, "__file__", None) is None and getattr(main, "__spec__", None) is None


def readers_are_remote(remote: bool) -> None:
    """Our processes run on other hosts (or no longer do): what is in ``__main__`` goes by value."""
    global _readers_are_remote
    _readers_are_remote = remote


_readers_are_remote = False


class _Forking(ForkingPickler):
    """ForkingPickler that accepts ``buffer_callback``."""

    def __init__(self, file: Any, protocol: int | None, **options: Any) -> None:
        pickle.Pickler.__init__(self, file, protocol, **options)
        self.dispatch_table = self._copyreg_dispatch.new_child(self._extra_reducers)  # type: ignore[attr-defined]


def _by_value_pickler() -> Any:
    import cloudpickle

    class ByValue(cloudpickle.Pickler):  # type: ignore[misc]
        dispatch_table: ClassVar[Any] = ChainMap(
            cast("Any", ForkingPickler)._extra_reducers, cloudpickle.Pickler.dispatch_table
        )

    return ByValue


def _dump(
    pickler: Any, obj: Any, protocol: int | None = None, buffer_callback: Any = None
) -> bytes:
    buffer = io.BytesIO()
    options = {"buffer_callback": buffer_callback} if buffer_callback else {}
    pickler(buffer, protocol or pickle.DEFAULT_PROTOCOL, **options).dump(obj)
    return buffer.getvalue()
