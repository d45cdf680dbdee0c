"""A program that makes all kinds of calls while signals and the collector strike at random points.

Its arguments are a mode, a seed and seconds.  It says what it did in one line, and ends with
status 1 and reasons on stderr if a call was lost, an error came that nobody provoked, or something
is left.  It never hangs: what takes too long prints all stacks.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import os
import random
import signal
import sys
import threading
import time
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from multiprocessing import util
from types import FrameType
from typing import Any

import fiber
import leaks
from faults.random_work import add, fail, nothing, square
from fiber._runtime import state
from fiber.pool import Pool
from patience import PATIENCE

MODES = ("raise", "enter", "collect", "all")
"""Handlers raise; handlers use pools; finalizers do; all of it at once."""

POOLS: list[dict[str, Any]] = [
    {"processes": 2},
    {"processes": 2, "maxtasksperchild": 7},
    {"min_workers": 0, "max_workers": 3, "idle_timeout": 0.005},
    {"processes": 2, "error_handling": True},
]


POLLER = ["anon_inode:[eventfd]", "anon_inode:[eventpoll]"]
"""Descriptors that nng's poller has open."""


LEFT_BY_INTERRUPTS = 5
"""Descriptors that may stay open: an interrupt can come between opening and owning one."""


class Interrupted(BaseException):
    """Exception that a handler raises."""


class Finalized:
    """Garbage that only the collector finds, and that does something then."""

    def __init__(self, action: Callable[[], object]) -> None:
        self.action = action
        self.me = self

    def __del__(self) -> None:
        self.action()


