"""Calls of what is broken cost nothing that stays: no memory, no descriptor, no caller's frame."""

from __future__ import annotations

import asyncio
import gc
import itertools
import os
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import partial
from types import TracebackType
from typing import Any, NoReturn

import pytest

import fiber
from fiber._backends import loopback
from fiber._runtime import state
from fiber._transport.loop import Loop
from fiber.errors import FiberError, StartError
from fiber.futures import BrokenProcessPool
from patience import PATIENCE
from processes import pool_tasks as tasks
from processes.pool_programs import wait_until
from processes.test_loopback import running

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

CALLS = 10_000
_WARM_UP = 100


class Local:
    """An object that only a caller's frame refers to."""


class Caller:
    """Calls what is refused, and looks at what the exceptions hold."""

    def __init__(self) -> None:
        self.locals: weakref.WeakSet[Local] = weakref.WeakSet()
        self.frames: set[int] = set()
        """Numbers of frames in the tracebacks."""

    def call(self, function: Callable[[], object], kind: type[Exception]) -> None:
        mine = Local()
        self.locals.add(mine)
        try:
            function()
        except kind as error:
            self.frames.add(length(error.__traceback__))
        else:
            pytest.fail("the call was not refused")

    def repeat(
        self, functions: Iterator[Callable[[], object]], kind: type[Exception], calls: int
    ) -> None:
        for function in itertools.islice(functions, calls):
            self.call(function, kind)


def length(traceback: TracebackType | None) -> int:
    count = 0
    while traceback is not None:
        count += 1
        traceback = traceback.tb_next
    return count


def held() -> tuple[int, int]:
    """Blocks of memory and descriptors of this process."""
    done = threading.Event()
    state.runtime().loop.call_soon(done.set)  # what calls have asked of the loop is over
    assert done.wait(PATIENCE)
    gc.collect()
    return sys.getallocatedblocks(), len(os.listdir("/proc/self/fd"))


def check_that_nothing_stays(
    kind: type[Exception], *functions: Callable[[], object], calls: int = CALLS
) -> None:
    """Call all of ``functions`` in turn; each is refused by a ``kind``."""
    caller, turns = Caller(), itertools.cycle(functions)
    caller.repeat(turns, kind, _WARM_UP)
    blocks, descriptors = held()
    caller.repeat(turns, kind, calls)
    gc.collect()  # asyncio makes cycles, too
    wait_until(lambda: len(caller.locals) == 0, "the frames of callers are gone")
    assert len(caller.frames) <= len(functions)
    after = held()
    assert after[0] - blocks < calls // 10
    assert after[1] == descriptors


def fail() -> NoReturn:
    raise ValueError("the initializer")


def test_a_broken_pool() -> None:
    with fiber.Pool(1, fail) as pool:
        with pytest.raises(StartError):
            pool.apply(tasks.square, (1,))
        check_that_nothing_stays(
            StartError,
            lambda: pool.apply(tasks.square, (1,)),
            lambda: pool.apply_async(tasks.square, (1,)),
            lambda: pool.broadcast(tasks.square, 1),
            lambda: pool.imap(tasks.square, [1]),
            lambda: pool.map(tasks.square, [1]),
            pool.wait_until_workers_up,
        )


def test_a_broken_executor() -> None:
    with fiber.Executor(1, initializer=fail) as executor:
        future = executor.submit(tasks.square, 1)
        results = executor.map(tasks.square, [1])
        with pytest.raises(BrokenProcessPool):
            next(results)
        check_that_nothing_stays(
            BrokenProcessPool,
            lambda: executor.submit(tasks.square, 1),
            lambda: executor.map(tasks.square, [1]),
            future.result,
            partial(raise_exception_of, future),
        )


def raise_exception_of(future: Future[int]) -> None:
    raise future.exception() or AssertionError("it has none")


def test_results_of_tasks_that_raise() -> None:
    with fiber.Pool(1) as pool, fiber.Executor(1) as executor:
        single = pool.apply_async(tasks.raise_value_error, (1,))
        mapped = pool.map_async(tasks.raise_value_error, [1])
        future: Any = executor.submit(tasks.raise_value_error, 1)

        async def wait() -> Any:
            return await future

        with asyncio.Runner() as runner:
            check_that_nothing_stays(
                ValueError, single.get, mapped.get, future.result, lambda: runner.run(wait())
            )


def test_a_terminated_pool() -> None:
    with fiber.Pool(1) as pool:
        pool.apply_async(tasks.sleep, (PATIENCE,))
        results = [pool.apply_async(tasks.square, (1,)) for _ in range(CALLS + _WARM_UP)]
    pending = iter(results)
    check_that_nothing_stays(FiberError, lambda: next(pending).get(), results[0].get)
    check_that_nothing_stays(ValueError, lambda: pool.apply(tasks.square, (1,)))


def test_a_broken_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    waits = [sys.executable, "-c", "import signal; signal.pause()"]
    monkeypatch.setattr(loopback, "interpreter_arguments", lambda *_: waits)
    queue: Any = fiber.Queue()
    with running() as backend:
        process = backend._slots[0].process
        wait_until(lambda: process.pid is not None, "the agent's process runs")
        error = StartError("the agents", "none joined")
        state.runtime().loop.call_soon(backend.agents.fail, error)
        check_that_nothing_stays(
            StartError, lambda: fiber.Process(target=queue.put, args=(1,)).start()
        )
        check_that_nothing_stays(StartError, lambda: fiber.Pool(1), calls=100)


def test_a_broken_loop() -> None:
    loop = Loop()
    loop._epoll.close()
    with pytest.raises(ValueError, match="closed epoll"):
        loop.run()
    dependent: Any = Local()
    check_that_nothing_stays(FiberError, lambda: loop.depend(dependent))
