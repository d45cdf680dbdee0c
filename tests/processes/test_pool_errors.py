"""Objects that do not pickle or unpickle: an error where it belongs, and never a hang."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from multiprocessing.pool import MaybeEncodingError, RemoteTraceback  # type: ignore[attr-defined]
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import fiber
from fiber._runtime.threads import BackgroundThread
from fiber.errors import UnpicklableError
from fiber.pool import AsyncResult, Pool
from patience import PATIENCE
from processes import pool_tasks as tasks

pytestmark = pytest.mark.usefixtures("backend")


@pytest.fixture
def pool() -> Iterator[Pool]:
    pool = fiber.Pool(2)
    yield pool
    assert pool.apply_async(tasks.square, (3,)).get(PATIENCE) == 9, "the pool does not go on"
    pool.close()
    pool.join()


# Tasks that raise


def test_an_exception_comes_with_its_remote_traceback(pool: Pool) -> None:
    with pytest.raises(ValueError, match="5") as caught:
        pool.apply(tasks.raise_value_error, (5,))
    cause = caught.value.__cause__
    assert isinstance(cause, RemoteTraceback)
    assert "raise ValueError(value)" in str(cause)


@pytest.mark.parametrize("chunksize", [None, 1, 4])
def test_errors_stay_with_their_tasks(pool: Pool, chunksize: int | None) -> None:
    pool.map(tasks.identity, range(100))
    found = tasks.gather(pool.imap(tasks.raise_if_odd, range(40), chunksize or 1))
    for index, value in enumerate(found):
        assert value == index if index % 2 == 0 else value.args == (index,)
    with pytest.raises(ValueError, match=r"\d"):
        pool.map(tasks.raise_if_odd, range(40), chunksize)


ALL_CALLS: dict[str, Callable[[Pool], object]] = {
    "starmap": lambda pool: pool.starmap(tasks.raise_if_odd, [(1,)] * 3),
    "imap_unordered": lambda pool: list(pool.imap_unordered(tasks.raise_if_odd, range(10))),
    "map_async": lambda pool: pool.map_async(tasks.raise_if_odd, range(10)).get(PATIENCE),
    "apply_async": lambda pool: pool.apply_async(tasks.raise_if_odd, (3,)).get(PATIENCE),
}


@pytest.mark.parametrize("call", ALL_CALLS)
def test_each_call_raises_the_error_of_its_task(pool: Pool, call: str) -> None:
    with pytest.raises(ValueError, match=r"\d"):
        ALL_CALLS[call](pool)


def test_a_base_exception_reaches_the_caller(pool: Pool) -> None:
    with pytest.raises(tasks.Exotic, match="strange"):
        pool.apply(tasks.raise_exotic)


# Results


@pytest.mark.parametrize("chunksize", [1, 10])
def test_results_that_do_not_travel_are_errors_of_their_tasks_only(
    pool: Pool, chunksize: int
) -> None:
    found = tasks.gather(pool.imap(tasks.odd_results, range(30), chunksize))
    for index, value in enumerate(found):
        if index % 5 in (2, 3):
            assert isinstance(value, MaybeEncodingError)
        else:
            assert value == index
    assert "<Unpicklable>" in str(found[2])
    assert "cannot be pickled" in str(found[2])
    assert "cannot be unpickled in the program" in str(found[3])


@pytest.mark.parametrize("chunksize", [None, 1, 10])
def test_a_map_with_such_a_result_raises(pool: Pool, chunksize: int | None) -> None:
    with pytest.raises(MaybeEncodingError):
        pool.map(tasks.odd_results, [0, 1, 2], chunksize)
    result = pool.map_async(tasks.odd_results, [0, 1, 3], chunksize)
    result.wait(PATIENCE)
    assert not result.successful()
    with pytest.raises(MaybeEncodingError):
        result.get()


@pytest.mark.parametrize("chunksize", [1, 10])
def test_an_open_file_is_no_result(pool: Pool, tmp_path: Path, chunksize: int) -> None:
    path = tmp_path / "log"
    path.write_text("one line")
    with pytest.raises(MaybeEncodingError, match=f"open file '{path}'"):
        pool.apply(open, (path,))
    with pytest.raises(MaybeEncodingError, match="pass its path"):
        pool.map(open, [path] * 3, chunksize)


@pytest.mark.parametrize(
    ("options", "culprit"),
    [
        (
            {"initializer": threading.Lock().acquire},
            "the initializer of the pool cannot be pickled",
        ),
        (
            {"initializer": print, "initargs": (1, {"log": threading.Lock()})},
            "initargs[1] of the pool cannot be pickled (at ['log'])",
        ),
    ],
)
def test_a_part_of_an_initializer_that_does_not_pickle_is_named(
    options: dict[str, Any], culprit: str
) -> None:
    with pytest.raises(UnpicklableError) as caught:
        fiber.Pool(1, **options)
    assert str(caught.value).startswith(culprit)


def test_a_result_that_cannot_even_be_shown(pool: Pool) -> None:
    with pytest.raises(MaybeEncodingError, match="Unreprable object"):
        pool.apply(tasks.unreprable_result)


def test_error_callbacks_get_the_error_of_an_unpicklable_result(pool: Pool) -> None:
    heard: list[Any] = []
    for x in (2, 3):
        result = pool.apply_async(tasks.odd_results, (x,), error_callback=heard.append)
        result.wait(PATIENCE)
    assert [type(error) for error in heard] == [MaybeEncodingError] * 2


# Arguments


@pytest.mark.parametrize("chunksize", [None, 1, 10])
def test_an_argument_that_does_not_pickle(pool: Pool, chunksize: int | None) -> None:
    with pytest.raises(RuntimeError, match="cannot be pickled"):
        pool.map(tasks.identity, [1, tasks.Unpicklable(), 3], chunksize)
    with pytest.raises(RuntimeError, match="cannot be pickled"):
        pool.apply(tasks.identity, (tasks.Unpicklable(),))


@pytest.mark.parametrize("source", [list, iter])
def test_only_tasks_with_unpicklable_arguments_fail(pool: Pool, source: Any) -> None:
    pool.map(tasks.identity, range(1000))  # batches become large
    bad = {3, 200, 201, 499}
    items = [tasks.Unpicklable() if n in bad else n for n in range(500)]
    found = tasks.gather(pool.imap(tasks.identity, source(items)))
    assert {n for n, value in enumerate(found) if isinstance(value, RuntimeError)} == bad
    assert all(value == n for n, value in enumerate(found) if n not in bad)


@pytest.mark.parametrize("chunksize", [1, 7])
def test_only_tasks_whose_arguments_do_not_unpickle_fail(pool: Pool, chunksize: int) -> None:
    pool.map(tasks.identity, range(1000))
    bad = {3, 200, 201, 499}
    items = [tasks.UnreadableInWorker() if n in bad else n for n in range(500)]
    found = tasks.gather(pool.imap(tasks.identity, items, chunksize))
    assert {n for n, value in enumerate(found) if isinstance(value, RuntimeError)} == bad
    assert all(value == n for n, value in enumerate(found) if n not in bad)
    assert "cannot be unpickled in a worker" in str(found[3])


def test_a_call_whose_arguments_do_not_unpickle(pool: Pool) -> None:
    results = [
        pool.apply_async(tasks.identity, (tasks.UnreadableInWorker() if n == 5 else n,))
        for n in range(10)
    ]
    for n, result in enumerate(results):
        if n == 5:
            with pytest.raises(RuntimeError, match="in a worker"):
                result.get(PATIENCE)
        else:
            assert result.get(PATIENCE) == n


def test_the_argument_that_does_not_pickle_is_named(pool: Pool) -> None:
    lock: Any = threading.Lock()
    identity = tasks.identity
    calls: list[tuple[str, Callable[[], Any]]] = [
        ("argument 1 of add()", lambda: pool.apply(tasks.add, (1, lock))),
        ("argument 'y' of add()", lambda: pool.apply(tasks.add, (1,), {"y": lock})),
        ("argument 0 of identity()", lambda: pool.broadcast(identity, lock)),
        ("the item of task 1 of identity()", lambda: pool.map(identity, [1, lock])),
        ("the item of task 1 of identity()", lambda: pool.map(identity, iter([1, lock]), 2)),
        ("the item of task 0 of identity()", lambda: list(pool.imap(identity, [lock]))),
        ("the item of task 0 of add()", lambda: pool.starmap(tasks.add, [(1, lock)])),
        ("the function functools.partial(", lambda: pool.apply(partial(identity, lock))),
        ("the function lock.acquire", lambda: pool.map(lock.acquire, [1])),
        ("the function lock.acquire", lambda: pool.apply(lock.acquire)),
    ]
    for what, call in calls:
        with pytest.raises(UnpicklableError, match=r"_thread\.lock") as caught:
            call()
        assert caught.value.what.startswith(what)


@pytest.mark.parametrize("make", ["Lock", "Queue"])
def test_objects_of_multiprocessing_are_refused_with_advice(pool: Pool, make: str) -> None:
    theirs = getattr(multiprocessing, make)()
    for call in (
        lambda: pool.apply(tasks.identity, (theirs,)),
        lambda: pool.map(tasks.identity, [theirs]),
        lambda: pool.broadcast(tasks.identity, theirs),
    ):
        with pytest.raises(UnpicklableError, match=r"of multiprocessing.*fiber\.adopt\(\)"):
            call()


def test_the_error_names_the_path_to_an_unpicklable_object(pool: Pool) -> None:
    with pytest.raises(UnpicklableError, match=r"\(at \['a'\]\[1\]\.lock\)"):
        pool.map(tasks.identity, [{"a": [1, SimpleNamespace(lock=threading.Lock())]}])


def test_an_open_file_is_refused_as_in_multiprocessing(pool: Pool) -> None:
    with open(__file__) as file, pytest.raises(TypeError, match="pass its path"):
        pool.apply(tasks.identity, (file,))


# Functions


@pytest.mark.parametrize("call", ["map", "starmap", "imap", "apply", "broadcast"])
def test_a_function_that_does_not_pickle(pool: Pool, call: str) -> None:
    with pytest.raises((RuntimeError, pickle.PicklingError), match="cannot be pickled"):
        run(pool, call, tasks.Unpicklable().__repr__)


class Unreadable:
    """Iterable with a length, which fails when it is read."""

    def __len__(self) -> int:
        return 1

    def __iter__(self) -> Iterator[int]:
        raise ValueError("unreadable")


@pytest.mark.parametrize(
    "ask",
    [
        lambda pool, tell: pool.apply_async(tasks.square, (threading.Lock(),), {}, None, tell),
        lambda pool, tell: pool.map_async(tasks.Unpicklable().__repr__, [1], None, None, tell),
        lambda pool, tell: pool.map_async(tasks.square, Unreadable(), None, None, tell),
    ],
    ids=["a call", "a function", "items"],
)
def test_the_error_of_an_unpicklable_task_reaches_its_callback_from_the_loop_thread(
    pool: Pool,
    ask: Callable[[Pool, Callable[[Any], None]], AsyncResult[Any]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """So that the callbacks' thread is started, used and stopped by one thread."""
    on_loop: list[bool] = []
    submit = BackgroundThread.submit

    def noting(thread: BackgroundThread, *args: Any) -> bool:
        on_loop.append(pool._executor.on_loop())
        return submit(thread, *args)

    monkeypatch.setattr(BackgroundThread, "submit", noting)
    told: list[BaseException] = []
    result = ask(pool, told.append)
    with pytest.raises(Exception) as caught:
        result.get(PATIENCE)
    (heard,) = told
    assert (type(heard), heard.args) == (type(caught.value), caught.value.args)
    assert on_loop == [True]


