"""Messages of many megabytes between hosts: they arrive, and cost no agent."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import pytest

import fiber
from faults import targets
from faults.runtime import running

MEGABYTES = [64, *(pytest.param(size, marks=pytest.mark.long) for size in (256, 2048, 4100))]
"""The largest is above 4 GiB."""

pytestmark = pytest.mark.timeout(900)


@pytest.fixture
def one_agent() -> Iterator[None]:
    """The test must not cost the only agent."""
    with running(backend="loopback", agents=1), fiber.Pool(1) as pool:
        before = pool.apply(os.getppid)
        yield
        assert pool.apply(os.getppid) == before


def small_tasks(pool: Any, until: Any) -> None:
    """Run some at least, and go on for as long as the large message travels."""
    done = 0
    while not until.ready() or done < 100:
        assert pool.apply(abs, (-done,)) == done
        done += 1


@pytest.mark.usefixtures("one_agent")
@pytest.mark.parametrize("megabytes", MEGABYTES)
def test_arguments_and_results(megabytes: int) -> None:
    data = targets.content(megabytes << 20)
    expected = targets.checksum(data)
    with fiber.Pool(1) as pool, fiber.Pool(1) as other:
        argument = pool.apply_async(targets.checksum, (data,))
        del data
        small_tasks(other, argument)
        assert argument.get() == expected
        result = pool.apply_async(targets.content, (megabytes << 20,))
        small_tasks(other, result)
        assert targets.checksum(result.get()) == expected


@pytest.mark.usefixtures("one_agent")
@pytest.mark.parametrize("megabytes", MEGABYTES)
def test_pipes_and_queues(megabytes: int) -> None:
    data = targets.content(megabytes << 20)
    expected = targets.checksum(data)
    ours, theirs = fiber.Pipe()
    requests: Any = fiber.Queue()
    replies: Any = fiber.Queue()
    child = fiber.Process(target=targets.echo_large, args=(theirs, requests, replies))
    child.start()
    theirs.close()
    ours.send_bytes(data)
    del data
    assert ours.recv() == expected
    received = ours.recv_bytes()
    assert targets.checksum(received) == expected
    requests.put(received)
    del received
    assert replies.get() == expected
    assert targets.checksum(replies.get()) == expected
    child.join()
    assert child.exitcode == 0


@pytest.mark.usefixtures("one_agent")
@pytest.mark.parametrize("megabytes", [1, *MEGABYTES[:-1]])
def test_arguments_of_a_process(megabytes: int) -> None:
    ours, theirs = fiber.Pipe()
    data = targets.content(megabytes << 20)
    child = fiber.Process(target=targets.send_checksum, args=(theirs, data))
    child.start()
    theirs.close()
    assert ours.recv() == targets.checksum(data)
    child.join()
    assert child.exitcode == 0
