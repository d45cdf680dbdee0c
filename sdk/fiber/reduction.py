"""Pickling of objects: plain pickle first, cloudpickle where that fails.

multiprocessing's ``ForkingPickler`` and its registered reducers are used unchanged.  So an object
that pickles with multiprocessing pickles here.  Lambdas, closures and classes of an interactive
session do not pickle there.  Here they travel by value.
"""

from __future__ import annotations

import copyreg
import io
import os
import pickle
import sys
from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache, partial
from itertools import islice
from multiprocessing import context as mp_context
from multiprocessing import process as mp_process
from multiprocessing import reduction as mp_reduction
from multiprocessing.reduction import (
    HAVE_SEND_HANDLE,
    DupFd,
    ForkingPickler,
    recv_handle,
    recvfds,
    register,
    send_handle,
    sendfds,
)
from types import FunctionType, ModuleType
from typing import Any, ClassVar, cast

from fiber._agent import by_reference, child
from fiber._hub import handles
from fiber._hub.heap import Segment
from fiber._wire import packet
from fiber._wire.descriptor import Descriptor, own
from fiber.errors import UnpicklableError

__all__ = [
    "HAVE_SEND_HANDLE",
    "AbstractReducer",
    "DupFd",
    "ForkingPickler",
    "Spawning",
    "dump",
    "dumps",
    "recv_handle",
    "recvfds",
    "register",
    "send_handle",
    "sendfds",
]

AbstractReducer = mp_reduction.AbstractReducer

REFUSALS = (TypeError, pickle.PicklingError)
"""Errors that picklers raise for objects that they cannot pickle."""

_DEPTH = 20
"""Largest number of steps from an object to the part that does not pickle."""

_BREADTH = 1000
"""Largest number of parts of one object that are tried."""


class PayloadDescriptor:
    """A descriptor that travels with the start message; its pickle is a number."""

    def __init__(self, index: int) -> None:
        self._index = index

    def detach(self) -> int:
        """Return the descriptor in the child.  This works once."""
        return child.take_descriptor(self._index)


class PayloadSegment(PayloadDescriptor):
    """A descriptor of shared memory, for which the payload may have several handles."""

    def detach(self) -> int:
        """Return a duplicate of the descriptor, in the child."""
        return child.duplicate_descriptor(self._index)


class Spawning:
    """Collector of descriptors while a Process is pickled: multiprocessing's "spawning popen"."""

    DupFd = PayloadDescriptor

    def __init__(self, process: Any) -> None:
        self.process = process
        self.fds: list[Descriptor] = []
        self._segments: dict[int, PayloadSegment] = {}

    def inherit_segment(self, segment: Segment) -> PayloadSegment:
        """Send the segment's descriptor along, once."""
        inherited = self._segments.get(segment.inode)
        if inherited is None:
            inherited = PayloadSegment(self.duplicate_for_child(segment.fileno()))
            self._segments[segment.inode] = inherited
        return inherited

    def duplicate_for_child(self, fd: int) -> int:
        """Send ``fd`` along; return the index under which the child finds it."""
        self.fds.append(own(os.dup(fd)))
        return len(self.fds) - 1

    def forget(self) -> None:
        """Drop the collected descriptors: the object is pickled again, in another way."""
        self.fds.clear()
        self._segments.clear()
        handles.undo_pickling()


def spawning() -> Any:
    """Return the Spawning of this thread; None unless it starts a process on this host."""
    return mp_context.get_spawning_popen()


def dump_process(process: Any, *, same_host: bool) -> tuple[bytes, list[Descriptor]]:
    """Pickle a Process that is being started, with its descriptors on the same host."""
    popen: Any = Spawning(process) if same_host else RemoteSpawning(process)
    try:
        mp_context.set_spawning_popen(popen)
        payload = dumps(process, before_retry=popen.forget)
        fds, popen.fds = popen.fds, []
        return payload, fds
    except (*REFUSALS, AttributeError) as error:
        raise _blame_process(process, error) from error
    finally:
        mp_context.set_spawning_popen(None)
        popen.fds.clear()  # now: a traceback that is kept would keep them open


def dump_shared(obj: Any, *, same_host: bool) -> bytes | None:
    """Pickle ``obj`` once for several Processes that are to be started.

    Return None if each process needs a separate pickle, since descriptors and grants are for one
    process.  Also return None if it does not pickle: the start of the first process raises that.
    """
    attempt: Any = Spawning(None) if same_host else RemoteSpawning(None)
    try:
        mp_context.set_spawning_popen(attempt)
        with handles.collecting_grants(reusable=False) as grants:
            data = dumps(obj, before_retry=attempt.forget)
        mine = bool(grants or attempt.fds)
        grants.release()
    except Exception:
        return None
    finally:
        attempt.fds.clear()
        mp_context.set_spawning_popen(None)
    return None if mine else data


