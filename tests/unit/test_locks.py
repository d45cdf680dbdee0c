"""Lock and RLock on one host, and the shared semaphore below them."""

from __future__ import annotations

import contextlib
import gc
import math
import os
import pickle
import threading
import warnings
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

import fiber
from fiber._hub import shared_blocks
from fiber._sync import liveness
from fiber._sync import semaphore as module
from fiber._sync.semaphore import COUNTING, RECURSIVE, SEM_VALUE_MAX, SharedSemaphore
from fiber.synchronize import Abandoned
from patience import PATIENCE
from unit.interrupting import LINES, is_interrupted

# From Python 3.12 on os.fork() warns of any thread, and the runtime's loop may be one.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")

KINDS = {"mutex": (COUNTING, 1), "recursive": (RECURSIVE, 1), "counting": (COUNTING, SEM_VALUE_MAX)}


@pytest.fixture(params=list(KINDS.values()), ids=list(KINDS))
def one(request: pytest.FixtureRequest) -> SharedSemaphore:
    kind, maximum = request.param
    return shared_blocks.create_semaphore(kind, 1, maximum)


def take_turn(semaphore: SharedSemaphore) -> None:
    semaphore.acquire()
    semaphore.release()


def in_fork(action: Callable[[], object]) -> None:
    """Do it in a process of its own, which ends by that as if it were killed."""
    pid = os.fork()
    if not pid:
        gc.disable()  # a fork must not end sockets of nng that other tests have left as garbage
        try:
            action()
        finally:
            os._exit(0)
    os.waitpid(pid, 0)


def elsewhere(action: Callable[[], Any]) -> Any:
    """Return its result, computed on another thread."""
    results: list[Any] = []
    thread = threading.Thread(target=lambda: results.append(action()))
    thread.start()
    thread.join(PATIENCE)
    return results[0]


@contextlib.contextmanager
def held_elsewhere(lock: Any) -> Iterator[None]:
    """Another process has it in the block."""
    ready, stop = os.pipe(), os.pipe()
    pid = os.fork()
    if not pid:
        os.close(stop[1])
        lock.acquire()
        os.write(ready[1], b"1")
        os.read(stop[0], 1)
        os._exit(0)
    os.read(ready[0], 1)
    try:
        yield
    finally:
        for end in (*ready, *stop):
            os.close(end)
        os.waitpid(pid, 0)


@pytest.mark.parametrize("make", [fiber.Lock, fiber.RLock])
def test_a_lock_has_one_holder_at_a_time(make: Callable[[], Any]) -> None:
    lock = make()
    with held_elsewhere(lock):
        assert not lock.acquire(False)
        assert not lock.acquire(timeout=0.01)
        assert not lock.acquire(timeout=-1)
        assert "SomeOtherProcess" in repr(lock)


def test_a_try_does_not_wait_for_the_mutex_of_a_revival(one: SharedSemaphore) -> None:
    entered, leave = threading.Event(), threading.Event()

    def hold_mutex() -> None:
        def hold() -> None:
            entered.set()
            leave.wait(PATIENCE)

        one._mutex.run(hold)

    holder = threading.Thread(target=hold_mutex)
    holder.start()
    entered.wait(PATIENCE)
    tried = [one.try_acquire(), leave.is_set() or holder.is_alive()]
    leave.set()
    holder.join(PATIENCE)
    assert tried == [False, True]
    assert one.try_acquire()


def test_who_finds_the_mutex_taken_gets_it_afterwards(
    one: SharedSemaphore, monkeypatch: pytest.MonkeyPatch
) -> None:
    entered, found_taken = threading.Event(), threading.Event()
    steps: list[str] = []

    def hold_mutex() -> None:
        entered.set()
        found_taken.wait(PATIENCE)
        steps.append("first")

    def sleep(_: float) -> None:
        assert not steps, "it does not try again"
        found_taken.set()
        holder.join(PATIENCE)

    monkeypatch.setattr(liveness, "time", SimpleNamespace(sleep=sleep))
    holder = threading.Thread(target=lambda: one._mutex.run(hold_mutex))
    holder.start()
    entered.wait(PATIENCE)
    one._mutex.run(lambda: steps.append("second"))
    assert steps == ["first", "second"]