@pytest.mark.parametrize("call", ["map", "starmap", "imap", "apply", "broadcast"])
def test_a_function_that_does_not_unpickle(pool: Pool, call: str) -> None:
    with pytest.raises(RuntimeError, match="cannot be unpickled in a worker"):
        run(pool, call, tasks.UnreadableInWorker())


@pytest.mark.filterwarnings("error")
def test_the_error_of_a_function_may_raise_anything_when_it_is_unpickled(pool: Pool) -> None:
    with pytest.raises(SystemExit):
        pool.map_async(tasks.ExitingInMaster(), [1]).get(PATIENCE)


def run(pool: Pool, call: str, function: Any) -> Any:
    if call == "apply":
        return pool.apply(function, (1,))
    if call == "broadcast":
        return pool.broadcast(function)
    if call == "starmap":
        return pool.starmap(function, [(1,)] * 20)
    if call == "imap":
        return list(pool.imap(function, iter(range(20))))
    return pool.map(function, range(20))


# Retries of tasks that raise


def test_a_pool_retries_the_given_exceptions(tmp_path: Any) -> None:
    with fiber.Pool(2, retry_exceptions=ConnectionError) as pool:
        assert pool.apply(tasks.fail_until, (tmp_path / "a", 3)) == "done"
        assert tasks.runs(tmp_path / "a") == 4
        with pytest.raises(ConnectionError, match="try 4"):
            pool.apply(tasks.fail_until, (tmp_path / "b", 4))
        with pytest.raises(KeyError, match="always"):
            pool.map(tasks.counted_error, [tmp_path / "c"])
        assert tasks.runs(tmp_path / "c") == 1
        paths = [(tmp_path / f"d{n}", n % 3) for n in range(30)]
        assert pool.starmap(tasks.fail_until, paths) == ["done"] * 30
        assert list(pool.imap(tasks.raise_if_odd, [2, 4])) == [2, 4]
    pool.join()


