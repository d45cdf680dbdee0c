"""The text of ``fiber top``: rates between two samples, hosts, slow tasks, deaths."""

from __future__ import annotations

import time
from typing import Any

from fiber._cli.dashboard_model import ProcessorShares
from fiber._cli.top_view import Sample, frame


def pool(done: int = 0, held: int = 0, waiting: int = 0, **more: Any) -> dict[str, Any]:
    return {"done": done, "held": held, "waiting": waiting, "slowest": [], **more}


def child(host: str, state: str = "busy") -> dict[str, Any]:
    return {"name": "w", "host": host, "pid": 1, "state": state}


def sample(at: float = 0.0, **found: Any) -> Sample:
    facts = {"name": "train-1", "command": "train.py", "started": time.time(), "backend": "local"}
    parts = {"programs": [facts], "pools": [], "children": [], "deaths": [], "totals": []}
    return Sample(at, **(parts | found))


def line_with(text: str, word: str) -> list[str]:
    (line,) = [line for line in text.splitlines() if word in line]
    return line.split()


def test_the_rate_is_that_between_two_samples() -> None:
    first, second = sample(1.0, pools=[pool(done=10)]), sample(3.0, pools=[pool(done=50)])
    assert "tasks a second: ?" in frame(first, None)
    assert "tasks done: 50   tasks a second: 20.0" in frame(second, first)


def test_a_pool_that_has_ended_makes_no_negative_rate() -> None:
    first, second = sample(1.0, pools=[pool(done=10)]), sample(3.0, pools=[pool(done=5)])
    assert "tasks a second: ?" in frame(second, first)


def test_the_tasks_of_all_pools_are_added_up() -> None:
    text = frame(sample(pools=[pool(1, 2, 3), pool(10, 20, 30)]), None)
    assert "tasks done: 11" in text
    assert "with workers: 22   waiting: 33" in text


def test_workers_are_counted_by_host_and_state() -> None:
    children = [child("a"), child("a", "idle"), child("b"), child("", "waiting")]
    text = frame(sample(children=children), None)
    assert line_with(text, "HOST") == ["HOST", "BUSY", "IDLE", "WAITING", "MEMORY", "CPUS"]
    assert line_with(text, "all ") == ["all", "2", "1", "1"]
    assert line_with(text, "a  ") == ["a", "1", "1"]
    assert "(no host yet)" in text


def test_memory_and_processors_of_a_host_are_added_up() -> None:
    def used(pid: int, memory: int, cpu: float) -> dict[str, Any]:
        return {**child("a"), "pid": pid, "memory": memory, "cpu": cpu}

    first = sample(1.0, children=[used(1, 2_000_000, 5.0), used(2, 2_000_000, 7.0)])
    second = sample(
        3.0, children=[used(1, 4_000_000, 7.0), used(2, 2_000_000, 8.0), used(3, 0, 9.0)]
    )
    shares = ProcessorShares()
    for one in (first, second):
        shares.add_to(one.children, one.time)
    assert line_with(frame(first, None), "a  ") == ["a", "2", "4", "MB"]
    assert line_with(frame(second, first), "a  ") == ["a", "3", "6", "MB", "1.5"]


def test_losses_are_shown_when_there_are_some() -> None:
    totals = {"failed": 2, "retried": 0, "lost": 1, "bytes_sent": 2048, "bytes_received": 10}
    text = frame(sample(totals=[totals, totals]), None)
    assert "\nfailed: 4   lost: 2   sent: 4.1 kB   received: 20 B" in text
    assert "retried" not in text


def test_of_many_hosts_the_largest_are_shown() -> None:
    children = [child(f"host-{number}") for number in range(30)] + [child("host-29")]
    text = frame(sample(children=children), None)
    assert line_with(text, "host-29") == ["host-29", "2"]
    assert "... and 18 more hosts" in text


def test_the_tasks_that_run_for_longest_come_first() -> None:
    tasks = [
        {
            "task": f"task {number} of f()",
            "worker": f"w{number}",
            "host": "h",
            "seconds": number,
            "argument": f"argument {number}",
        }
        for number in range(30)
    ]
    text = frame(sample(pools=[pool(slowest=tasks[:20]), pool(slowest=tasks[20:])]), None)
    shown = [line.split()[1] for line in text.splitlines() if " of f()" in line]
    assert shown == [f"w{number}" for number in range(29, 19, -1)]
    assert line_with(text, "w29")[-2:] == ["argument", "29"]


def test_the_last_deaths_are_shown() -> None:
    deaths = [
        {"time": time.time(), "name": f"w{number}", "host": "h", "reason": f"reason {number}"}
        for number in range(9)
    ]
    text = frame(sample(deaths=deaths), None)
    assert "reason 3" not in text
    assert "reason 4" in text
    assert "reason 8" in text


def test_a_program_without_processes_is_shown() -> None:
    text = frame(sample(), None)
    assert text.startswith("train-1   train.py   0s   local")
    assert "no process or worker runs" in text
