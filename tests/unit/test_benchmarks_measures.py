"""The measures of many agents, many workers and cold starts; what else the machine did."""

from __future__ import annotations

import pickle
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks import (  # noqa: E402
    agents,
    budgets,
    coldstart,
    contenders,
    large_messages,
    latency,
    link_floor,
    machine,
    processes,
    report,
    rounds,
    samples,
    workers,
)
from benchmarks.agent_host import Order  # noqa: E402
from benchmarks.fake_agents import FakeAgent, TaskRunner  # noqa: E402
from benchmarks.model import Case, Run  # noqa: E402
from benchmarks.session import Session  # noqa: E402
from benchmarks.tasks import no_op  # noqa: E402

from fiber._agent.interface import ChildSpec, ExitReport  # noqa: E402
from fiber._wire import work  # noqa: E402
from fiber._wire.packet import Message  # noqa: E402
from unit.benchmark_runs import about  # noqa: E402

ABOUT = about(rounds=2)


# What else the machine did


@pytest.mark.parametrize(
    ("after", "share"),
    [
        ("cpu  10 5 5 180 0 0 0 0 0 0", 0.1),
        ("cpu  0 0 0 100 100 0 0 0 0 0", 0.0),  # a disk at work is not a processor at work
        ("cpu  0 0 0 150 0 0 0 50 0 0", 0.25),  # the machine's other guests
        ("cpu  50 0 0 150 0 0 0 0 50 0", 0.25),  # a guest's time is in the first number too
        ("cpu  0 0 0 0 0 0 0 0 0 0", 0.0),
    ],
)
def test_the_share_in_use_excludes_idle_time(after: str, share: float) -> None:
    before = "cpu  0 0 0 0 0 0 0 0 0 0\ncpu0 1 2 3"
    assert machine.share_in_use(before, after) == pytest.approx(share)


def test_the_share_in_use_now_is_a_share() -> None:
    assert 0 <= machine.in_use() <= 1


def test_idle_is_a_machine_that_never_did_much() -> None:
    assert samples.is_idle([0.0, 0.05])
    assert not samples.is_idle([0.0, 0.06, 0.0])


def test_each_measure_looks_at_the_machine_before_each_of_its_rounds(tmp_path: Path) -> None:
    shares = iter([0.1, 0.2, 0.3, 0.4])
    runs = {name: Run(dict(ABOUT)) for name in ("overhead", "latency")}
    names = ("overhead", "overhead", "latency")
    cases = [Case(name, str(n), "", "", {}, ()) for n, name in enumerate(names)]
    rounds.Rounds(tmp_path, runs, in_use=lambda: next(shares)).play(cases, [], 2)
    assert (runs["overhead"].in_use, runs["latency"].in_use) == ([0.1, 0.3], [0.2, 0.4])


@pytest.mark.parametrize(
    ("in_use", "words"),
    [
        ([0.004, 0.02], "others used 0 %, 2 % of the processors' time: the machine was idle"),
        ([0.0, 0.31], "others used 0 %, 31 % of the processors' time: **the machine was not"),
    ],
)
def test_the_page_says_whether_the_machine_was_idle(in_use: list[float], words: str) -> None:
    assert words in report.page("latency", Run(dict(ABOUT), in_use=in_use))


def test_a_case_with_a_fixed_number_of_rounds_runs_them_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rounds, "LONG", 0.0)
    runs = {"latency": Run(dict(ABOUT))}
    params = {"calls": 20, "seconds": 1.0}
    metrics = latency.cases(0.01)[0].metrics
    short = Case("latency", "once", "", "apply", params, metrics)
    many = Case("latency", "twice", "", "apply", params, metrics, rounds=2)
    contender = contenders.BY_NAME["multiprocessing"]
    rounds.Rounds(tmp_path, runs, in_use=lambda: 0.0).play([short, many], [contender], 3)
    assert len(runs["latency"].series("once", contender.name, "p50")) == 1
    assert len(runs["latency"].series("twice", contender.name, "p50")) == 2


def test_a_run_from_before_that_was_looked_at_can_be_read() -> None:
    assert "others used" not in report.page("latency", Run.from_json({"about": dict(ABOUT)}))


def test_a_part_of_a_peer_that_is_absent_is_missing_like_the_peer() -> None:
    modules = ("no_such_package", "no_such_package.part")
    peer = contenders.Contender("x", "X", modules, frozenset(), "#000000", "o")
    assert peer.missing() == "no_such_package, no_such_package.part"


# Budgets


def test_a_value_with_two_budgets_shows_both() -> None:
    run = Run(dict(ABOUT))
    for contender, p50 in (("fiber-loopback", 3e-4), ("multiprocessing", 1e-4), ("ray", 2e-3)):
        run.add(latency.NAME, contender, 0, {"p50": p50, "p95": p50})
    row = next(line for line in report.page("latency", run).splitlines() if "| 300 µs |" in line)
    assert row.endswith("| ≤ 2x; ≤ 0.25x Ray's Pool | missed by 50.0 %; met |")


def test_a_budget_on_the_same_value_in_another_case() -> None:
    budget = next(each for each in budgets.BUDGETS if each.measure == "workers")
    run = Run(dict(ABOUT))
    run.add(workers.workers(10), "fiber", 0, {workers.COST.name: 2e-4})
    run.add(workers.workers(5000), "fiber", 0, {workers.COST.name: 4.4e-4})
    found = budgets.judge(budget, {"workers": run})
    assert (found.kept, found.measured, found.verdict) == (False, "2.20x", "missed by 100 %")
    row = report.page("workers", run).splitlines()
    assert any(line.endswith("| ≤ 1.1x a pool of 10 | missed by 100 % |") for line in row)