def _blame_process(process: Any, reason: Exception) -> UnpicklableError:
    """Return the error that names the part of a Process that does not pickle."""
    whole = f"process {process.name!r}"
    named = getattr(process, "user_parts", None)
    if named is None:
        parts = {"the target": process._target}
        parts |= {f"argument {index}": value for index, value in enumerate(process._args)}
        parts |= {f"argument {name!r}": value for name, value in process._kwargs.items()}
        named = {f"{what} of {whole}": part for what, part in parts.items()}
    return _name_culprit(named, whole, reason)


def blame(parts: Mapping[str, Any], reason: Exception, whole: str = "") -> Exception:
    """Return the error to raise when ``parts`` of ``whole``, which have names, did not pickle.

    It names the culprit and the path to it.  If ``reason`` is not a pickler's refusal but an error
    in the user's code, return it unchanged.
    """
    if not isinstance(reason, REFUSALS):
        return reason
    return _name_culprit(parts, whole or next(iter(parts)), reason)


def _name_culprit(parts: Mapping[str, Any], whole: str, reason: Exception) -> UnpicklableError:
    for what, part in parts.items():
        refusal = _refusal(part)
        if refusal is not None:
            error = UnpicklableError(what, refusal, _way_to_culprit(part))
            break
    else:
        error = UnpicklableError(whole, str(reason))
    error.__cause__ = reason
    return error


def _refusal(obj: Any) -> str | None:
    """Return the reason why ``obj`` does not pickle; None if it does."""
    with handles.Pickling() as pickling:
        try:
            dumps(obj)
        except Exception as error:
            # The text only: the error would keep the frames of the callers alive, in a cycle.
            return str(error)
        finally:
            pickling.take_back()
    return None


def _way_to_culprit(obj: Any) -> str:
    """Return the path from ``obj`` to the innermost part that does not pickle, as Python code."""
    way = ""
    for _ in range(_DEPTH):  # an object that refers to itself has no innermost part
        if type(obj).__module__.startswith("multiprocessing."):
            break  # users do not know its parts, and pickling a connection leaves descriptors
        for step, part in islice(_parts(obj), _BREADTH):
            if _refusal(part) is not None:
                way, obj = way + step, part
                break
        else:
            break
    return way