class RandomCalls:
    """The program, with its failures."""

    def __init__(self, mode: str, seed: int) -> None:
        self.failures: list[str] = []
        self.calls = self.interrupted = self.entered = 0
        self._raises = mode in ("raise", "all")
        self._enters = mode in ("enter", "all")
        self._collects = mode in ("collect", "all")
        self._random = random.Random(seed)
        self._chance = random.Random(seed + 1)
        """Decides within handlers and finalizers."""
        self._armed = False
        self._over = False
        self._asked: deque[tuple[Any, int]] = deque()
        """Results that handlers and finalizers have asked for, with the expected values."""
        self._spare: deque[Any] = deque()
        """Objects that finalizers drop."""
        self._pool = fiber.Pool(**self._random.choice(POOLS))
        self._other = fiber.Pool(1)
        self._kinds: list[Callable[[], object]] = [
            self._apply,
            self._apply_async,
            self._callback,
            self._error,
            self._map,
            self._map_iterator,
            self._map_chunks,
            self._map_async,
            self._starmap,
            self._imap,
            self._imap_unordered,
            self._imap_abandoned,
            self._broadcast,
            self._send_and_receive,
            self._put_and_get,
        ]
        self._rare: list[Callable[[], object]] = [self._second_pool, self._process]

    # The calls. Each names the result that it expects, and may be interrupted anywhere.

    def _apply(self) -> None:
        n = self._random.randrange(1000)
        assert self._pool.apply(square, (n,)) == n * n

    def _apply_async(self) -> None:
        n = self._random.randrange(1000)
        results = [self._pool.apply_async(square, (n + k,)) for k in range(3)]
        assert [found.get(PATIENCE) for found in results] == [(n + k) ** 2 for k in range(3)]

    def _callback(self) -> None:
        seen: list[int] = []
        self._pool.apply_async(square, (3,), callback=seen.append).get(PATIENCE)
        assert seen == [9]

    def _error(self) -> None:
        result = self._pool.apply_async(fail, (3,))
        result.wait(PATIENCE)
        assert not result.successful()

    def _map(self) -> None:
        n = self._random.randrange(50)
        assert self._pool.map(square, range(n)) == [k * k for k in range(n)]

    def _map_iterator(self) -> None:
        n = self._random.randrange(50)
        assert self._pool.map(square, iter(range(n))) == [k * k for k in range(n)]

    def _map_chunks(self) -> None:
        assert self._pool.map(square, iter(range(20)), 3) == [k * k for k in range(20)]

    def _map_async(self) -> None:
        assert self._pool.map_async(square, [1, 2, 3]).get(PATIENCE) == [1, 4, 9]

    def _starmap(self) -> None:
        assert self._pool.starmap(add, [(1, 2), (3, 4)]) == [3, 7]

    def _imap(self) -> None:
        n = self._random.randrange(20)
        assert list(self._pool.imap(square, iter(range(n)))) == [k * k for k in range(n)]

    def _imap_unordered(self) -> None:
        found = self._pool.imap_unordered(square, iter(range(9)), buffersize=2)
        assert sorted(found) == [k * k for k in range(9)]

    def _imap_abandoned(self) -> None:
        found = self._pool.imap(square, iter(range(1000)), buffersize=3)
        assert next(found) == 0

    def _broadcast(self) -> None:
        assert set(self._pool.broadcast(square, 3)) <= {9}

    def _send_and_receive(self) -> None:
        ours, theirs = self._make(fiber.Pipe)
        with ours, theirs:
            ours.send(b"x" * self._random.randrange(5000))
            assert theirs.poll(PATIENCE)
            assert set(theirs.recv()) <= {ord("x")}

    def _put_and_get(self) -> None:
        queue = self._make(fiber.SimpleQueue)
        try:
            queue.put(self.calls)
            assert isinstance(queue.get(), int)
        finally:
            queue.close()

    def _second_pool(self) -> None:
        pool = self._make(partial(fiber.Pool, 1))
        try:
            assert pool.map(square, range(3)) == [0, 1, 4]
        finally:
            self._random.choice([pool.close, pool.terminate])()
            pool.join()

    def _process(self) -> None:
        process = fiber.Process(target=nothing)
        self._make(process.start)
        process.join(PATIENCE)
        assert process.exitcode == 0
        process.close()

    def _make(self, constructor: Callable[[], Any]) -> Any:
        """Call what gets descriptors from the system: if a handler raises at the very moment when
        it has them, nobody can know them any more."""
        armed, self._armed = self._armed, False
        made = constructor()
        self._armed = armed
        return made

    # Signals and garbage collections

    def _handle(self, signum: int, frame: Any) -> None:
        if self._over:
            return
        if self._enters:
            self._enter(may_wait=True)
        self._strike_again()
        if self._raises and self._armed and not _within_finalizer(frame):
            self._armed = False
            raise Interrupted

    def _strike_again(self) -> None:
        signal.setitimer(signal.ITIMER_REAL, self._chance.uniform(1e-5, 3e-3))

    def _enter(self, *, may_wait: bool) -> None:
        """Use pools, in the midst of something."""
        self.entered += 1
        what = self._chance.randrange(40)
        if what == 0 and may_wait:
            self._other.terminate()
        elif what < 5:
            with contextlib.suppress(ValueError, fiber.FiberError):
                self._other.apply_async(square, (what,))
        elif what < 10 and self._spare:
            with contextlib.suppress(IndexError):
                self._spare.popleft()
        elif what < 15:
            repr(self._pool)
        else:
            self._asked.append((self._pool.apply_async(square, (what,)), what * what))

    def _litter(self) -> None:
        """Leave garbage, and have the collector come soon."""
        Finalized(self._finalize)
        gc.set_threshold(self._random.randrange(1, 300), 2, 2)
        if len(self._spare) < 5:
            kind = self._random.randrange(20)
            self._spare.append(fiber.Pool(min_workers=0, max_workers=1) if kind else fiber.Pool(1))
            self._spare.append(fiber.Pipe())

    def _finalize(self) -> None:
        if not self._over:
            self._enter(may_wait=False)

    # The run

    def run(self, seconds: float) -> None:
        """Make calls for ``seconds``, and then report leaks."""
        sys.unraisablehook = self._lost
        signal.signal(signal.SIGALRM, self._handle)
        sibling = threading.Thread(target=self._keep_calling, name="sibling")
        sibling.start()
        if self._raises or self._enters:
            self._strike_again()
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and not self.failures:
            if self._collects:
                self._litter()
            self._make_a_call()
            if self._enters and self._other._state != "RUN":
                self._other = fiber.Pool(1)
            while len(self._asked) > 100:
                self._check_asked()
        self._over = True
        signal.setitimer(signal.ITIMER_REAL, 0)
        gc.set_threshold(700, 10, 10)
        faulthandler.dump_traceback_later(2 * PATIENCE, exit=True)
        sibling.join()
        self._finish()
        faulthandler.cancel_dump_traceback_later()

    def _make_a_call(self) -> None:
        rare = self._random.randrange(20) == 0
        call = self._random.choice(self._rare if rare else self._kinds)
        faulthandler.dump_traceback_later(2 * PATIENCE, exit=True)
        self.calls += 1
        try:
            try:
                self._armed = True
                call()
            finally:
                self._armed = False
        except Interrupted:
            self.interrupted += 1
        except BaseException:
            self.failures.append(f"{call.__name__}: {traceback.format_exc()}")

    def _keep_calling(self) -> None:
        """Call in another thread, where no handler runs: none of its calls may fail."""
        try:
            while not self._over and not self.failures:
                assert self._pool.apply(square, (5,)) == 25
                assert self._pool.map(square, iter(range(5))) == [0, 1, 4, 9, 16]
        except BaseException:
            self.failures.append(f"the sibling: {traceback.format_exc()}")

    def _check_asked(self) -> None:
        result, expected = self._asked.popleft()
        try:
            assert result.get(PATIENCE) == expected
        except BaseException:
            self.failures.append(f"what was asked in between: {traceback.format_exc()}")

    def _lost(self, unraisable: Any) -> None:
        """Record an exception that cannot be caught, as in a finalizer."""
        if unraisable.exc_type is not Interrupted:
            shown = traceback.format_exception(unraisable.exc_value)
            self.failures.append(f"in {unraisable.object!r}: {''.join(shown)}")

    def _finish(self) -> None:
        while self._asked:
            self._check_asked()
        self._wait(lambda: not self._unfinished(), lambda: f"not done: {self._unfinished()}")
        if self._pool.map(square, range(5)) != [0, 1, 4, 9, 16]:
            self.failures.append("its map is wrong")
        self._spare.clear()
        self._other.terminate()
        self._pool.close()
        for pool in (self._other, self._pool):
            pool.join()
        children = fiber.active_children
        self._wait(lambda: not children(), lambda: f"processes left: {children()}")

    def _unfinished(self) -> list[tuple[int, int, bool]]:
        return [(job.fed, job.done, job.closed) for job in unfinished(self._pool)]

    def _wait(self, condition: Callable[[], bool], what: Callable[[], str]) -> None:
        deadline = time.monotonic() + PATIENCE
        while not condition():
            if time.monotonic() > deadline:
                self.failures.append(what())
                return
            gc.collect()
            time.sleep(0.01)