def test_a_page_with_a_budget_for_each_message_in_each_place() -> None:
    on_pipes = [each.case for each in budgets.BUDGETS if each.measure == "pipes"]
    assert on_pipes[:3] == ["int", "int, one processor", "int, two processors"]
    assert len(on_pipes) == len(set(on_pipes)) == 5 * 3 + 2


# Cold start


def test_times_of_a_cold_start_are_those_of_its_last_worker_and_its_map() -> None:
    second = 10**9
    stamps = [("worker", 5 * second), ("map", 4 * second), ("worker", 3 * second)]
    assert coldstart.times_from(2 * second, stamps) == {"ready": 3.0, "map": 2.0}


# Fake agents


class Turns:
    """A loop whose turns the test takes."""

    def __init__(self) -> None:
        self.calls: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []

    def call_soon(self, callback: Callable[..., Any], *args: Any) -> None:
        self.calls.append((callback, args))

    def call_later(self, seconds: float, callback: Callable[..., Any], *args: Any) -> None:
        self.call_soon(callback, *args)

    def run(self) -> None:
        while self.calls:
            callback, args = self.calls.pop(0)
            callback(*args)


class Heard:
    """Observer that writes down what it gets."""

    def __init__(self) -> None:
        self.words: list[Any] = []

    def started(self, pid: int) -> None:
        self.words.append("started")

    def received(self, message: Message) -> None:
        self.words.append(pickle.loads(message.payload))

    def recalled(self, seqs: list[int]) -> None:
        self.words.append(seqs)

    def draining(self) -> None:
        self.words.append("draining")

    def exited(self, report: ExitReport) -> None:
        self.words.append((report.exitcode, report.host))


SPEC = ChildSpec("worker-1", "fork", b"", b"", tasks=True)


def fake_child() -> tuple[Turns, Heard, Any]:
    loop, heard = Turns(), Heard()
    agent = FakeAgent(loop, "host-1", TaskRunner())  # type: ignore[arg-type]  # all that it uses
    child = agent.child(SPEC, heard)
    child.start()
    loop.run()
    return loop, heard, child


def test_a_fake_child_is_ready_at_once_and_runs_its_tasks() -> None:
    loop, heard, child = fake_child()
    assert heard.words == ["started", (work.READY,)]
    call = pickle.dumps((no_op, (42,), {}))
    assert child.deliver(7, work.pack_calls([(call, ())]))
    loop.run()
    seq, offset, kept, _, values, odd = heard.words[2]
    assert (seq, offset, kept, values, odd) == (7, 0, None, [42], ())


def test_a_fake_child_ends_once_on_request_or_when_killed() -> None:
    loop, heard, child = fake_child()
    child.deliver(8, work.STOP_MESSAGE)
    child.signal(signal.SIGKILL)
    loop.run()
    assert heard.words[2:] == [(0, "host-1")]
    loop, heard, child = fake_child()
    child.signal(signal.SIGKILL)
    child.deliver(8, work.STOP_MESSAGE)
    loop.run()
    assert heard.words[2:] == [(-signal.SIGKILL, "host-1")]


def test_a_fake_child_that_was_killed_before_it_was_there_never_is() -> None:
    loop, heard = Turns(), Heard()
    agent = FakeAgent(loop, "host-1", TaskRunner())  # type: ignore[arg-type]  # all that it uses
    child = agent.child(SPEC, heard)
    child.start()
    child.signal(signal.SIGKILL)
    loop.calls.reverse()
    loop.run()
    assert heard.words == [(-signal.SIGKILL, "host-1")]


def test_recalled_tasks_were_run_before() -> None:
    loop, heard, child = fake_child()
    child.deliver(9, work.pack_calls([(pickle.dumps((no_op, (1,), {})), ())]))
    child.recall()
    loop.run()
    assert (heard.words[2][0], heard.words[3]) == (9, [])


def test_the_floor_of_a_link_is_measured() -> None:
    floor = link_floor.measure(link_floor.PIECE + 1, rounds=2)
    assert floor.keys() == {"one copy", "seal", "carry", "open"}
    assert min(floor.values()) > 0


def test_an_order_survives_its_line() -> None:
    order = Order("127.0.0.1:1", [{"name": "a"}, {"name": "b"}], 3.0)
    assert Order.from_line(order.to_line()) == order


@pytest.mark.slow
@pytest.mark.parametrize("measure", [agents, workers])
def test_measures_of_the_engines_internals_work_with_it(measure: Any, tmp_path: Path) -> None:
    case = measure.cases(0.002)[0]
    session = Session(contenders.BY_NAME["fiber"], tmp_path)
    try:
        sample = session.run(case)
        left = processes.descendants(session.pid)
    finally:
        session.stop()
    assert set(sample) == {metric.name for metric in case.metrics}
    # A few links, as here, may fit into memory that the processes had already.
    assert all(value > 0 for name, value in sample.items() if "memory" not in name), sample
    assert not left


# Large messages


def test_a_message_that_memory_has_no_room_for_is_not_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    memory = {"SC_PHYS_PAGES": 2 << 20, "SC_PAGE_SIZE": 4096}
    monkeypatch.setattr(large_messages.os, "sysconf", memory.__getitem__)
    cases = {case.name: case for case in large_messages.cases(1.0)}
    assert list(cases) == large_messages.CASES
    assert not cases["2 GB, Pipe"].not_run
    assert cases["4 GB, Pipe"].not_run["fiber-loopback"] == "it takes 16 GB of memory"


def test_a_rate_of_bytes_in_words() -> None:
    assert samples.in_words(312.5e6, "B/s") == "312 MB/s"
