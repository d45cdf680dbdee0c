"""The results of one batch of a pool worker: collected, made safe to send, sent in pieces.

Two threads use them.  The thread that runs the tasks appends results; the watchdog
(``worker.Watchdog``) may send them.  The watchdog sends what is in ``values``, so the pickle and
buffers of a value are stored before the value is appended.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Iterator, Sequence
from multiprocessing.reduction import ForkingPickler
from operator import length_hint
from typing import Any, Protocol

from fiber._agent import by_reference
from fiber._agent.exception_pickles import encode_error, unsendable
from fiber._hub.remote import Taken, confirm
from fiber._wire import packet, work

_MANY_BUFFERS = packet.MAX_BUFFERS - work.BUFFERS - 1
"""Buffers above which those of one more value may be too many for a message."""


class ResultChannel(Protocol):
    """Sending side of a channel."""

    def send(self, payload: bytes, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message, waiting for room."""


class BatchResults:
    """Results of batch ``seq``, which has ``total`` tasks.

    ``remaining`` yields the tasks to begin.  ``taken`` are the remote objects that came with them.
    With ``eager``, each value is safe to send as soon as it is in ``values``.  Without, ``values``
    gets the tasks' results as they are, and ``encode_new`` makes them safe.
    """

    __slots__ = (
        "_buffers",
        "_channel",
        "_encoded",
        "_encoded_up_to",
        "_last_sent",
        "_lock",
        "_retryable",
        "_sent",
        "_taken",
        "eager",
        "remaining",
        "seq",
        "total",
        "values",
    )

    def __init__(
        self,
        channel: ResultChannel,
        seq: int,
        remaining: Iterator[Any],
        total: int,
        *,
        eager: bool,
        started: float,
        taken: Taken,
        retryable: tuple[type[BaseException], ...] = (),
    ) -> None:
        self.seq = seq
        self._taken = taken
        self.remaining = remaining
        self.total = total
        self.eager = eager
        self.values: list[Any] = []
        self._encoded_up_to = 0
        self._sent = 0
        self._encoded: list[tuple[int, int, bytes | None, int]] = []
        self._buffers: list[memoryview] = []
        self._channel = channel
        self._lock = threading.Lock()
        self._last_sent = started
        self._retryable = retryable

    def add(self, value: Any) -> bool:
        """Take the next task's value in its present state: a later task may change the object.

        If the result is True, call ``flush`` before the next task, which may write to the value's
        memory.
        """
        if work.is_plain_value(value):
            self.values.append(value)
            return False
        self._pickle(len(self.values), value)
        self.values.append(None)
        return bool(self._buffers)

    def fail(self, error: BaseException) -> None:
        """Take the next task's error."""
        again = bool(self._retryable) and isinstance(error, self._retryable)
        kind = work.AGAIN if again else work.ERROR
        self._enclose(len(self.values), kind, (encode_error(error), []))
        self.values.append(None)

    def encode_new(self) -> None:
        """Make the values since the last call safe to send."""
        first, values = self._encoded_up_to, self.values
        if not work.is_plain(values[first:]):
            for at in range(first, len(values)):
                if not work.is_plain_value(values[at]):
                    self._pickle(at, values[at])
                    values[at] = None
                if len(self._buffers) > _MANY_BUFFERS:
                    self._encoded_up_to = at + 1
                    self.flush()
        self._encoded_up_to = len(values)
        if self._buffers:
            self.flush()

    def _pickle(self, position: int, value: Any) -> None:
        try:
            data, buffers = packet.dumps(value)
            if len(buffers) > work.BUFFERS:
                data, buffers = pickle.dumps(value, 5), []
        except BaseException:
            try:
                data, buffers = _pickle_unusual(value)
            except BaseException as error:
                fault = encode_error(unsendable(error, value))
                self._enclose(position, work.ERROR, (fault, []))
                return
        self._enclose(position, work.VALUE, (data, buffers))

    def _enclose(self, position: int, kind: int, pickled: work.Pickle) -> None:
        data, buffers = work.move_beside(pickled)
        self._buffers += buffers
        self._encoded.append((position, kind, data or None, len(buffers)))

    def started(self) -> int:
        """Return the number of tasks that have begun."""
        with self._lock:
            return self.total - length_hint(self.remaining)

    def flush(self) -> None:
        """Send the results that are safe to send."""
        with self._lock:
            self._send(None)

    def return_unstarted(self) -> None:
        """Send the results that are safe to send; give back the tasks that have not begun."""
        with self._lock:
            # Taking tasks from the iterator is atomic: each goes to this thread or to the other.
            left = len(list(self.remaining))
            self.total -= left
            self._send(self.total if left else None)

    def _send(self, kept: int | None) -> None:
        first, stop = self._sent, len(self.values) if self.eager else self._encoded_up_to
        if first == stop and kept is None:
            return
        odd = [(at - first, kind, data, n) for at, kind, data, n in self._encoded if at < stop]
        buffers = self._buffers[: sum(entry[3] for entry in odd)]
        if stop >= self.total:  # the tasks' grants end with the last task
            confirm(self._taken)
        now = time.perf_counter()
        head = (self.seq, first, kept, now - self._last_sent)
        done = len(odd)
        try:
            data = pickle.dumps((*head, self.values[first:stop], odd), 5)
            self._channel.send(data, buffers)
        except ConnectionError:
            raise
        except (OSError, MemoryError) as error:
            # There is no memory or descriptor for the results.  The error needs little of either.
            odd = [(at, work.ERROR, encode_error(error), 0) for at in range(stop - first)]
            self._channel.send(pickle.dumps((*head, [None] * len(odd), odd), 5))
        self._sent, self._last_sent = stop, now
        del self._encoded[:done], self._buffers[: len(buffers)]


def _pickle_unusual(value: Any) -> tuple[bytes, list[memoryview]]:
    """Pickle a value that plain pickle refuses."""
    try:
        # Sockets and the like need multiprocessing's reducers, which only its pickler knows.
        return bytes(ForkingPickler.dumps(value)), []
    except BaseException:
        data, buffers = packet.dumps(value, by_reference.dumps)
        return (data, buffers) if len(buffers) <= work.BUFFERS else (by_reference.dumps(value), [])
