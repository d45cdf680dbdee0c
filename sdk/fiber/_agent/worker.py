"""The loop of a pool worker: read a batch, run its tasks, send the results.

A worker reads one message at a time, so that its agent can take unread messages back from the
kernel.  Before each task, or each stride of very short tasks, it notes its position in shared
memory.  So if the worker dies, the agent knows the task.

The watchdog is the worker's second thread and splits slow batches.  A message carries many short
tasks.  One of them may take long, or wait until the program has the result of another.  When a
batch has run for a while, the watchdog sends its results and gives back the tasks that have not
begun, for other workers.
"""

from __future__ import annotations

import contextlib
import pickle
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import islice, starmap
from types import FrameType
from typing import Any

from fiber._agent import child, functions
from fiber._agent.batch_results import BatchResults, ResultChannel
from fiber._agent.exception_pickles import encode_error, format_error
from fiber._hub.remote import Taken, confirm, loads
from fiber._wire import work
from fiber._wire.packet import Message
from fiber._worker_images import missing_module

SMALL = frozenset({int, float, bool, type(None)})
"""Types of values that a single call sends without BatchResults."""

_Function = Callable[..., Any]

_REPLIED = object()
"""Marker in place of a function: a reply to the batch was sent already."""

_OURS = frozenset({__file__, functions.__file__})
"""Files whose frames are between this loop and the task."""


def run(
    initializer: Callable[..., object] | None,
    initargs: Iterable[Any],
    retryable: tuple[type[BaseException], ...],
) -> None:
    """Run a pool worker: the target of its process."""
    channel = child.task_channel()
    if initializer is not None:
        try:
            initializer(*initargs)
        except SystemExit:
            raise
        except BaseException as error:
            with contextlib.suppress(OSError):  # the agent is gone
                words = work.INIT_FAILED, format_error(error), missing_module(error)
                channel.send(pickle.dumps(words))
            raise SystemExit(1) from None
    worker = BatchRunner(channel, child.progress(), retryable)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, worker.interrupt)
    try:
        channel.send(pickle.dumps((work.READY,)))
        while worker.handle(channel.recv()):
            pass
    except (EOFError, ConnectionError):  # the agent is gone
        pass
    worker.close()


