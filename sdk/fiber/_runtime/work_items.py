"""Work items of a pool: calls and maps, the functions that they apply, and their input.

As in ``concurrent.futures``, a work item holds what to run and the future that gets the outcome.
Here one item may be a map of a million tasks.
"""

from __future__ import annotations

import contextlib
import itertools
import queue
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

from fiber import reduction
from fiber._agent.by_value import FUNCTIONS
from fiber._engine.chunks import TaskPace
from fiber._engine.fanout import COPIES, WORTH
from fiber._engine.tasks import Job, Limits
from fiber._hub.handles import GrantSet
from fiber._runtime.by_value import FUNCTION_SIZE, FunctionPickles
from fiber._runtime.threads import check_may_wait
from fiber._transport.loop import DOZE
from fiber._wire import packet, work
from fiber._wire.memory_files import share

AHEAD = 3
"""Messages for each worker whose tasks a stream reads before the worker can take them."""


class Function:
    """Function that a pool applies, pickled once."""

    __slots__ = ("buffers", "data", "grants", "id", "name", "pace")

    def __init__(
        self,
        id_: int,
        name: str,
        data: bytes,
        buffers: Sequence[memoryview],
        grants: GrantSet | None,
        pace: TaskPace | None = None,
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
    """Recognizes functions by their pickles.  Runs on any thread.

    ``passes_on``: agents pass blobs on to each other.  Then large buffers become blobs, if there
    are so many ``workers`` that it pays.
    """

    def __init__(self, passes_on: bool, workers: int) -> None:
        self._shares = passes_on and workers > COPIES
        self.light = FunctionPickles().light
        """Return what to pickle in place of a function."""
        self._known: dict[bytes, Function] = {}
        self._ids = itertools.count(1)

    def get(self, function: Callable[..., Any]) -> Function:
        """Return ``function``, pickled.  Equal pickles are the same Function."""
        try:
            data, buffers, grants = reduction.encode_reusable(self.light(function))
        except reduction.REFUSALS as error:
            what = f"the function {name_of(function)}"
            raise reduction.blame({what: function}, error) from error
        known = self._known.get(data)
        if known is not None:
            return known
        sent = work.move_beside((data, buffers))
        self.share(sent[1])
        made = Function(next(self._ids), name_of(function), *sent, grants)
        if not buffers and grants is None and len(data) <= FUNCTION_SIZE:
            if len(self._known) >= FUNCTIONS:
                self._known.clear()  # in one step, as several threads may call this
            self._known[data] = made
        return made

    def share(self, buffers: Sequence[memoryview]) -> None:
        """Make blobs of large buffers that go to many workers."""
        for buffer in buffers if self._shares else ():
            if buffer.nbytes >= WORTH:
                share(buffer)


class InputClosed(Exception):
    """End of a stream that was closed before the reader came to the end of the input."""


class InputStream:
    """Input of one job, read from an iterator no faster than workers run it.

    It is a bounded queue between the reading thread (the caller's, or a feeder's) and the executor.
    The executor grants the reader credit: the number of items that it may read.  When the credit
    is used up, the reader waits at a queue of grants.

    ``limit`` bounds the tasks that are read and not consumed; ``consumed`` returns how many were
    consumed.  ``notify`` is called when the executor can go on: when there is input (on the reading
    thread), or when there is room below the limit (on the user's thread).
    """

    def __init__(
        self,
        unit: int,
        notify: Callable[[], None],
        limit: int | None = None,
        consumed: Callable[[], int] = lambda: 0,
    ) -> None:
        self.ended = False
        """True once reading has ended."""
        self._unit = unit
        self._limit = None if limit is None else max(limit, unit)
        self._consumed = consumed
        self._notify = notify
        self._items: deque[Any] = deque()
        self._credit: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._granted = 0
        self._taken = 0
        self._closed = False
        self._awaited = True
        self._refused = 0  # number of times that the executor looked for room
        self._asked = 0  # value of ``_refused`` when it found room, or was last notified

    # The reading thread

    def read(self, iterable: Iterable[Any]) -> None:
        """Read all of ``iterable`` on this thread; raise the errors of the iterable.

        Raise InputClosed if ``close`` stops the reader before the end.
        """
        check_may_wait()
        iterator = iter(iterable)
        items, unit = self._items, self._unit
        chunk: list[Any] = []
        while (credit := self._next_credit()) > 0:
            left = credit
            for item in itertools.islice(iterator, credit):
                left -= 1
                chunk.append(item)
                if len(chunk) == unit:
                    items.extend(chunk)
                    chunk.clear()
                    if self._awaited:
                        self._awaited = False
                        self._notify()
                if self.ended:
                    return
            if left:
                items.extend(chunk)
                return
        if self._closed:
            raise InputClosed

    def _next_credit(self) -> int:
        while True:
            with contextlib.suppress(queue.Empty):
                return self._credit.get(timeout=DOZE)  # not longer: see ``threads``

    def read_on_thread(
        self, iterable: Iterable[Any], finish: Callable[[BaseException | None], None]
    ) -> None:
        """Read all of ``iterable`` on a new thread, and ``finish`` with its error, if it raised."""

        def run() -> None:
            error = None
            try:
                self.read(iterable)
            except BaseException as raised:
                error = raised
            finish(error)

        try:
            threading.Thread(target=run, name="fiber-pool-feeder", daemon=True).start()
        except RuntimeError as error:  # the system has no room for the thread
            finish(error)

    # The user's thread

    def ask(self) -> None:
        """Notify the executor that the user took results, if it found no room before.

        The mark is set after the notification, so an interrupted user notifies again next time.
        """
        refused = self._refused
        if self._asked < refused:
            self._notify()
            self._asked = refused

    # The executor

    def take(self) -> list[Any]:
        """Take the items that were read."""
        items = self._items
        taken = [items.popleft() for _ in range(len(items))]
        self._taken += len(taken)
        return taken

    def await_input(self) -> None:
        """Ask to be notified of input.  Call ``take`` after this: input may have come before."""
        self._awaited = True

    def grant(self, waiting: int, workers: int, pace: TaskPace, target: float) -> None:
        """Let the reader go on if few tasks are left; ``waiting`` of them have no worker yet."""
        bound = AHEAD * max(workers, 1) * max(pace.message_size(target), self._unit)
        ahead = waiting + self._granted - self._taken
        if self.ended or self._closed or 2 * ahead > bound:
            return
        units = -(-(bound - ahead) // self._unit)
        if self._limit is not None:
            self._refused += 1  # before the count: a user that consumes after it notifies
            units = min(units, self._room(self._limit) // self._unit)
        if units:
            self._asked = self._refused
            self._let_read(units)

    def _let_read(self, units: int) -> None:
        self._granted += units * self._unit
        self._credit.put(units * self._unit)

    def _room(self, limit: int) -> int:
        return limit - (self._granted - self._consumed())

    def lift_limit(self) -> None:
        """Read without a limit, for a caller that waits for all results and consumes none."""
        self._limit = None

    def close(self) -> None:
        """Have the reader use the room that is left below the limit, and stop.

        Do nothing if there is no limit: the caller wants all of the input.
        """
        if self._limit is None or self._closed:
            return
        self._closed = True
        units = self._room(self._limit) // self._unit
        if units > 0:
            self._let_read(units)
        self._credit.put(0)

    def end(self) -> None:
        """Stop reading."""
        self.ended = True
        self._credit.put(0)


class TaskFuture(Protocol):
    """Receiver of the outcomes of a work item, or of one call.  Runs on the loop thread."""

    def add_results(self, start: int, outcomes: list[Any], mixed: bool, size: int = 0) -> bool:
        """Take the outcomes of the tasks from ``start`` on.  Batches come in any order, each once.

        Unless ``mixed``, all outcomes are plain values.  They came in ``size`` bytes.  Return True
        to pause the job because no user reads the results; ``PoolExecutor.resume`` ends the pause.
        """

    def has_room(self) -> bool:
        """Tell whether to end the pause that ``add_results`` asked for."""

    def lift_bound(self) -> None:
        """Ask for no pause from now on: the user waits for all results."""

    def set_done(self) -> None:
        """Note that all tasks have their outcomes."""

    def set_exception(self, error: BaseException) -> None:
        """End the outcomes with ``error``."""


class CancellableFuture(TaskFuture, Protocol):
    """The future of a call that may be cancelled until it is given to a worker."""

    def claim(self) -> bool:
        """Claim the call for a worker; return False if it was cancelled.  May be repeated."""

    def cancel(self) -> bool:
        """Cancel the call; return False if it was claimed."""

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
        future: TaskFuture,
        blocking: bool = False,
    ) -> None:
        self.grants = grants
        self.name = name
        self.data = data
        self.buffers = buffers
        self.future = future
        self.blocking = blocking
        """True if a thread waits for the outcome at once."""

    def copy_buffers(self) -> None:
        """Copy the buffers: the caller may change the objects before the call is sent."""
        if self.buffers:
            self.buffers = packet.kept(self.buffers)

    def message(self) -> bytes:
        """Return a message with this call alone.  Its buffers go beside it."""
        return work.pack_calls([(self.data, self.buffers)])


class WorkItem:
    """A call, a map or a stream of calls: what to run, and the future for the outcomes.

    Without a ``future`` each of its tasks is a Call, which has one.  A work item refers to its job
    in the ledger, its future and its stream, and they to it.  ``Jobs`` cuts these references when
    the job is over.  So results are freed as soon as the user drops them.
    """

    __slots__ = (
        "cancellable",
        "eager",
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
        future: TaskFuture | None = None,
        unit: int = 1,
        eager: bool = False,
        timeout: float | None = None,
        limits: Limits | None = None,
        cancellable: bool = False,
    ) -> None:
        self.kind = kind
        self.function = function
        self.future = future
        self.unit = unit
        self.eager = eager
        """True if results are wanted one by one, as with ``chunksize=1``."""
        self.timeout = timeout
        self.limits = limits
        """Limits of lost runs; None stands for the pool's."""
        self.cancellable = cancellable
        """True if the futures of its calls can be cancelled."""
        self.job: Job | None = None
        """Job in the ledger, once the executor has taken the item."""
        self.stream: InputStream | None = None
        self.grants: list[GrantSet] = []
        """Grants by which workers attach to the pipes and queues among the items."""

    def task_name(self, task: int, item: Any) -> str:
        """Return the name of a task, for messages."""
        if isinstance(item, Call):
            return f"the call of {item.name}()"
        assert self.function is not None
        return f"task {task} of {self.function.name}()"


def pickle_call(
    functions: FunctionCache,
    future: TaskFuture,
    function: Callable[..., Any],
    args: Iterable[Any],
    kwargs: Mapping[str, Any],
    reject: Callable[[TaskFuture, BaseException], None],
    blocking: bool = False,
) -> Call | None:
    """Pickle a call; if that fails, pass the error to ``reject`` and return None."""
    try:
        call = functions.light(function), args, kwargs
        data, buffers, grants = reduction.encode_reusable(call)
        if len(buffers) > work.BUFFERS:
            data, buffers = reduction.dumps(call, 5), []
    except Exception as error:
        reject(future, _blame_call(function, args, kwargs, error))
        return None
    return Call(name_of(function), *work.move_beside((data, buffers)), grants, future, blocking)


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
    """Return False if a waiting call was cancelled; ``claim`` then notifies its waiters."""
    return not call.future.cancelled() or call.future.claim()