def test_error_handling_retries_any_exception_within_bounds(tmp_path: Any) -> None:
    with fiber.Pool(1, error_handling=True, retries=2) as pool:
        with pytest.raises(KeyError, match="always"):
            pool.map(tasks.counted_error, [tmp_path / "c"])
        assert tasks.runs(tmp_path / "c") == 3
        assert pool.apply(tasks.fail_until, (tmp_path / "d", 2)) == "done"
        assert pool.map(tasks.square, range(5)) == [0, 1, 4, 9, 16]
    pool.join()


def test_without_retries_a_failed_task_runs_once(tmp_path: Any) -> None:
    with fiber.Pool(1, error_handling=True, retries=0) as pool:
        with pytest.raises(KeyError, match="always"):
            pool.apply(tasks.counted_error, (tmp_path / "c",))
        assert tasks.runs(tmp_path / "c") == 1
    pool.join()


# The main module

_GUARDED = """
import fiber

if __name__ == "__main__":
    def square(number):
        return number * number

    class Number:
        pass

    process = fiber.Process(target=square, args=(1,))
    process.start()
    process.join()
    with fiber.Pool(1) as pool:
        for call in (
            lambda: pool.apply(square, (1,)),
            lambda: pool.map(square, [1]),
            lambda: pool.map(abs, [Number()]),
        ):
            try:
                call()
            except AttributeError as error:
                print(*error.__notes__, sep="\\n")
"""


def test_the_guard_of_the_main_module_is_named(backend: str, tmp_path: Path) -> None:
    program = tmp_path / "guarded.py"
    program.write_text(_GUARDED)
    done = subprocess.run(
        [sys.executable, str(program)],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env={**os.environ, "FIBER_BACKEND": backend},
    )
    notes = done.stdout.splitlines()
    assert len(notes) == 3, done.stderr
    for text in (*notes, done.stderr):
        assert 'do not run the lines under `if __name__ == "__main__":`' in text
        assert text.count("move it above that line") == 1