def test_a_waiter_sleeps_in_the_kernel(one: SharedSemaphore) -> None:
    assert elsewhere(one.acquire)
    waits: list[bool] = []
    take = one._take

    def taking(block: bool, timeout: float | None) -> object:
        waits.append(block)
        return take(block, timeout)

    one._take = taking
    assert not one.acquire(False)
    assert waits == [False]
    assert not one.acquire(timeout=0.01)
    assert waits[:3] == [False, False, True]


def test_each_release_rings_while_the_hub_listens() -> None:
    semaphore = shared_blocks.create_semaphore(COUNTING, 1, SEM_VALUE_MAX)
    rings: list[None] = []
    semaphore._ring = lambda: rings.append(None)
    for listens, count in ((False, 0), (True, 2), (False, 2)):
        semaphore.listen(listens)
        take_turn(semaphore)
        semaphore.release()  # what this process has not acquired
        assert len(rings) == count


@pytest.mark.parametrize("make", [fiber.Lock, fiber.RLock, fiber.Condition])
def test_an_invalid_timeout_is_refused_by_a_free_lock_too(make: Callable[[], Any]) -> None:
    lock = make()
    with pytest.raises(TypeError, match="must be real number, not str"):
        lock.acquire(timeout="a")
    with pytest.raises(ValueError, match="not NaN"):
        lock.acquire(timeout=math.nan)
    assert lock.acquire(timeout=1)


def test_a_lock_names_its_holder() -> None:
    lock = fiber.Lock()
    assert repr(lock) == "<Lock(owner=None)>"
    with lock as acquired:
        assert acquired is True
        assert repr(lock) == "<Lock(owner=MainProcess)>"
        assert elsewhere(lambda: repr(lock)) == "<Lock(owner=SomeOtherThread)>"
        assert not lock.acquire(False)
    with pytest.raises(ValueError, match="too many times"):
        lock.release()


def test_an_rlock_is_its_threads() -> None:
    lock = fiber.RLock()
    assert repr(lock) == "<RLock(None, 0)>"
    with lock, lock:
        assert repr(lock) == "<RLock(MainProcess, 2)>"
        assert elsewhere(lambda: repr(lock)) == "<RLock(SomeOtherThread, nonzero)>"
        assert not elsewhere(lambda: lock.acquire(False))
    with pytest.raises(AssertionError, match="not owned by thread"):
        lock.release()
    assert elsewhere(lambda: lock.acquire(False))


# Holders that die


def test_tokens_of_a_dead_process_are_released(one: SharedSemaphore) -> None:
    in_fork(one.acquire)
    with pytest.warns(RuntimeWarning, match=r"MainProcess \(pid \d+\) ended while it held"):
        acquired = one.acquire(timeout=PATIENCE)
    assert isinstance(acquired, Abandoned)
    assert acquired == True  # noqa: E712 - as callers may compare it
    assert "MainProcess (pid " in pickle.loads(pickle.dumps(acquired)).holder
    one.release()
    assert one.acquire() is True, "only the first one is told"


def test_an_acquire_without_waiting_gets_it_too(one: SharedSemaphore) -> None:
    in_fork(one.acquire)
    with pytest.warns(RuntimeWarning, match="ended"):
        assert one.acquire(False)


@pytest.mark.parametrize("call", ["_take", "_give"])
def test_the_token_of_a_process_that_dies_between_two_steps_comes_back(
    one: SharedSemaphore, call: str
) -> None:
    def dies_after(step: Callable[..., object]) -> Callable[..., object]:
        return lambda *args: (step(*args), os._exit(0))

    step = getattr(one, call)
    setattr(one, call, dies_after(step))
    in_fork(lambda: take_turn(one))
    setattr(one, call, step)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        assert one.acquire(timeout=PATIENCE)
    assert not one._get_value()
    one.release()
    assert one._get_value() == 1


