"""Agent on real processes: it starts them, gets their messages, and ends."""

from __future__ import annotations

import os
import pickle
import queue
import resource
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from multiprocessing import spawn
from pathlib import Path
from typing import Any

import pytest

import census
from fiber import reduction
from fiber._agent import zygote_process
from fiber._agent.agent import Agent, LocalChild
from fiber._agent.interface import ChildSpec
from fiber._transport.loop import Loop
from fiber._wire import descriptor, packet
from fiber.errors import TooManyOpenFiles
from fiber.process import Process
from patience import PATIENCE
from unit.agent_children import (
    Handle,
    Recorder,
    answer_sums,
    read_never,
    run_forever,
    talk_nonsense,
    write_own_index,
)

Start = Callable[..., tuple[LocalChild, Recorder]]


@pytest.fixture(scope="module")
def shared(module_loop: Loop) -> Iterator[Agent]:
    """An agent for tests that do not break it."""
    made = Agent(module_loop, "here")
    yield made
    made.close()


@pytest.fixture
def own(module_loop: Loop) -> Iterator[Agent]:
    """An agent for one test."""
    made = Agent(module_loop, "here")
    yield made
    made.close()
    settled(module_loop)


def settled(loop: Loop) -> None:
    done = threading.Event()
    loop.call_soon(done.set)
    assert done.wait(PATIENCE)


def specification(target: Callable[..., Any], *args: Any, **options: Any) -> ChildSpec:
    """Return the runtime's specification of one process for an agent."""
    process = Process(target=target, args=args)
    preparation = spawn.get_preparation_data(process.name)
    preparation |= {"authkey": bytes(preparation["authkey"]), "calls": []}
    preparation |= {"same_host": True, "preload": []}
    for key in ("start_method", "init_main_from_name", "init_main_from_path"):
        preparation.pop(key, None)
    preparation |= options.pop("preparation", {})
    return ChildSpec(
        name=process.name,
        method=options.pop("method", "fork"),
        preparation=pickle.dumps(preparation),
        payload=reduction.dump_process(process, same_host=True)[0],
        **options,
    )


def begin(agent: Agent, target: Callable[..., Any], *args: Any, **options: Any) -> Any:
    """A child, once its agent has looked at it."""
    observer = Recorder()
    child = agent.child(specification(target, *args, **options), observer)
    agent.loop.call_soon(child.start)
    settled(agent.loop)
    if child.start_error is not None:
        raise child.start_error
    return child, observer


def end(child: LocalChild, observer: Recorder) -> None:
    child.signal(signal.SIGKILL)
    observer.wait_for_exit()


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.parametrize(("status", "reason"), [(0, "exit status 0"), (3, "exit status 3")])
def test_an_exit_status_is_reported_once(
    shared: Agent, method: str, status: int, reason: str
) -> None:
    child, observer = begin(shared, os._exit, status, method=method)
    report = observer.wait_for_exit()
    assert (report.exitcode, report.reason, report.host) == (status, reason, "here")
    assert observer.events == ["started", "exited"]
    assert observer.pid == child.pid != os.getpid()


@pytest.mark.parametrize("signum", [signal.SIGKILL, signal.SIGTERM, signal.SIGUSR1])
def test_a_signal_is_reported_by_its_name(shared: Agent, signum: signal.Signals) -> None:
    child, observer = begin(shared, run_forever)
    child.signal(signum)
    report = observer.wait_for_exit()
    assert report.exitcode == -signum
    assert report.reason == f"killed by {signum.name}"


def test_a_signal_to_an_ended_child_does_nothing(shared: Agent) -> None:
    child, observer = begin(shared, os._exit, 0)
    observer.wait_for_exit()
    child.signal(signal.SIGKILL)
    child.recall()
    child.deliver(1, b"nobody reads this")
    settled(shared.loop)
    assert observer.events == ["started", "exited"]