def _within_finalizer(frame: FrameType | None) -> bool:
    """Return whether an exception would be lost, and with it the work of a finalizer."""
    while frame is not None:
        if frame.f_code.co_name == "__del__" or frame.f_code is util.Finalize.__call__.__code__:
            return True
        frame = frame.f_back
    return False


def unfinished(pool: Pool) -> Iterator[Any]:
    """Return the jobs of a pool that are not done, except an idle job of single calls."""
    for job in list(pool._executor._scheduler.ledger.jobs):
        if job.owner.future is not None or job.done < job.fed:
            yield job


def descriptors() -> dict[str, str]:
    """The open files of this process."""
    found = {}
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):  # the one that lists the folder
            found[name] = os.readlink(f"/proc/self/fd/{name}")
    return found


def left(before: dict[str, str], interrupted: int) -> list[str]:
    """Name the objects that exist after the end and did not exist before."""
    ours = {name: what for name, what in descriptors().items() if before.get(name) != what}
    heap = [name for name, what in ours.items() if what == leaks.HEAP]
    if len(heap) <= leaks.HEAP_LIMIT:  # memory of channels is kept for later ones
        ours = {name: what for name, what in ours.items() if name not in heap}
    found = [f"left open: {name}: {what}" for name, what in ours.items()]
    if len(ours) <= min(interrupted, LEFT_BY_INTERRUPTS):
        found = []
    if "pynng" in sys.modules and sorted(ours.values()) == POLLER:
        found = []  # it stays until the process ends
    threads = set(threading.enumerate()) - {threading.main_thread()}
    return found + [f"left running: {thread.name}" for thread in threads if thread.is_alive()]


def main() -> None:
    """Run as the arguments say."""
    mode, seed, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    warnings.simplefilter("ignore", ResourceWarning)  # threads of the pools that are dropped
    sys.setswitchinterval(1e-4)
    before = descriptors()
    calls = RandomCalls(mode, seed)
    failures = calls.failures
    sys.excepthook = lambda *error: failures.append("".join(traceback.format_exception(*error)))
    calls.run(seconds)
    interrupted = calls.interrupted
    print(f"{calls.calls} calls, {interrupted} interrupted, {calls.entered} in between")
    del calls
    gc.collect()
    state.shutdown()
    failures += left(before, interrupted)
    print(*failures, sep="\n", file=sys.stderr)
    sys.exit(bool(failures))
