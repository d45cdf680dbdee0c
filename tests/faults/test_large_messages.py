"""Messages of many megabytes between hosts: they arrive, and cost no agent."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import pytest

import fiber
from faults import targets
from faults.runtime import running
from fiber._runtime.state import Runtime

SIZE = 64 << 20
EXTREME = [pytest.param(size << 20, marks=pytest.mark.long) for size in (256, 2048, 4100)]


def content(size: int) -> bytes:
    """Bytes that are no piece's twice."""
    pattern = os.urandom(1_000_003)
    return pattern * (size // len(pattern) + 1)


@pytest.fixture
def hosts() -> Iterator[Runtime]:
    with running(backend="loopback", agents=1) as runtime:
        yield runtime


@pytest.fixture
def one_agent(hosts: Runtime) -> Iterator[None]:
    """The test must cost no worker."""
    with fiber.Pool(1) as pool:
        before = pool.apply(os.getppid)
        yield
        assert pool.apply(os.getppid) == before


@pytest.mark.usefixtures("one_agent")
@pytest.mark.parametrize("size", [SIZE, *EXTREME])
@pytest.mark.timeout(600)
def test_arguments_and_results(size: int) -> None:
    data = content(size)
    with fiber.Pool(2) as pool:
        large = pool.apply_async(targets.same, (data,))
        small = [pool.apply(abs, (-number,)) for number in range(100)]
        assert small == list(range(100))
        assert large.get() == data


@pytest.mark.usefixtures("one_agent")
@pytest.mark.parametrize("size", [SIZE, *EXTREME])
@pytest.mark.timeout(600)
def test_pipes_and_queues(size: int) -> None:
    data = content(size)
    ours, theirs = fiber.Pipe()
    requests: Any = fiber.Queue()
    replies: Any = fiber.Queue()
    child = fiber.Process(target=targets.echo_large, args=(theirs, requests, replies))
    child.start()
    theirs.close()
    ours.send_bytes(data)
    assert ours.recv_bytes() == data
    requests.put(data)
    assert replies.get() == data
    child.join()
