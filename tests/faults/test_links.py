"""Cut the network between master and agents: no task is lost, and long cuts cost time."""

from __future__ import annotations

import signal
import time

import pytest

import fiber
from faults import targets
from faults.program import alive, wait_for
from faults.wire import Wire
from patience import PATIENCE

SHORT = 0.5
"""Seconds of a cut that must cause no loss."""


@pytest.mark.parametrize("way", ["silence", "sever"])
def test_a_short_cut_loses_no_message(wire: Wire, way: str) -> None:
    ours, theirs = fiber.Pipe()
    child = wire.start(targets.echo, theirs)
    theirs.close()
    ours.send(0)
    assert ours.recv() == 0
    for number in range(1, 51):
        ours.send(number)
        if number == 25:
            getattr(wire.proxy, way)()
    time.sleep(SHORT)  # the length of the cut, which is tested
    wire.proxy.heal()
    assert [ours.recv() for _ in range(50)] == list(range(1, 51))
    assert child.is_alive()
    assert wire.agents() == ["loopback-0"]
    ours.close()
    child.join(PATIENCE)
    assert child.exitcode == 0


@pytest.mark.parametrize("way", ["silence", "sever"])
def test_shared_memory_is_in_step_after_a_short_cut(wire: Wire, way: str) -> None:
    ours, theirs = fiber.Pipe()
    array = fiber.RawArray("i", 50)
    child = wire.start(targets.square_each, array, theirs)
    theirs.close()
    for number in range(50):
        array[number] = number
        ours.send(number)
        if number == 25:
            getattr(wire.proxy, way)()
            wire.backend._loop.call_later(SHORT, wire.proxy.heal)
        assert ours.recv() == number
        assert array[number] == number * number
    ours.close()
    child.join(PATIENCE)
    assert child.exitcode == 0


@pytest.mark.lost_after(2.0)
@pytest.mark.parametrize("way", ["silence", "sever"])
def test_a_long_cut_is_reported_ends_its_processes_and_brings_a_new_agent(
    wire: Wire, way: str
) -> None:
    ours, theirs = fiber.Pipe()
    child = wire.start(targets.report_and_block, theirs)
    theirs.close()
    pid = ours.recv()
    getattr(wire.proxy, way)()
    child.join(PATIENCE)
    assert child.exitcode == -signal.SIGKILL
    assert "loopback-0" in child._popen.report.reason
    with pytest.raises(EOFError):
        ours.recv()
    ours.close()
    wait_for(lambda: not alive(pid))
    assert wire.agents() == ["loopback-1"]
    wire.proxy.heal()
    again = wire.start(targets.nothing)
    again.join(PATIENCE)
    assert again.exitcode == 0


def test_many_short_cuts_in_the_middle_of_work(wire: Wire) -> None:
    with fiber.Pool(2) as pool:
        results = pool.imap_unordered(targets.slow_square, range(60), chunksize=1)
        seen = []
        for number, result in enumerate(results):
            seen.append(result)
            if number % 15 == 0:
                wire.cut()
    assert sorted(seen) == [n * n for n in range(60)]
    assert wire.agents() == ["loopback-0"]


@pytest.mark.lost_after(2.0)
def test_a_pool_survives_a_long_cut(wire: Wire) -> None:
    with fiber.Pool(2) as pool:
        assert pool.apply(targets.slow_square, (3,)) == 9
        result = pool.map_async(targets.slow_square, range(40), chunksize=1)
        wire.proxy.silence()
        wait_for(lambda: wire.agents() == ["loopback-1"])
        wire.proxy.heal()
        assert result.get(PATIENCE) == [n * n for n in range(40)]