def test_a_child_is_measured_while_it_runs(shared: Agent) -> None:
    child, observer = begin(shared, run_forever)
    observer.wait_for_start()
    child.measure()
    (usage,) = observer.usages
    assert usage.memory > 1 << 20
    assert usage.cpu >= 0
    end(child, observer)
    child.measure()
    assert len(observer.usages) == 1


def test_work_goes_out_and_answers_come_back(shared: Agent) -> None:
    child, observer = begin(shared, answer_sums, tasks=True)
    large = bytes(100_000)
    child.deliver(1, pickle.dumps(7))
    child.deliver(2, pickle.dumps(8), [memoryview(large)])
    assert observer.wait_for_words(2) == [(1, 7), (2, 8 + len(large))]
    end(child, observer)


def test_a_packet_waits_for_the_report_of_the_start(
    own: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    replies: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
    reply = Agent._on_reply
    monkeypatch.setattr(
        Agent, "_on_reply", lambda *arguments: replies.put(partial(reply, *arguments))
    )
    child, observer = begin(own, read_never, tasks=True)
    report_start = replies.get(timeout=PATIENCE)
    assert child._ours is not None
    assert select.select([child._ours], [], [], PATIENCE)[0]
    settled(own.loop)
    assert observer.events == []
    own.loop.call_soon(report_start)
    observer.wait_for_words(1)
    assert observer.events == ["started", "received"]


def test_unread_packets_of_a_dead_worker_are_named(shared: Agent) -> None:
    child, observer = begin(shared, read_never, tasks=True)
    assert observer.wait_for_words(1) == ["ready"]
    payload = bytes(30_000)
    for seq in range(1, 31):  # more than its socket takes
        child.deliver(seq, payload)
    child.signal(signal.SIGKILL)
    report = observer.wait_for_exit()
    assert report.unread == tuple(range(1, 31))
    assert report.running == (17, 4)


def test_an_answer_that_cannot_be_handled_ends_its_worker(
    shared: Agent, capsys: pytest.CaptureFixture[str]
) -> None:
    """The master must not wait for it."""
    child, observer = begin(shared, answer_sums, tasks=True)

    def received(message: Any) -> None:
        message.release()
        raise ValueError("not this one")

    observer.received = received
    child.deliver(1, pickle.dumps(7))
    report = observer.wait_for_exit()
    assert report.reason == "killed by its agent: not this one"
    settled(shared.loop)
    assert "ValueError: not this one" in capsys.readouterr().err


def test_a_child_that_is_killed_before_its_fork_ends_at_once(own: Agent, tmp_path: Path) -> None:
    """Though its zygote imports the program's main module, for ever for all we know."""
    gate = tmp_path / "gate"
    os.mkfifo(gate)
    (tmp_path / "slow.py").write_text(f"open({str(gate)!r}).read()")
    preparation = {"preload": ["slow"], "sys_path": [str(tmp_path), *sys.path]}
    child, observer = begin(own, run_forever, preparation=preparation, tasks=True)
    writer = os.open(gate, os.O_WRONLY)  # returns once the import has begun
    child.signal(signal.SIGKILL)
    report = observer.wait_for_exit()
    assert report.reason == "killed by SIGKILL"
    assert child.pid is None
    os.close(writer)
    # The zygote goes on, and does not pass the dead child's state to the next one.
    other, second = begin(own, run_forever, tasks=True)
    end(other, second)


def test_closing_waits_for_no_import(own: Agent, tmp_path: Path) -> None:
    gate = tmp_path / "gate"
    os.mkfifo(gate)
    (tmp_path / "slow.py").write_text(f"open({str(gate)!r}).read()")
    preparation = {"preload": ["slow"], "sys_path": [str(tmp_path), *sys.path]}
    _, observer = begin(own, run_forever, preparation=preparation)
    writer = os.open(gate, os.O_WRONLY)
    own.close()
    assert observer.wait_for_exit().exitcode == -signal.SIGKILL
    os.close(writer)


def test_unread_packets_of_an_idle_worker_can_be_taken_back(shared: Agent) -> None:
    child, observer = begin(shared, read_never, tasks=True)
    observer.wait_for_words(1)
    for seq in (5, 6, 7):
        child.deliver(seq, b"work")
    child.recall()
    assert observer.wait_for_recall() == [5, 6, 7]
    end(child, observer)
    assert observer.report is not None
    assert observer.report.unread == ()


def test_its_last_words_come_before_its_end(shared: Agent) -> None:
    child, observer = begin(shared, answer_sums, tasks=True)
    for seq in range(1, 51):
        child.deliver(seq, pickle.dumps(seq))
    child.deliver(51, pickle.dumps("stop"))
    observer.wait_for_exit()
    assert observer.words == [(seq, seq) for seq in range(1, 51)]
    assert observer.events[-1] == "exited"


def test_descriptors_travel_however_many_and_none_stays(shared: Agent) -> None:
    before = len(os.listdir("/proc/self/fd"))
    pipes = [os.pipe() for _ in range(300)]
    fds = tuple(descriptor.own(writer) for _, writer in pipes)
    handles = [Handle(index) for index in range(200)]  # a hundred are not received
    _, observer = begin(shared, write_own_index, handles, fds=fds)
    assert observer.wait_for_exit().exitcode == 0
    for index, (reader, _) in enumerate(pipes):
        expected = str(index).encode() if index < len(handles) else b""
        assert os.read(reader, 10) == expected
        assert os.read(reader, 10) == b"", "no one holds the writing end any more"
        os.close(reader)
    assert census.wait_until(lambda: len(os.listdir("/proc/self/fd")) <= before, PATIENCE)


def is_gone(pid: int) -> bool:
    return census.read(pid) is None


@pytest.mark.slow
def test_the_death_of_the_zygote_is_the_death_of_its_children(own: Agent) -> None:
    children = [begin(own, run_forever) for _ in range(3)]
    for _, observer in children:
        observer.wait_for_start()
    os.kill(own._zygotes[0]._process.pid, signal.SIGKILL)
    for child, observer in children:
        report = observer.wait_for_exit()
        assert report.exitcode == -signal.SIGKILL
        assert "together with its zygote" in report.reason
        assert child.pid is not None
        assert census.wait_until(partial(is_gone, child.pid), PATIENCE)
    _, observer = begin(own, os._exit, 0)  # and a new one serves what comes next
    assert observer.wait_for_exit().exitcode == 0


def test_a_zygote_without_descriptors_for_a_moment_costs_one_start(own: Agent) -> None:
    child, observer = begin(own, run_forever)
    observer.wait_for_start()
    zygote = own._zygotes[0]._process.pid
    limits = resource.prlimit(zygote, resource.RLIMIT_NOFILE)
    resource.prlimit(zygote, resource.RLIMIT_NOFILE, (3, limits[1]))
    _, unlucky = begin(own, run_forever)
    report = unlucky.wait_for_exit()
    assert (report.exitcode, report.reason[:22]) == (1, "could not be started: ")
    assert "descriptor" in report.reason
    resource.prlimit(zygote, resource.RLIMIT_NOFILE, limits)
    _, lucky = begin(own, os._exit, 0)
    assert lucky.wait_for_exit().exitcode == 0
    assert observer.events == ["started"]
    end(child, observer)


def test_close_kills_and_reports_every_child_once(
    loop: Loop, capfd: pytest.CaptureFixture[str]
) -> None:
    agent = Agent(loop, "here")
    before = len(os.listdir("/proc/self/fd"))
    children = [begin(agent, run_forever, tasks=index % 2 == 0) for index in range(12)]
    for _, observer in children:
        observer.wait_for_start()
    agent.close()
    for _, observer in children:
        assert observer.wait_for_exit().exitcode == -signal.SIGKILL
        assert observer.events == ["started", "exited"]
    with pytest.raises(RuntimeError, match="this process is ending"):
        begin(agent, os._exit, 0)
    settled(loop)
    assert census.wait_until(lambda: len(os.listdir("/proc/self/fd")) <= before, PATIENCE)
    assert capfd.readouterr().err == ""


def test_children_that_started_live_on_when_forking_became_unfit(own: Agent) -> None:
    threads = {"preload": ["processes.threads_at_import"]}
    spawned = begin(own, run_forever, method="spawn")
    spawned[1].wait_for_start()
    forked = [begin(own, run_forever, preparation=threads) for _ in range(3)]
    for _, observer in forked:
        observer.wait_for_start()
    assert len({child.zygote for child, _ in forked}) == 1
    assert spawned[0].zygote is not forked[0][0].zygote
    for child, observer in [spawned, *forked]:
        assert observer.events == ["started"]
        end(child, observer)


@pytest.mark.parametrize(
    ("nonsense", "why"),
    [
        (packet.PLAIN + bytes(packet.INLINE_LIMIT + 1), "a small message of 65538 bytes"),
        (bytes([packet.PARTS_IN_MEMFD, *bytes(12)]), "a large message without its memory"),
    ],
)
def test_a_child_whose_message_cannot_be_read_is_ended(
    shared: Agent, nonsense: bytes, why: str
) -> None:
    _, observer = begin(shared, talk_nonsense, nonsense, tasks=True)
    assert f"killed by its agent: {why}" in observer.wait_for_exit().reason


def test_a_zygote_that_cannot_be_launched_is_an_error_of_the_start(
    own: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise FileNotFoundError("no interpreter")

    before = len(os.listdir("/proc/self/fd"))
    with monkeypatch.context() as broken:
        broken.setattr(zygote_process, "launch", refuse)
        with pytest.raises(FileNotFoundError, match="no interpreter"):
            begin(own, os._exit, 0, tasks=True, fds=(descriptor.own(os.dup(1)),))
    settled(own.loop)
    assert len(os.listdir("/proc/self/fd")) == before
    _, observer = begin(own, os._exit, 0)
    assert observer.wait_for_exit().exitcode == 0


@pytest.mark.parametrize("spare", range(6))
def test_no_descriptor_left_is_a_clear_error_and_leaks_none(shared: Agent, spare: int) -> None:
    begin(shared, os._exit, 0)[1].wait_for_exit()  # its zygote runs
    handed = descriptor.own(os.dup(1))
    before = len(os.listdir("/proc/self/fd"))
    slots = len(shared.progress_table._free)
    with few_descriptors(spare), pytest.raises(TooManyOpenFiles, match="ulimit -n"):
        begin(shared, run_forever, tasks=True, fds=(handed,))
    settled(shared.loop)
    assert len(os.listdir("/proc/self/fd")) == before - 1, "what was handed over is closed"
    assert len(shared.progress_table._free) >= slots
    _, observer = begin(shared, os._exit, 0)
    assert observer.wait_for_exit().exitcode == 0


class few_descriptors:
    """Leaves this process exactly ``spare`` descriptors to open."""

    def __init__(self, spare: int) -> None:
        self._spare = spare

    def __enter__(self) -> None:
        import resource

        self._limit = resource.getrlimit(resource.RLIMIT_NOFILE)
        spare = [os.dup(1) for _ in range(self._spare)]
        self._fillers: list[int] = []
        highest = max(int(fd) for fd in os.listdir("/proc/self/fd"))
        resource.setrlimit(resource.RLIMIT_NOFILE, (highest + 1, self._limit[1]))
        try:
            while True:
                self._fillers.append(os.dup(1))
        except OSError:
            pass
        for fd in spare:
            os.close(fd)

    def __exit__(self, *_: object) -> None:
        import resource

        resource.setrlimit(resource.RLIMIT_NOFILE, self._limit)
        for fd in self._fillers:
            os.close(fd)
