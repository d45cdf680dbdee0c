"""What is asked of a pool, calls and maps, and how it becomes messages.

As in ``concurrent.futures``, a work item holds what to run and the future that gets the outcome;
here one item may be a map of a million tasks.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain
from typing import Any, Protocol

from fiber import reduction
from fiber._engine.charges import Limits
from fiber._engine.ledger import Batch, Job
from fiber._hub.handles import GrantSet
from fiber._runtime.functions import Function, name_of
from fiber._runtime.input_stream import InputStream
from fiber._wire import packet, work


class Future(Protocol):
    """Where the outcomes of a work item, or of one call, go.  Called on the loop's thread."""

    def add_results(self, start: int, outcomes: list[Any], mixed: bool, size: int = 0) -> bool:
        """Outcomes of the tasks from ``start`` on.  Each task's comes once, in any order.

        Unless ``mixed`` they are all plain values.  They came in ``size`` bytes.  True asks for no
        more than must be, since nobody reads them: until it says otherwise, by what it was given
        for that.
        """

    def has_room(self) -> bool:
        """Whether it takes more again, after it has asked for no more."""

    def lift_bound(self) -> None:
        """Take all that comes: whoever would read them waits for the rest."""

    def set_done(self) -> None:
        """All tasks have theirs."""

    def set_exception(self, error: BaseException) -> None:
        """There will be no more, because of ``error``."""


class Cancellable(Future, Protocol):
    """The future of a call that may be cancelled until it is given to a worker."""

    def claim(self) -> bool:
        """It is about to be; False if it was cancelled.  May be asked again."""

    def cancel(self) -> bool:
        """Nobody wants it any more; False if it was claimed."""

    def cancelled(self) -> bool:
        """Whether nobody does."""


class Call:
    """One function call, pickled: a task by itself."""

    __slots__ = ("blocking", "buffers", "data", "future", "grants", "name")

    def __init__(
        self,
        name: str,
        data: bytes,
        buffers: Sequence[memoryview],
        grants: GrantSet | None,
        future: Future,
    ) -> None:
        self.grants = grants
        self.name = name
        self.data = data
        self.buffers = buffers
        self.future = future
        self.blocking = False
        """Whether a thread does nothing but wait for it."""

    def copy_buffers(self) -> None:
        """Keep what was passed as it is now: the caller goes on before it is sent."""
        if self.buffers:
            self.buffers = packet.kept(self.buffers)

    def message(self) -> bytes:
        """It alone as a message, its buffers beside."""
        return work.pack_calls([(self.data, self.buffers)])


class WorkItem:
    """A job of the ledger, and all that the ledger need not know of it.

    Without a ``future`` each of its tasks is a Call with its own.  A job and its work item know
    each other, its future and its stream; ``Jobs`` parts them once it is over, so that results are
    freed when the user lets go of them, not when the collector comes.
    """

    __slots__ = (
        "cancellable",
        "exact",
        "function",
        "future",
        "grants",
        "job",
        "kind",
        "limits",
        "stream",
        "timeout",
        "unit",
    )

    def __init__(
        self,
        kind: int,
        *,
        function: Function | None = None,
        future: Future | None = None,
        unit: int = 1,
        exact: bool = False,
        timeout: float | None = None,
        limits: Limits | None = None,
        cancellable: bool = False,
    ) -> None:
        self.kind = kind
        self.function = function
        self.future = future
        self.unit = unit
        self.exact = exact
        self.timeout = timeout
        self.limits = limits
        """None: as its pool says."""
        self.cancellable = cancellable
        """Whether the futures of its calls are."""
        self.job: Job | None = None
        """Once the executor has taken it."""
        self.stream: InputStream | None = None
        self.grants: list[GrantSet] = []
        """What lets workers unpickle the pipes and queues among the items."""

    def task_name(self, task: int, item: Any) -> str:
        """How errors call a task."""
        if isinstance(item, Call):
            return f"the call of {item.name}()"
        assert self.function is not None
        return f"task {task} of {self.function.name}()"


