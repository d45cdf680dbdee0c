"""Answers that no honest worker gives, and what the executor does about them."""

from __future__ import annotations

import math
import pickle
import signal
from collections.abc import Callable
from typing import Any

import pytest

from fiber._runtime.worker_handle import WorkerHandle
from fiber._wire import work
from fiber._wire.packet import Message
from fiber.errors import WorkerDied
from unit.executor_rig import Rig


def _say_for_another(rig: Rig, liar: WorkerHandle, other: WorkerHandle) -> None:
    assert other.worker is not None
    rig.answer(liar, other.worker.queue[0].seq, ["forged"])


def _say_bytes(data: bytes) -> Callable[[Rig, WorkerHandle, WorkerHandle], None]:
    return lambda rig, liar, other: liar.received(Message(memoryview(data), [], []))


def _say_words(*words: Any) -> Callable[[Rig, WorkerHandle, WorkerHandle], None]:
    return _say_bytes(pickle.dumps(words))


def _say_of_own(*words: Any) -> Callable[[Rig, WorkerHandle, WorkerHandle], None]:
    def say(rig: Rig, liar: WorkerHandle, other: WorkerHandle) -> None:
        assert liar.worker is not None
        rig.say(liar, liar.worker.queue[0].seq, *words)

    return say


@pytest.mark.parametrize(
    "lie",
    [
        _say_for_another,
        _say_bytes(b"no pickle"),
        _say_bytes(pickle.dumps(7)),
        _say_bytes(pickle.dumps([work.READY])),
        _say_words("no kind"),
        _say_words(["unhashable"]),
        _say_words(work.UNREADABLE, 1, b""),
        _say_words(work.UNKNOWN, 1),
        _say_words(work.BROKEN, 1, b""),
        _say_words(work.BROKEN, "text", b""),
        _say_words(work.INIT_FAILED, 3),
        _say_words(10**6, 0, None, 1e-3, [1], []),
        _say_of_own(),
        _say_of_own(1, None, 1e-3, [1], []),
        _say_of_own(-1, None, 1e-3, [1], []),
        _say_of_own(0, None, 1e-3, [1, 2], []),
        _say_of_own(0, None, math.nan, [1], []),
        _say_of_own(0, None, -1.0, [1], []),
        _say_of_own(0, "all", 1e-3, [1], []),
        _say_of_own(0, None, 1e-3, "ab", []),
        _say_of_own(0, None, 1e-3, [1], [(1, work.VALUE, b"", 0)]),
        _say_of_own(0, None, 1e-3, [1], [(0, work.VALUE, b"", 1)]),
        _say_of_own(0, None, 1e-3, [1], [(0, work.VALUE, "text", 0)]),
    ],
)
def test_a_wrong_answer_ends_its_worker_and_nothing_else(
    rig: Rig, lie: Callable[[Rig, WorkerHandle, WorkerHandle], None]
) -> None:
    first, second = rig.call(), rig.call()
    other, liar = (batch.worker.key for batch in rig.ledger.batches.values())
    lie(rig, liar, other)
    assert rig.child(liar).signals == [signal.SIGKILL]
    assert rig.child(other).signals == []
    seq = rig.child(liar).packets[-1][0]
    rig.answer(liar, seq, ["too late"])
    assert not first.outcomes
    assert not second.outcomes
    rig.call()
    assert len(rig.child(liar).packets) == 1, "a worker that was killed is given more"
    rig.lose(liar, running=(seq, 0))
    rig.background.run()
    rig.all_ready()
    rig.answer_all()
    assert (first.done, second.done) == (1, 1)


def test_the_error_of_a_task_that_sends_wrong_answers_says_so(rig: Rig) -> None:
    results = rig.call()
    for _ in range(4):
        (liar,) = rig.busy
        seq = rig.child(liar).packets[-1][0]
        rig.answer(liar, seq + 100, [9])
        rig.lose(liar, running=(seq, 0))
        rig.background.run()
        rig.all_ready()
    error = results.outcomes[0].error
    assert isinstance(error, WorkerDied)
    assert error.reason.startswith("WrongAnswer: it answered for batch")
    assert "What to do: only Fiber itself writes to the channel of a worker" in str(error)
