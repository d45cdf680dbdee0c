"""What waits for results, and is interrupted."""

from __future__ import annotations

import threading
from typing import Any

import pytest
from fiber._runtime.reader import Reader

from fiber._engine.chunks import Pace
from fiber._engine.ledger import Ledger
from fiber._runtime.outcome import Encoded
from fiber._wire import work
from fiber.results import ApplyResult, IMapIterator


class Stop(BaseException):
    """What a signal's handler raises."""


def result() -> ApplyResult:
    pool: Any = None
    return ApplyResult(pool)


def test_an_interrupted_wait_leaves_the_result_to_others(monkeypatch: pytest.MonkeyPatch) -> None:
    found = result()
    real = threading.Lock

    class Interrupted:
        """A lock whose acquirer is interrupted right after it got it."""

        def __init__(self) -> None:
            self._lock = real()

        def acquire(self, *args: Any) -> bool:
            taken = self._lock.acquire(*args[:1] and (False,))
            if args:
                raise Stop
            return taken

        def release(self) -> None:
            self._lock.release()

    monkeypatch.setattr(threading, "Lock", Interrupted)
    with pytest.raises(Stop):
        found.wait()
    monkeypatch.undo()
    found.put(0, [Encoded(work.VALUE, b"I3\n.", [])], True)
    found.end()
    assert found.get(0) == 3


def test_waiting_in_vain_leaves_nothing() -> None:
    found = result()
    for _ in range(3):
        found.wait(0)
    assert found._waiters == []


def test_all_who_wait_go_on() -> None:
    found = result()
    threads = [threading.Thread(target=found.wait) for _ in range(3)]
    for thread in threads:
        thread.start()
    found.put(0, [1], False)
    found.end()
    for thread in threads:
        thread.join()
    assert found.get() == 1


def test_the_last_results_come_before_the_end() -> None:
    pool: Any = None
    iterator = IMapIterator(pool)
    iterator._buffer.put(0, [1], False)
    iterator._buffer.end()
    assert iterator._buffer.wait(0) == 1
    with pytest.raises(StopIteration):
        iterator._buffer.wait(None)


def test_a_reader_that_looks_whether_it_must_wait_can_be_released_already() -> None:
    ledger = Ledger()
    job = ledger.open(pace=Pace())
    reader = Reader(job, threading.Lock(), limit=1)
    full = reader._full

    def consumed_meanwhile() -> bool:
        was_full = full()
        if reader._read:
            assert reader._blocked, "whoever consumes now would not know that the reader waits"
        return was_full

    reader._full = consumed_meanwhile  # type: ignore[method-assign]
    reader._read = 1
    reader._lock.acquire()
    reader._lock.release()
    reader.stopped = True
    reader._wait()
    assert not reader._blocked
