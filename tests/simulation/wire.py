"""The executor's own messages, as a worker reads and writes them."""

from __future__ import annotations

import pickle
import random
from collections.abc import Callable, Sequence
from typing import Any

from fiber._wire import work
from fiber._wire.packet import Message
from simulation.schedule import Act
from simulation.workers import NO_OP, Broken, Ready, Ref, Results, Unknown, Unreadable, Work, Worker


class PlannedError(ValueError):
    """Error that tasks raise; unpickling it runs the user's code."""

    unpickled: Callable[[], None] = staticmethod(lambda: None)
    """Called by that."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _planned_error, ()


def _planned_error() -> PlannedError:
    PlannedError.unpickled()
    return PlannedError("as planned")


ERROR = pickle.dumps(PlannedError())


def perform(job: int, index: int) -> int:
    """Stands for the user's function; it never runs."""
    raise NotImplementedError


def perform_other(job: int, index: int) -> int:
    """Another one."""
    raise NotImplementedError


def perform_nowhere(job: int, index: int) -> int:
    """A third one, which no worker can import."""
    raise NotImplementedError


def value_of(ref: Ref) -> int:
    return ref.job * 1000 + ref.task


class Wire:
    """The executor's own messages, from the worker's side."""

    def __init__(self, seed: int) -> None:
        self._rng = random.Random(f"{seed} wire")
        self.pinned: dict[int, int] = {}
        """The index of the task in each batch that carries a broadcast call."""

    def work(
        self, worker: Worker, seq: int, payload: bytes, buffers: Sequence[memoryview]
    ) -> Work | Unknown | Broken | None:
        """Return the content of a packet."""
        head = work.Head.unpack_from(payload)
        body = memoryview(payload)[work.HEAD_FORMAT.size :]
        if head.kind == work.STOP:
            return None
        if head.kind == work.CALLS:
            calls = [
                pickle.loads(work.take_beside(call, [])[0])[1]
                for call, _ in work.unpack_calls(body, head.size)
            ]
            if calls == [()]:
                return Work(seq, [NO_OP], 1, 1, apart=True)
            if seq in self.pinned:
                calls = [(calls[0][0], self.pinned[seq])]
            return Work(seq, [Ref(*call) for call in calls], 1, 1, apart=True)
        if self._rng.random() < 0.02:
            worker.functions.clear()
        if head.size:
            if pickle.loads(body[: head.size]) is perform_nowhere:
                return Broken(seq)
            worker.functions.add(head.function)
        elif head.function not in worker.functions:
            return Unknown(seq)
        items = pickle.loads(body[head.size :])
        return Work(seq, [Ref(*item) for item in items], head.stride or 1, head.unit)

    def message(self, said: Any) -> Message:
        """Return the message of a worker."""
        words: tuple[Any, ...]
        if isinstance(said, Ready):
            words = (work.READY,)
        elif isinstance(said, Unknown):
            words = (work.UNKNOWN, said.seq)
        elif isinstance(said, Broken):
            words = (work.BROKEN, said.seq, ERROR)
        elif isinstance(said, Unreadable):
            words = (work.UNREADABLE, said.seq, ERROR)
        else:
            words = self._results(said)
        return Message(memoryview(pickle.dumps(words)), [], [])

    def _results(self, said: Results) -> tuple[Any, ...]:
        values: list[int | None] = []
        odd = []
        for at, (ref, act) in enumerate(said.tasks):
            values.append(value_of(ref) if act is Act.FINE else None)
            if act is not Act.FINE:
                kind = work.AGAIN if act is Act.RETRIED else work.ERROR
                odd.append((at, kind, ERROR, 0))
        return said.seq, said.offset, said.kept, said.seconds, values, odd
