"""What is asked of a pool: calls and maps, and how they become messages."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from itertools import chain
from typing import Any, Protocol

from fiber import reduction
from fiber._engine.chunks import Pace
from fiber._engine.ledger import Batch, Job
from fiber._hub.handles import GrantSet
from fiber._runtime.reader import Reader
from fiber._wire import work


class Sink(Protocol):
    """Where the outcomes of a request go.  ``put`` and ``abort`` come under the pool's lock."""

    def put(self, start: int, outcomes: list[Any], mixed: bool) -> None:
        """Outcomes of the tasks from ``start`` on.  Each task's comes once, in any order.

        Unless ``mixed`` they are all plain values.
        """

    def end(self) -> None:
        """All tasks have theirs."""

    def abort(self, error: BaseException) -> None:
        """There will be no more, because of ``error``."""


class Function:
    """A function that workers are asked to apply, pickled once."""

    __slots__ = ("buffers", "data", "id", "kept", "name", "pace")

    def __init__(
        self,
        id_: int,
        name: str,
        data: bytes,
        buffers: Sequence[memoryview],
        kept: GrantSet | None,
        pace: Pace | None = None,
    ) -> None:
        self.kept = kept
        self.id = id_
        self.name = name
        self.data = data
        self.buffers = buffers
        self.pace = pace


class Call:
    """One function call: a task by itself."""

    __slots__ = ("buffers", "data", "kept", "name", "sink")

    def __init__(
        self,
        name: str,
        data: bytes,
        buffers: Sequence[memoryview],
        kept: GrantSet | None,
        sink: Sink,
    ) -> None:
        self.kept = kept
        self.name = name
        self.data = data
        self.buffers = buffers
        self.sink = sink

    def detach(self) -> None:
        """Keep what was passed as it is now: it will be sent later."""
        if self.buffers:
            self.buffers = [memoryview(bytes(buffer)) for buffer in self.buffers]


class Request:
    """A job of the ledger, and all that the ledger need not know of it.

    Without a ``sink`` each of its tasks is a Call with its own.
    """

    __slots__ = ("function", "job", "kept", "kind", "reader", "sink", "timeout")

    def __init__(
        self,
        kind: int,
        job: Job,
        *,
        function: Function | None = None,
        sink: Sink | None = None,
        timeout: float | None = None,
    ) -> None:
        self.kind = kind
        self.job = job
        self.function = function
        self.sink = sink
        self.timeout = timeout
        self.reader: Reader | None = None
        self.kept: list[GrantSet] = []
        """What lets workers unpickle the pipes and queues among the items."""

    def task_name(self, task: int, item: Any) -> str:
        """How errors call a task."""
        if isinstance(item, Call):
            return f"the call of {item.name}()"
        assert self.function is not None
        return f"task {task} of {self.function.name}()"


def name_of(function: Any) -> str:
    """What a person calls a function."""
    return getattr(function, "__qualname__", None) or repr(function)


def encode(
    request: Request, batch: Batch, known: dict[int, None], plain: bool
) -> tuple[bytes, Sequence[memoryview]]:
    """The message for a batch; ``known`` are the functions that its worker was sent.

    ``plain``: the items are known to pickle without the user's code.
    """
    items = batch.items
    if request.kind == work.CALLS:
        if len(items) == 1:
            return work.pack_calls([(items[0].data, items[0].buffers)]), items[0].buffers
        calls: list[Call] = list(items)
        buffers = list(chain.from_iterable(call.buffers for call in calls))
        return work.pack_calls([(call.data, call.buffers) for call in calls]), buffers
    function = request.function
    assert function is not None
    data, buffers = (pickle.dumps(items, 5), []) if plain else _encode_items(request, items)
    carry = function.id not in known
    head = work.Head(
        request.kind,
        0 if request.job.exact else batch.stride,
        request.job.unit,
        function.id,
        len(function.data) if carry else 0,
        len(function.buffers) if carry else 0,
    )
    message = work.pack_batch(head, function.data if carry else b"", data)
    if carry:
        known[function.id] = None
        return message, [*function.buffers, *buffers]
    return message, buffers


def _encode_items(request: Request, items: Any) -> tuple[bytes, list[memoryview]]:
    data, buffers, kept = reduction.encode_reusable(items)
    if kept is not None:
        request.kept.append(kept)
    if len(buffers) > work.BUFFERS:
        return reduction.dumps(items, 5), []
    return data, buffers


def is_plain(items: Any) -> bool:
    """Whether pickling ``items`` runs none of the user's code."""
    return type(items) in (range, str, bytes) or work.is_plain(items)