class BatchRunner:
    """Runner of batches.

    ``progress``: three words that the agent shares.  Batch and index of the running task, and
    whether the host is about to end, so that the tasks which have not begun are returned.
    """

    def __init__(
        self,
        channel: ResultChannel,
        progress: memoryview,
        retryable: tuple[type[BaseException], ...] = (),
    ) -> None:
        self._channel = channel
        self._progress = progress
        self._retryable = retryable
        self._functions = functions.KnownFunctions()
        self._watchdog = Watchdog()
        self._interruptible = False

    def close(self) -> None:
        """End the watchdog thread, if it runs."""
        self._watchdog.stop()

    def interrupt(self, signum: int, frame: object) -> None:
        """Raise KeyboardInterrupt in a running task; the handler of SIGINT.

        Between tasks the exception would lose a batch, or half of its results.
        """
        if self._interruptible:
            raise KeyboardInterrupt

    def handle(self, message: Message) -> bool:
        """Run and answer one message; return False if it is STOP."""
        started = time.perf_counter()
        payload = message.payload
        (seq,) = work.SEQ.unpack_from(payload)
        head = work.Head.unpack_from(payload, work.SEQ.size)
        try:
            if head.kind != work.STOP:
                self._run_message(seq, head, payload[work.BODY :], message.buffers, started)
        finally:
            message.release()
        return head.kind != work.STOP

    def _run_message(
        self, seq: int, head: work.Head, body: memoryview, buffers: list[memoryview], started: float
    ) -> None:
        if head.kind == work.CALLS and head.size == 1:
            self._run_call(seq, body, buffers, started)
            return
        if head.kind == work.CALLS:
            items: Any = list(work.unpack_calls(body, head.size))
            taken: Taken = []
            function: Any = _Caller(buffers, taken)
        else:
            loading = time.perf_counter()
            function = self._function(seq, head, body, buffers)
            if function is _REPLIED:
                return
            # A function that takes long to unpickle must not pass for slow tasks.
            started += time.perf_counter() - loading
            pickled = body if head.size == work.BESIDE else body[head.size :]
            try:
                items, taken = loads(*work.take_beside(pickled or None, buffers[head.buffers :]))
            except BaseException as error:
                self._reply(work.UNREADABLE, seq, encode_error(error))
                return
            buffers.clear()
        batch = self._start(seq, items, started, taken, eager=not head.stride)
        del items  # the iterator frees the items at its end
        self._note(seq)
        self._run(batch, function, head, started)
        batch.flush()

    def _run_call(
        self, seq: int, body: memoryview, buffers: list[memoryview], started: float
    ) -> None:
        """Run and answer a single call, on the fast path that every ``apply`` takes."""
        self._note(seq)
        taken: Taken = []
        try:
            self._interruptible = True
            ((data, _),) = work.unpack_calls(body, 1)
            (function, args, kwargs), taken = loads(*work.take_beside(data, buffers))
            del data
            buffers.clear()  # frees unused buffers during the call
            value = function(*args, **kwargs)
            self._interruptible = False
            del function, args, kwargs  # frees them before the value is pickled
        except BaseException as error:
            self._interruptible = False
            if isinstance(error, SystemExit):
                _report_exit(error)
            batch = self._start(seq, (), started, taken, eager=True)
            batch.fail(error)
            batch.flush()
            if isinstance(error, SystemExit):
                raise
            return
        if type(value) in SMALL:
            confirm(taken)
            self._reply(seq, 0, None, time.perf_counter() - started, [value], ())
        else:
            batch = self._start(seq, (), started, taken, eager=True)
            batch.add(value)
            del value  # it may be large, and is pickled already
            batch.flush()

    def _start(
        self, seq: int, items: Any, started: float, taken: Taken, *, eager: bool
    ) -> BatchResults:
        return BatchResults(
            self._channel,
            seq,
            iter(items),
            len(items),
            eager=eager,
            started=started,
            taken=taken,
            retryable=self._retryable,
        )

    def _note(self, seq: int) -> None:
        """Note that the first task of a batch begins."""
        progress = self._progress
        progress[0] = 0
        progress[1] = 0
        progress[0] = seq

    def _function(
        self, seq: int, head: work.Head, body: memoryview, buffers: list[memoryview]
    ) -> Any:
        """Return the function of a batch, or _REPLIED."""
        known = self._functions
        if not head.size and head.function not in known:
            self._reply(work.UNKNOWN, seq)
            return _REPLIED
        try:
            if head.size:
                inline = None if head.size == work.BESIDE else body[: head.size]
                known.learn(head.function, *work.take_beside(inline, buffers[: head.buffers]))
            return known.get(head.function, head.unit, eager=not head.stride)
        except BaseException as error:
            self._reply(work.BROKEN, seq, encode_error(error))
            return _REPLIED

    def _reply(self, *words: Any) -> None:
        self._channel.send(pickle.dumps(words))

    # Running

    def _run(
        self, batch: BatchResults, function: _Function, head: work.Head, started: float
    ) -> None:
        # Chunks that the user asked for stay whole.  The watchdog may split other batches.
        if batch.total > 1 and head.unit == 1:
            # A first call starts the watchdog's thread, which inherits this thread's priority.
            self._watchdog.begin(batch)
        if head.stride > 1:
            apply = starmap if head.kind == work.STAR else map
            self._run_in_strides(batch, lambda some: apply(function, some), head, started)
        else:
            single = _spread(function) if head.kind == work.STAR else function
            if batch.eager:
                self._run_eagerly(batch, single)
            else:
                self._run_singly(batch, single, head, started)
        self._watchdog.end()

    def _run_eagerly(self, batch: BatchResults, function: _Function) -> None:
        """Run the tasks one by one; note each position; encode each result at once."""
        progress, values, numbers = self._progress, batch.values, work.NUMBERS
        for index, item in enumerate(batch.remaining):
            progress[1] = index
            try:
                self._interruptible = True
                value = function(item)
                self._interruptible = False
            except BaseException as error:
                self._interruptible = False
                if self._failed(batch, error):
                    raise
                continue
            if type(value) in numbers:
                values.append(value)
            elif batch.add(value):
                value = None  # it may be large, and is pickled already
                batch.flush()
            if progress[2]:
                batch.return_unstarted()

    def _run_singly(
        self, batch: BatchResults, function: _Function, head: work.Head, started: float
    ) -> None:
        """Run the tasks one by one; note each position; encode the results later, together."""
        progress, values = self._progress, batch.values
        for index, item in enumerate(batch.remaining):
            progress[1] = index
            try:
                self._interruptible = True
                value = function(item)
                self._interruptible = False
            except BaseException as error:
                self._interruptible = False
                if self._failed(batch, error):
                    raise
            else:
                values.append(value)
            slow = time.perf_counter() - started > SPLIT_AFTER
            if (slow and not len(values) % head.unit) or progress[2]:
                batch.encode_new()
                del item  # it may refer to an object of another host, which would be kept
                batch.return_unstarted()
        batch.encode_new()

    def _run_in_strides(
        self,
        batch: BatchResults,
        apply: Callable[[Iterable[Any]], Iterator[Any]],
        head: work.Head,
        started: float,
    ) -> None:
        """Run several tasks at a time, at the speed of ``map``; no stride crosses a chunk's end."""
        values, unit = batch.values, head.unit
        while True:
            done = self._progress[1] = len(values)
            size = head.stride if unit == 1 else min(head.stride, unit - done % unit)
            more = self._extend(batch, apply(islice(batch.remaining, size)), size)
            batch.encode_new()
            if not more:
                return
            slow = time.perf_counter() - started > SPLIT_AFTER
            if (slow and len(values) % unit == 0) or self._progress[2]:
                batch.return_unstarted()

    def _extend(self, batch: BatchResults, results: Iterator[Any], size: int) -> bool:
        """Run the tasks of one stride; return False if no tasks are left."""
        values = batch.values
        stop = len(values) + size
        while True:
            try:
                self._interruptible = True
                values.extend(results)
                self._interruptible = False
            except BaseException as error:
                self._interruptible = False
                # If no task is running, SIGINT came after the last one: there is no task to fail.
                if batch.started() > len(values) and self._failed(batch, error):
                    raise
                continue
            if len(values) == stop:
                return True
            if batch.started() == len(values):
                return False
            # ``extend`` takes a task's StopIteration for the end of the iterator.
            batch.fail(StopIteration())

    def _failed(self, batch: BatchResults, error: BaseException) -> bool:
        """Record a task's error; return whether it ends this process, as in multiprocessing."""
        if isinstance(error, SystemExit):
            _report_exit(error)  # first: the result may end the program
        batch.fail(error)
        if not isinstance(error, SystemExit):
            return False
        # Send the results of earlier tasks.
        self._watchdog.end()
        if not batch.eager:
            batch.encode_new()
        batch.return_unstarted()
        return True


