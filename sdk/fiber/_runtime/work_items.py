"""Work items of a pool, which are calls and maps, and their messages.

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
    """Receiver of the outcomes of a work item, or of one call.  Called on the loop's thread."""

    def add_results(self, start: int, outcomes: list[Any], mixed: bool, size: int = 0) -> bool:
        """Outcomes of the tasks from ``start`` on.  Each task's comes once, in any order.

        Unless ``mixed`` they are all plain values.  They came in ``size`` bytes.  True asks for no
        more than must be, since nobody reads them: until it says otherwise, by what it was given
        for that.
        """

    def has_room(self) -> bool:
        """Tell whether it takes more outcomes, after it has asked for no more."""

    def lift_bound(self) -> None:
        """Take all that comes: whoever would read them waits for the rest."""

    def set_done(self) -> None:
        """Note that all tasks have their outcomes."""

    def set_exception(self, error: BaseException) -> None:
        """End the outcomes with ``error``."""


class Cancellable(Future, Protocol):
    """The future of a call that may be cancelled until it is given to a worker."""

    def claim(self) -> bool:
        """Claim the call for a worker; False if it was cancelled.  May be called again."""

    def cancel(self) -> bool:
        """Cancel the call; False if it was claimed."""

    def cancelled(self) -> bool:
        """Tell whether the call was cancelled."""


class Call:
    """Pickled function call, which is one task."""

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
        """True if a thread only waits for the outcome."""

    def copy_buffers(self) -> None:
        """Keep what was passed as it is now: the caller goes on before it is sent."""
        if self.buffers:
            self.buffers = packet.kept(self.buffers)

    def message(self) -> bytes:
        """Return a message with this call alone.  Its buffers go beside it."""
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
        """True if the futures of its calls can be cancelled."""
        self.job: Job | None = None
        """Once the executor has taken it."""
        self.stream: InputStream | None = None
        self.grants: list[GrantSet] = []
        """Grants with which workers unpickle the pipes and queues among the items."""

    def task_name(self, task: int, item: Any) -> str:
        """Return the name of a task, for messages."""
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
    """Return the error of a call that does not pickle."""
    name = name_of(function)
    if not isinstance(args, Sequence) or not isinstance(kwargs, Mapping):
        args, kwargs = (), {}
    parts = {f"argument {at} of {name}()": value for at, value in enumerate(args)}
    parts |= {f"argument {key!r} of {name}()": value for key, value in kwargs.items()}
    parts[f"the function {name}"] = function
    return reduction.blame(parts, error, f"the call of {name}()")


def is_wanted(call: Any) -> bool:
    """Tell whether a waiting call was not cancelled.  If it was, its waiters are notified."""
    return not call.future.cancelled() or call.future.claim()


def claim(batch: Batch) -> bool:
    """Claim all calls of a batch; return False if one was cancelled."""
    return all(call.future.claim() for call in batch.items)


def blame_items(item: WorkItem, batch: Batch, error: Exception) -> Exception:
    """Return the error of tasks that cannot be sent."""
    if len(batch.items) != 1 or item.function is None:
        return error
    name = item.task_name(batch.start, batch.items[0])
    return reduction.blame({f"the item of {name}": batch.items[0]}, error)


def pickles_without_user_code(item: WorkItem, batch: Batch) -> bool:
    """Tell whether ``encode`` runs none of the user's code for this batch."""
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
