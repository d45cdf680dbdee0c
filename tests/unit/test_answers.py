"""Answers that no honest worker gives, and what the executor does about them."""

from __future__ import annotations

import math
import pickle
import signal
from collections.abc import Callable
from typing import Any

import pytest

from fiber._runtime.workers import WorkerHandle
from fiber._wire import work
from fiber._wire.packet import Message
from fiber.errors import WorkerDied
from unit.executor_rig import Results, Rig


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


def _say_unknown_of_own(rig: Rig, liar: WorkerHandle, other: WorkerHandle) -> None:
    """Answer that the function is unknown: without an end, the task would run for ever."""
    assert liar.worker is not None
    rig.say(liar, work.UNKNOWN, liar.worker.queue[0].seq)


@pytest.mark.parametrize(
    "lie",
    [
        _say_for_another,
        _say_unknown_of_own,
        _say_bytes(b"no pickle"),
        _say_bytes(pickle.dumps(7)),
        _say_bytes(pickle.dumps([work.READY])),
        _say_words("no kind"),
        _say_words(["unhashable"]),
        _say_words(work.UNREADABLE, 1, b""),
        _say_words(work.UNKNOWN, 1),
        _say_words(work.BROKEN, 1, b""),
        _say_words(work.BROKEN, "text", b""),
        _say_words(work.INIT_FAILED, 3, ""),
        _say_words(work.INIT_FAILED, "text", None),
        _say_words(work.INIT_FAILED, "text"),
        _say_words(10**6, 0, None, 1e-3, [1], []),
        _say_of_own(),
        _say_of_own(1, None, 1e-3, [1], []),
        _say_of_own(-1, None, 1e-3, [1], []),
        _say_of_own(0, None, 1e-3, [1, 2], []),
        _say_of_own(0, None, math.nan, [1], []),
        _say_of_own(0, None, -1.0, [1], []),
        _say_of_own(0, "all", 1e-3, [1], []),
        _say_of_own(0, 0, 1e-3, [], []),
        _say_of_own(0, None, 1e-3, "ab", []),
        _say_of_own(0, None, 1e-3, [1], [(1, work.VALUE, b"", 0)]),
        _say_of_own(0, None, 1e-3, [1], [(0, work.VALUE, b"", 1)]),
        _say_of_own(0, None, 1e-3, [1], [(0, work.VALUE, "text", 0)]),
    ],
)
def test_a_wrong_answer_only_ends_its_worker(
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
    assert "What to do: only Fiber may write to the channel of a worker" in str(error)


# What an agent says of the end of a worker


def two_calls(rig: Rig) -> tuple[Results, WorkerHandle, Results, WorkerHandle]:
    """Two calls, each with the worker that runs it."""
    first, second = rig.call(timeout=60.0), rig.call(timeout=60.0)
    one, other = (batch.worker.key for batch in rig.ledger.batches.values())
    return first, one, second, other


def number_of(handle: WorkerHandle) -> int:
    assert handle.worker is not None
    return handle.worker.queue[0].seq


def test_an_agent_gives_back_only_the_packets_of_its_worker(rig: Rig) -> None:
    first, one, _, other = two_calls(rig)
    other.recalled([number_of(one)])
    assert len(rig.child(one).packets) == 1, "the task of another worker was given out again"
    assert len(rig.loop.timers) == 2, "the deadline of another worker's task is off"
    rig.answer(one, number_of(one), [9])
    assert first.outcomes == {0: 9}


def test_an_exit_report_charges_only_the_tasks_of_its_worker(rig: Rig) -> None:
    first, one, second, other = two_calls(rig)
    jobs = [batch.job for batch in rig.ledger.batches.values()]
    rig.lose(other, unread=(number_of(one),), running=(number_of(one), 0))
    assert [job.charges.deaths for job in jobs if job is not None] == [{}, {0: 1}]
    rig.answer(one, number_of(one), [9])
    rig.background.run()
    rig.all_ready()
    rig.answer_all()
    assert (first.outcomes[0], first.done, second.done) == (9, 1, 1)