def _report_exit(error: SystemExit) -> None:
    """Print which task ends this worker: the program may end without a message."""
    import traceback  # rarely needed, and long to import

    frames = [frame for frame in traceback.walk_tb(error.__traceback__) if not _is_ours(frame[0])]
    on_sigterm = getattr(signal.getsignal(signal.SIGTERM), "__code__", None)
    if any(frame.f_code is on_sigterm for frame, _ in frames):
        return  # The pool ends this worker.
    task = "a task"
    if frames:
        (frame, line), *_ = frames
        code = frame.f_code
        task = f"the task {code.co_qualname}() ({code.co_filename}:{line})"
    with contextlib.suppress(Exception):  # the program may have closed stderr
        print(
            f"fiber: {task} called sys.exit({error.code!r}). That ends its worker, and SystemExit "
            "ends the program that asks for the result. Return from the task, or raise another "
            "exception",
            file=sys.stderr,
            flush=True,
        )


def _is_ours(frame: FrameType) -> bool:
    return frame.f_code.co_filename in _OURS


def _spread(function: _Function) -> _Function:
    return lambda arguments: function(*arguments)


class _Caller:
    """Runner of pickled calls, whose buffers follow one another in ``buffers``."""

    def __init__(self, buffers: list[memoryview], taken: Taken) -> None:
        self._buffers = iter(list(buffers))
        self._taken = taken

    def __call__(self, call: tuple[memoryview | None, int]) -> Any:
        data, count = call
        pickled = work.take_beside(data, list(islice(self._buffers, count)))
        (function, args, kwargs), taken = loads(*pickled)
        self._taken += taken
        return function(*args, **kwargs)


SPLIT_EAGER_AFTER = 10e-3
"""Seconds that a batch may run before it is split, if its results are wanted one by one."""

SPLIT_AFTER = 40e-3
"""Seconds that another batch may run before it is split.

Both limits are a few times the duration of the tasks that one message should carry.
"""


class Watchdog:
    """Watchdog over one batch after the other, whose thread sleeps while there is none."""

    def __init__(self) -> None:
        self._batch: BatchResults | None = None
        self._asleep = False
        self._wake: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._started = False
        self._stopped = False

    def begin(self, batch: BatchResults) -> None:
        """Watch ``batch``, which starts to run."""
        self._batch = batch
        if self._asleep:
            self._asleep = False
            self._wake.put(None)
        elif not self._started:
            self._started = True
            threading.Thread(target=self._run, name="fiber-watchdog", daemon=True).start()

    def end(self) -> None:
        """Stop watching the batch, which has run."""
        self._batch = None

    def stop(self) -> None:
        """End the thread."""
        self._stopped = True
        self._wake.put(None)

    def _run(self) -> None:
        seen = None
        while not self._stopped:
            # Sleep if no batch runs, or if this thread has split it already.  ``_asleep`` is set
            # before ``_batch`` is read: a batch that begins after the read puts a wake-up.
            self._asleep = True
            if self._batch is None or self._batch.seq == seen:
                self._wake.get()
            batch = self._wait_for_slow_batch()
            if batch is not None:
                seen = batch.seq
                try:
                    batch.return_unstarted()
                except OSError:  # the executor is gone, and this process will end too
                    return
                del batch  # its results must not live until the next batch

    def _wait_for_slow_batch(self) -> BatchResults | None:
        """Wait for a batch that runs for too long; return None once no batch runs.

        A batch is not returned before its first task has begun: the worker must keep one task.
        """
        while (batch := self._batch) is not None:
            time.sleep(SPLIT_EAGER_AFTER if batch.eager else SPLIT_AFTER)
            if self._batch is batch and batch.started():
                return batch
        return None
