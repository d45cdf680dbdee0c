"""Process beyond what multiprocessing's own tests cover: starts that fail, ends, inheritance."""

from __future__ import annotations

import multiprocessing
import multiprocessing.process
import os
import signal
import threading
import weakref
from collections.abc import Iterator
from typing import Any

import pytest

import census
import fiber
from fiber import config, process
from fiber._agent.interface import ExitReport
from fiber._runtime import popen, state
from fiber.errors import StartError, UnpicklableError
from patience import PATIENCE
from unit.agent_children import run_forever


@pytest.fixture(scope="module", autouse=True)
def runtime() -> Iterator[state.Runtime]:
    state.shutdown()
    yield state.runtime()
    state.shutdown()


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def send_name_of_host(connection: Any) -> None:
    from fiber._agent import child

    connection.send((child.host, fiber.current_process().name, os.getppid()))


def start_another(connection: Any, depth: int) -> None:
    if depth:
        deeper = fiber.Process(target=start_another, args=(connection, depth - 1))
        deeper.start()
        deeper.join()
        connection.send(deeper.exitcode)
    else:
        connection.send("deepest")


def report_environment(connection: Any) -> None:
    connection.send((os.environ.get("SET_LATE"), os.getcwd()))


def test_a_child_knows_its_host_and_its_name(pipe: tuple[Any, Any]) -> None:
    child = fiber.Process(target=send_name_of_host, args=(pipe[1],), name="a name / with anything")
    child.start()
    host, name, parent = pipe[0].recv()
    child.join()
    assert (host, name) == ("local", "a name / with anything")
    assert parent != os.getpid(), "its parent is the zygote"