def pickle_call(
    future: Future,
    function: Callable[..., Any],
    args: Iterable[Any],
    kwargs: Mapping[str, Any],
    reject: Callable[[Future, BaseException], None],
) -> Call | None:
    """A call, pickled; None if it does not pickle, and ``reject`` has told its future."""
    try:
        data, buffers, grants = reduction.encode_reusable((function, args, kwargs))
        if len(buffers) > work.BUFFERS:
            data, buffers = reduction.dumps((function, args, kwargs), 5), []
    except Exception as error:
        reject(future, _blame_call(function, args, kwargs, error))
        return None
    return Call(name_of(function), *work.beside((data, buffers)), grants, future)


def _blame_call(
    function: Callable[..., Any],
    args: Iterable[Any],
    kwargs: Mapping[str, Any],
    error: Exception,
) -> Exception:
    """What the caller hears of a call that does not pickle."""
    name = name_of(function)
    if not isinstance(args, Sequence) or not isinstance(kwargs, Mapping):
        args, kwargs = (), {}
    parts = {f"argument {at} of {name}()": value for at, value in enumerate(args)}
    parts |= {f"argument {key!r} of {name}()": value for key, value in kwargs.items()}
    parts[f"the function {name}"] = function
    return reduction.blame(parts, error, f"the call of {name}()")


def is_wanted(call: Any) -> bool:
    """Whether a call that waits was not cancelled; who waits for one that was hears so."""
    return not call.future.cancelled() or call.future.claim()


def claim(batch: Batch) -> bool:
    """Whether all calls of a batch are still wanted: then none can be cancelled any more."""
    return all(call.future.claim() for call in batch.items)


def blame_items(item: WorkItem, batch: Batch, error: Exception) -> Exception:
    """What the caller hears of tasks that cannot be sent."""
    if len(batch.items) != 1 or item.function is None:
        return error
    name = item.task_name(batch.start, batch.items[0])
    return reduction.blame({f"the item of {name}": batch.items[0]}, error)


def pickles_without_user_code(item: WorkItem, batch: Batch) -> bool:
    """Whether ``encode`` may run where the user's code must not."""
    items = batch.items
    return item.kind == work.CALLS or type(items) in (range, str, bytes) or work.is_plain(items)


Encoded = work.Pickle
"""Pickled items, and the buffers beside them."""


def encode(item: WorkItem, batch: Batch, *, plain: bool) -> Encoded:
    """The items of a batch; ``plain`` says that pickling them runs none of the user's code."""
    if item.kind == work.CALLS:
        calls: list[Call] = list(batch.items)
        if len(calls) == 1:
            return calls[0].message(), calls[0].buffers
        buffers = list(chain.from_iterable(call.buffers for call in calls))
        return work.pack_calls([(call.data, call.buffers) for call in calls]), buffers
    if plain:
        return work.beside((pickle.dumps(batch.items, 5), []))
    items = tuple(batch.items) if type(batch.items) is list else batch.items
    data, buffers, grants = reduction.encode_reusable(items)
    if grants is not None:
        item.grants.append(grants)
    if len(buffers) > work.BUFFERS:
        data, buffers = reduction.dumps(batch.items, 5), []
    return work.beside((data, buffers))


def pack(item: WorkItem, batch: Batch, encoded: Encoded, known: dict[int, None]) -> Encoded:
    """The whole message for a batch; ``known`` are the functions that its worker was sent."""
    data, buffers = encoded
    function = item.function
    if function is None:
        return encoded
    carry = function.id not in known
    head = work.Head(
        item.kind,
        0 if item.exact else batch.stride,
        item.unit,
        function.id,
        (len(function.data) or work.BESIDE) if carry else 0,
        len(function.buffers) if carry else 0,
    )
    batch.has_function = carry
    if not carry:
        return work.pack_batch(head, b"", data), buffers
    known[function.id] = None
    return work.pack_batch(head, function.data, data), [*function.buffers, *buffers]