def _parts(obj: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(obj, dict):
        yield from ((f"[{key!r}]", value) for key, value in obj.items())
    elif isinstance(obj, list | tuple):
        yield from ((f"[{index}]", value) for index, value in enumerate(obj))
    elif not isinstance(obj, type | FunctionType | ModuleType):
        yield from ((f".{name}", value) for name, value in getattr(obj, "__dict__", {}).items())


class RemoteSpawning:
    """Mark of a start on another host: multiprocessing's checks pass, descriptors are refused."""

    other_host = True

    def __init__(self, process: Any) -> None:
        self.process = process
        self.fds: list[Descriptor] = []

    def duplicate_for_child(self, fd: int) -> int:
        """Refuse: a descriptor is valid on its host only."""
        raise pickle.PicklingError(
            f"it is or holds descriptor {fd}, which cannot go to a process on another host. Use "
            "fiber.Pipe, fiber.Queue or fiber.Array instead of multiprocessing's or a socket, or "
            "name the module that makes it to fiber.adopt()"
        )

    def forget(self) -> None:
        """Drop the collected grants: the object is pickled again, in another way."""
        handles.undo_pickling()

    DupFd = duplicate_for_child


def dumps(
    obj: Any,
    protocol: int | None = None,
    *,
    buffer_callback: Callable[[pickle.PickleBuffer], Any] | None = None,
    before_retry: Callable[[], None] = lambda: None,
) -> bytes:
    """Pickle ``obj``, by reference where possible.

    Objects of ``__main__`` go by value if the reader cannot import that module.
    """
    try:
        data = _dump(_Forking, obj, protocol, buffer_callback)
        if not (main_is_out_of_reach() and b"__main__" in data):
            return data
    except Exception:
        # cloudpickle tries next.  If it fails, too, its error gives the reason.
        pass
    before_retry()
    return _dump(_by_value_pickler(), obj, protocol, buffer_callback)


def dumps_by_value(function: FunctionType) -> bytes:
    """Pickle a function by value."""
    return _dump(_by_value_pickler(), function)


def encode(obj: Any) -> tuple[bytes, list[memoryview]]:
    """Pickle ``obj`` for a packet: the pickle, and large buffers beside it.

    Connections and queues in it can be unpickled once.
    """
    with handles.Pickling():
        return _encode(obj)


def encode_revocable(obj: Any) -> tuple[bytes, list[memoryview], Callable[[], None]]:
    """Encode an object that may not be sent.  Call the third value in that case."""
    with handles.Pickling() as pickling:
        return *_encode(obj), pickling.take_back


def _encode(obj: Any) -> tuple[bytes, list[memoryview]]:
    try:
        encoded = packet.dumps(obj)
        if not (main_is_out_of_reach() and b"__main__" in encoded[0]):
            return encoded
    except Exception:
        # cloudpickle tries next.  If it fails, too, its error gives the reason.
        pass
    handles.undo_pickling()
    return packet.dumps(obj, partial(_dump, _by_value_pickler()))


def encode_reusable(obj: Any) -> tuple[bytes, list[memoryview], handles.GrantSet | None]:
    """Encode an object that may be unpickled several times, such as a task that runs again.

    Connections and queues in it can be unpickled for as long as the third value is kept.
    """
    with handles.Pickling(reusable=True) as pickling:
        payload, buffers = _encode(obj)
        return payload, buffers, pickling.grants


def dump(obj: Any, file: Any, protocol: int | None = None) -> None:
    """Write the pickle of ``obj`` to ``file``."""
    file.write(dumps(obj, protocol))


def main_is_out_of_reach() -> bool:
    """Tell whether objects of ``__main__`` must travel by value.

    They must if the readers of the pickles cannot import ``__main__``, or must not import it.
    """
    if _readers_lack_main or "ps1" in vars(sys):  # an interactive session has no file
        return True
    main = vars(sys.modules["__main__"])
    spec = main.get("__spec__")
    return not _importable(spec and spec.name, main.get("__file__"))


@lru_cache(maxsize=1)
def _importable(name: str | None, file: str | None) -> bool:
    """Tell whether a main module can be imported as ``__mp_main__``, by name if it has one."""
    if name is not None:
        # Importing the __main__ of a package, folder or archive runs it: few have a guard.
        return name.rpartition(".")[2] != "__main__"
    # A program from standard input has the file name <stdin>.
    started_in: str = mp_process.ORIGINAL_DIR or ""  # type: ignore[attr-defined]
    return file is not None and os.path.isfile(os.path.join(started_in, file))


def readers_lack_main(lack: bool) -> None:
    """Note whether other processes lack the file of ``__main__``: if so, it goes by value."""
    global _readers_lack_main
    _readers_lack_main = lack


_readers_lack_main = False


class _Forking(ForkingPickler):
    """ForkingPickler that accepts ``buffer_callback``."""

    def __init__(self, file: Any, protocol: int | None, **options: Any) -> None:
        pickle.Pickler.__init__(self, file, protocol, **options)
        self.dispatch_table = copyreg.dispatch_table | self._extra_reducers  # type: ignore[attr-defined]


def _by_value_pickler() -> Any:
    import cloudpickle

    class ByValue(cloudpickle.Pickler):  # type: ignore[misc]
        dispatch_table: ClassVar[Any] = ChainMap(
            cast("Any", ForkingPickler)._extra_reducers,
            {io.TextIOWrapper: by_reference.reduce_file},
            cloudpickle.Pickler.dispatch_table,
        )

    return ByValue


def _dump(
    pickler: Any, obj: Any, protocol: int | None = None, buffer_callback: Any = None
) -> bytes:
    buffer = io.BytesIO()
    options = {"buffer_callback": buffer_callback} if buffer_callback else {}
    try:
        pickler(buffer, protocol or pickle.DEFAULT_PROTOCOL, **options).dump(obj)
    except RuntimeError as error:
        if _is_of_multiprocessing(error):
            raise pickle.PicklingError(_SHARED_BY_MULTIPROCESSING) from error
        raise
    return buffer.getvalue()


_SHARED_BY_MULTIPROCESSING = (
    "it is a lock, queue or array of multiprocessing, or holds one, and cannot be sent by Fiber. "
    "Make it with Fiber (fiber.Lock, fiber.Queue, fiber.Array), or name the module that makes it "
    "to fiber.adopt()"
)


def _is_of_multiprocessing(error: RuntimeError) -> bool:
    """Return whether this is multiprocessing's error for its locks and queues.

    Its text blames the start method, which is not the reason here.
    """
    text = str(error)
    return "SemLock" in text or "through inheritance" in text