def test_a_child_sees_the_environment_and_directory_of_now(
    pipe: tuple[Any, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    monkeypatch.setenv("SET_LATE", "yes")
    monkeypatch.chdir(tmp_path)
    child = fiber.Process(target=report_environment, args=(pipe[1],))
    child.start()
    assert pipe[0].recv() == ("yes", str(tmp_path))
    child.join()


@pytest.mark.slow
def test_processes_nest_to_any_depth(pipe: tuple[Any, Any]) -> None:
    child = fiber.Process(target=start_another, args=(pipe[1], 3))
    child.start()
    assert [pipe[0].recv() for _ in range(4)] == ["deepest", 0, 0, 0]
    child.join()
    assert child.exitcode == 0


def test_a_daemon_may_have_children(pipe: tuple[Any, Any]) -> None:
    child = fiber.Process(target=start_another, args=(pipe[1], 1), daemon=True)
    child.start()
    assert [pipe[0].recv() for _ in range(2)] == ["deepest", 0]
    child.join()


def test_a_lambda_and_a_closure_can_be_targets(pipe: tuple[Any, Any]) -> None:
    connection, value = pipe[1], {"of": "a closure"}
    child = fiber.Process(target=lambda: connection.send(value))
    child.start()
    assert pipe[0].recv() == value
    child.join()


@pytest.mark.parametrize("target", [threading.Lock(), (item for item in "")])
def test_an_unpicklable_argument_is_refused_at_the_start_and_leaks_no_file(
    target: Any, pipe: tuple[Any, Any]
) -> None:
    before = open_files()
    child = fiber.Process(target=print, args=(pipe[1], target))
    with pytest.raises(TypeError, match="pickle"):
        child.start()
    del child
    assert open_files() == before
    assert fiber.active_children() == []


@pytest.mark.parametrize(
    ("options", "culprit"),
    [
        ({"target": threading.Lock().acquire}, "the target"),
        ({"target": print, "args": (1, threading.Lock())}, "argument 1"),
        ({"target": print, "kwargs": {"file": threading.Lock()}}, "argument 'file'"),
    ],
)
def test_an_argument_that_does_not_pickle_is_named(options: dict[str, Any], culprit: str) -> None:
    with pytest.raises(UnpicklableError, match=f"{culprit} of process 'odd' cannot be pickled"):
        fiber.Process(name="odd", **options).start()


@pytest.mark.parametrize("make", ["Lock", "Queue"])
def test_objects_of_multiprocessing_are_refused_with_advice(make: str) -> None:
    """multiprocessing's own error is about start methods, which are not the reason."""
    theirs = getattr(multiprocessing.get_context("fork"), make)()
    with pytest.raises(UnpicklableError, match=r"fiber\.adopt\(\)") as caught:
        fiber.Process(name="odd", target=print, args=({"it": theirs},)).start()
    assert "argument 0 of process 'odd' cannot be pickled (at ['it'])" in str(caught.value)


def test_an_error_of_the_objects_own_pickling_is_left_as_it_is() -> None:
    class Odd:
        def __reduce__(self) -> str:
            raise ZeroDivisionError("in its own code")

    with pytest.raises(ZeroDivisionError, match="in its own code"):
        fiber.Process(target=print, args=(Odd(),)).start()


def test_starts_and_ends_leave_no_descriptor() -> None:
    for _ in range(3):
        before = open_files()
        children = [fiber.Process(target=os.getpid) for _ in range(5)]
        for child in children:
            child.start()
        for child in children:
            child.join()
            child.close()
        assert census.wait_until(lambda: open_files() <= before, PATIENCE)  # noqa: B023


def test_a_process_that_is_dropped_gives_its_sentinel_back() -> None:
    before = open_files()
    child = fiber.Process(target=os.getpid)
    child.start()
    child.join()
    fiber.active_children()  # forgets those that ended
    reference = weakref.ref(child)
    del child
    assert reference() is None
    assert census.wait_until(lambda: open_files() <= before, PATIENCE)


def test_a_start_asks_no_other_child(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    fiber.active_children()
    first, second = fiber.Process(target=run_forever), fiber.Process(target=os.getpid)
    first.start()
    monkeypatch.setattr(first._popen, "poll", lambda: asked.append("first"))
    second.start()
    assert asked == []
    first.kill()
    first._popen.wait()
    second.join()


def test_a_start_drops_the_children_that_ended(pipe: tuple[Any, Any]) -> None:
    here, there = pipe
    ended = fiber.Process(target=there.recv)
    ended.start()
    here.send("end")  # not before: one that ends within its start is dropped by that
    ended._popen.wait(PATIENCE)
    assert ended in vars(multiprocessing.process)["_children"]
    reference = weakref.ref(ended)
    del ended
    another = fiber.Process(target=os.getpid)
    another.start()
    assert reference() is None
    another.join()


def test_a_child_that_ends_before_its_start_returns_is_dropped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wait_for_birth = popen.Popen._wait_for_answer

    def wait_for_end(self: popen.Popen, handle: Any) -> None:
        wait_for_birth(self, handle)
        self.wait(PATIENCE)
        process._drop_ended()

    monkeypatch.setattr(popen.Popen, "_wait_for_answer", wait_for_end)
    child = fiber.Process(target=os.getpid)
    child.start()
    assert child not in vars(multiprocessing.process)["_children"]


@pytest.mark.parametrize("round_", range(5))
def test_a_signal_right_after_the_start_is_not_lost(round_: int) -> None:
    child = fiber.Process(target=run_forever)
    child.start()
    child.terminate()
    child.join(PATIENCE)
    assert child.exitcode == -signal.SIGTERM


def test_many_threads_start_processes_at_once() -> None:
    exit_codes: list[int | None] = []

    def start() -> None:
        for _ in range(3):
            child = fiber.Process(target=os._exit, args=(4,))
            child.start()
            child.join()
            exit_codes.append(child.exitcode)

    threads = [threading.Thread(target=start) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert exit_codes == [4] * 12


def test_the_start_during_the_import_of_main_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fiber.current_process(), "_inheriting", True, raising=False)
    with pytest.raises(RuntimeError, match='if __name__ == "__main__"'):
        fiber.Process(target=os.getpid).start()


# Starts that fail, with agents that only a test can have


class FakeChild:
    name, host, pid, start_error = "p", "elsewhere", None, None

    def __init__(self) -> None:
        self.signals: list[int] = []

    def start(self) -> None:
        """Return without a result."""

    def signal(self, signum: int) -> None:
        self.signals.append(signum)


@pytest.fixture
def silent(monkeypatch: pytest.MonkeyPatch, runtime: state.Runtime) -> FakeChild:
    """An agent that never answers."""
    child = FakeChild()

    def start(_process: Any, owner: Any, **_: Any) -> FakeChild:
        runtime.loop.call_soon(owner.begin, child)
        return child

    monkeypatch.setattr(runtime, "start", start)
    monkeypatch.setattr(runtime, "config", config.load({"start_timeout": 0.05}))
    return child


def settle(runtime: state.Runtime) -> None:
    """Let the loop do all that it was asked for."""
    done = threading.Event()
    runtime.loop.call_soon(done.set)
    assert done.wait(PATIENCE)


def test_an_agent_that_does_not_answer_is_an_error_and_the_late_child_is_killed(
    silent: FakeChild,
) -> None:
    before = open_files()
    with pytest.raises(StartError, match=r"process 'slow' did not start.*'elsewhere'.*0\.05 s"):
        fiber.Process(target=os.getpid, name="slow").start()
    settle(state.runtime())
    assert silent.signals == [signal.SIGKILL]
    assert open_files() == before


def test_an_interrupted_start_kills_the_late_child(
    silent: FakeChild, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(popen.Popen, "_wait_for_answer", interrupt)
    with pytest.raises(KeyboardInterrupt):
        fiber.Process(target=os.getpid).start()
    settle(state.runtime())
    assert silent.signals == [signal.SIGKILL]


def test_a_start_that_the_system_refuses_says_why(
    monkeypatch: pytest.MonkeyPatch, runtime: state.Runtime
) -> None:
    def refuse(_process: Any, observer: Any, **_: Any) -> FakeChild:
        observer.exited(ExitReport(1, "could not be started: no memory"))
        return FakeChild()

    monkeypatch.setattr(runtime, "start", refuse)
    with pytest.raises(
        StartError, match="process 'big' did not start: could not be started: no memory"
    ):
        fiber.Process(target=os.getpid, name="big").start()
    assert fiber.active_children() == []


def test_the_class_is_multiprocessings_underneath() -> None:
    assert issubclass(process.Process, multiprocessing.process.BaseProcess)
    assert fiber.current_process() is multiprocessing.process.current_process()