def test_a_dead_reviver_is_followed_by_another(
    one: SharedSemaphore, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_fork(one.acquire)
    monkeypatch.setattr(one.__class__, "_wait_until_quiet", lambda _: os._exit(0))
    in_fork(one.acquire)
    monkeypatch.undo()
    with pytest.warns(RuntimeWarning, match="ended"):
        assert one.acquire(timeout=PATIENCE)


def test_all_that_it_had_is_released() -> None:
    semaphore = shared_blocks.create_semaphore(COUNTING, 3, 3)
    in_fork(lambda: [semaphore.acquire() for _ in range(3)])
    with pytest.warns(RuntimeWarning, match="ended"):
        assert semaphore.acquire(timeout=PATIENCE)
    assert semaphore._get_value() == 2


def test_tokens_of_the_living_are_not_released() -> None:
    semaphore = shared_blocks.create_semaphore(COUNTING, 2, 2)
    semaphore.acquire()
    in_fork(semaphore.acquire)
    with pytest.warns(RuntimeWarning, match="ended"):
        assert semaphore.acquire(timeout=PATIENCE)
    assert not semaphore.acquire(timeout=2 * module.SLICE)


def test_a_semaphore_that_carries_signals_is_not_revived() -> None:
    semaphore = shared_blocks.create_semaphore(COUNTING, 1, SEM_VALUE_MAX)
    in_fork(semaphore.acquire)
    semaphore.release()  # what another one acquired
    assert semaphore.acquire() is True
    assert not semaphore.acquire(timeout=2 * module.SLICE)


def test_more_tokens_than_can_be_distinguished() -> None:
    semaphore = shared_blocks.create_semaphore(COUNTING, 1000, SEM_VALUE_MAX)
    assert all(semaphore.acquire(False) is True for _ in range(1000))
    assert not semaphore.acquire(False)
    for _ in range(1000):
        semaphore.release()
    assert semaphore._get_value() == 1000


def test_signals_are_consumed_without_end() -> None:
    semaphore = shared_blocks.create_semaphore(COUNTING, 0, SEM_VALUE_MAX)
    in_fork(lambda: [semaphore.release() for _ in range(2000)])
    assert all(semaphore.acquire(False) for _ in range(2000))
    assert len(semaphore._held) < 1000


def test_the_slots_of_the_dead_are_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    semaphore = shared_blocks.create_semaphore(COUNTING, 1, 1)
    for _ in range(len(module._SLOTS) // 64):
        in_fork(lambda: [semaphore._mutex.run(semaphore._claim) for _ in range(64)])
    in_fork(lambda: [semaphore._mutex.run(semaphore._claim) for _ in range(64)])
    assert semaphore.acquire()
    assert not semaphore._words[module._IS_UNTRACKED]


def test_a_fork_holds_no_token_of_its_parent(one: SharedSemaphore) -> None:
    one.acquire()
    in_fork(one.release if one.kind == COUNTING else (lambda: None))
    assert one._get_value() == (one.kind == COUNTING)


# Interruptions


@pytest.mark.parametrize("call", ["_take", "_give"])
@pytest.mark.parametrize("again", [False, True])
def test_ctrl_c_after_a_step_loses_no_token(one: SharedSemaphore, call: str, again: bool) -> None:
    if again:  # the first time it goes the longer way
        take_turn(one)
    step = getattr(one, call)

    def strike(*args: Any) -> None:
        setattr(one, call, step)
        step(*args)
        raise KeyboardInterrupt

    setattr(one, call, strike)
    with pytest.raises(KeyboardInterrupt):
        take_turn(one)
    assert one.acquire(timeout=PATIENCE) is True
    assert not elsewhere(lambda: one.acquire(False))
    one.release()
    assert one._get_value() == 1


def test_a_handler_that_uses_it_within_its_own_use(one: SharedSemaphore) -> None:
    claim = one._claim
    inner: list[Any] = []

    def interrupted() -> int:
        if not inner:
            inner.append(None)
            inner.append(one.acquire(False))
            one.release()
        return claim()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SharedSemaphore, "_claim", lambda _: interrupted())
        assert one.acquire() is True
    assert inner == [None, True]


@pytest.mark.slow
def test_ctrl_c_at_any_line_of_a_revival_releases_once(one: SharedSemaphore) -> None:
    steps = 0
    while True:
        in_fork(one.acquire)
        one._next_look = 0.0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            struck = is_interrupted(
                lambda: one._mutex.run(one._revive), steps, {module.__file__}, steps=LINES
            )
            assert one.acquire(timeout=PATIENCE)
        assert not elsewhere(lambda: one.acquire(False)), f"step {steps}"
        one.release()
        assert one._get_value() == 1
        if not struck:
            break
        steps += 1
    assert steps > 10, "it was hardly interrupted"
