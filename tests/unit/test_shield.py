"""Signals that come while the main thread changes what a pool knows."""

from __future__ import annotations

import gc
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from fiber._runtime.shield import Shield

from unit import pool_tasks as tasks
from unit.test_dispatcher import Rig, Sink

WITHIN = "/fiber/"
"""Part of the names of the files in whose code signals arrive."""


class Stop(BaseException):
    """What a signal's handler raises."""


@pytest.fixture
def heard() -> Iterator[list[int]]:
    """The signals that were handled; SIGUSR1 raises Stop, SIGUSR2 does not."""
    heard: list[int] = []

    def stop(signum: int, frame: Any) -> None:
        heard.append(signum)
        raise Stop

    before = [
        signal.signal(signal.SIGUSR1, stop),
        signal.signal(signal.SIGUSR2, lambda signum, frame: heard.append(signum)),
    ]
    yield heard
    signal.signal(signal.SIGUSR1, before[0])
    signal.signal(signal.SIGUSR2, before[1])


def test_handlers_run_after_the_block_and_are_what_they_were(heard: list[int]) -> None:
    shield = Shield()
    handlers = [signal.getsignal(number) for number in (signal.SIGUSR1, signal.SIGUSR2)]

    def block() -> None:
        with shield, shield:
            signal.raise_signal(signal.SIGUSR2)
            signal.raise_signal(signal.SIGUSR1)
            signal.raise_signal(signal.SIGUSR2)
            assert heard == []

    with pytest.raises(Stop):
        block()
    assert heard == [signal.SIGUSR2, signal.SIGUSR1, signal.SIGUSR2]
    assert [signal.getsignal(number) for number in (signal.SIGUSR1, signal.SIGUSR2)] == handlers
    assert not shield.up()


def test_handlers_run_where_the_shield_is_lifted(heard: list[int]) -> None:
    shield = Shield()
    with shield:
        with shield.lifted, pytest.raises(Stop):
            signal.raise_signal(signal.SIGUSR1)
        signal.raise_signal(signal.SIGUSR1)
        with pytest.raises(Stop):
            shield.lifted.__enter__()
        assert shield.up()
        signal.raise_signal(signal.SIGUSR2)
        assert heard == [signal.SIGUSR1] * 2
    assert heard[2:] == [signal.SIGUSR2]


def test_other_threads_are_left_alone(heard: list[int]) -> None:
    shield = Shield()
    seen: list[object] = []

    def look() -> None:
        with shield, shield.lifted:
            seen.append(signal.getsignal(signal.SIGUSR1))

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert seen == [signal.getsignal(signal.SIGUSR1)]


def interrupt(at: int, action: Callable[[], object]) -> bool:
    """Do it, and have SIGUSR1 come at the ``at``-th step of Fiber's code; False if it has fewer."""
    steps = 0

    def trace(frame: Any, event: str, argument: Any) -> Any:
        nonlocal steps
        if WITHIN not in frame.f_code.co_filename:
            return None
        steps += 1
        if steps == at:
            signal.raise_signal(signal.SIGUSR1)
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        action()
    except Stop:
        pass
    finally:
        sys.settrace(before)
    return steps >= at


def _call(rig: Rig, sink: Sink) -> None:
    rig.dispatcher.call(sink, tasks.square, (3,), {})


def _post(rig: Rig, sink: Sink) -> None:
    rig.dispatcher.post(sink, tasks.square, (3,), {})


def _map(rig: Rig, sink: Sink) -> None:
    rig.map([tasks.Tattling(n) for n in range(3)])


def _answer(rig: Rig, sink: Sink) -> None:
    """As whoever attends to a worker hears it."""
    port = _Answering(rig)
    rig.dispatcher.call(sink, tasks.square, (3,), {})
    rig.dispatcher.attend(port)


class _Answering:
    def __init__(self, rig: Rig) -> None:
        self._rig = rig

    def attend(self) -> bool:
        answer_all(self._rig)
        return True


def answer_all(rig: Rig) -> None:
    """Let the workers do all that was sent, and whatever follows."""
    answered: set[int] = set()
    while True:
        rig.pump.run()
        for link, port in zip(rig.links, rig.ports, strict=True):
            for seq, _ in port.packets:
                batch = rig.dispatcher._ledger.batches.get(seq)
                if batch is not None and seq not in answered:
                    answered.add(seq)
                    rig.answer(link, seq, [None] * len(batch.items))
                    break
            else:
                continue
            break
        else:
            return


@pytest.fixture
def _uncollected() -> Iterator[None]:
    """Nothing is finalized meanwhile: what a handler raises there is lost."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()
    gc.collect()


@pytest.mark.usefixtures("_uncollected")
@pytest.mark.parametrize("action", [_call, _post, _map, _answer])
def test_a_pool_outlives_an_interruption_at_any_step(
    action: Callable[[Rig, Sink], None], heard: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    tasks.state["pickled"] = []
    for at in range(1, 10_000):
        rig = Rig(monkeypatch, 1)
        first = rig.map(range(4))
        more = interrupt(at, lambda: action(rig, Sink()))  # noqa: B023
        answer_all(rig)
        last = Sink()
        rig.dispatcher.call(last, tasks.square, (3,), {})
        answer_all(rig)
        assert (first.ended, last.ended) == (1, 1), f"step {at}"
        assert not rig.dispatcher._ledger.batches, f"step {at}"
        assert rig.dispatcher._ledger.demand() == 0, f"step {at}"
        assert not rig.dispatcher._unsent, f"step {at}"
        rig.close()
        if not more:
            break
    assert len(heard) == at - 1
