"""Cost of the live page for a program with many workers and tasks, and how fresh it is.

PYTHONPATH=tests python -m benchmarks.dashboard     prints a table; it is no part of a run

A program runs twice: alone, and with its page open in Chromium.  The difference of its processor
time is what the page costs it.  A death is an event: the time from the kill until the browser
has changed the table of deaths.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from playwright.sync_api import Page

import browser as browsers

_PROGRAM = Path(__file__).with_name("dashboard_program.py")
_ADDRESS = re.compile(r"http://127\.0\.0\.1:\d+/\?token=\S+")

_NOTE_CHANGES = """
window.changes = [];
let newest = "";
new MutationObserver(() => {
  const name = document.querySelector("#deaths tbody td:nth-child(2)")?.textContent || "";
  if (name !== newest) window.changes.push(Date.now() / 1000);
  newest = name;
}).observe(
  document.getElementById("deaths"), { childList: true, subtree: true, characterData: true });
"""
"""Notes when another death is in the first row."""


class ProgramRun(NamedTuple):
    """Figures of one run of the program."""

    seconds: float
    processor: float
    deaths: list[float]


class PageCost(NamedTuple):
    """Figures of the process that serves the page."""

    processor: float
    memory: int
    """Largest resident memory in bytes."""


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description="Measure the live page of a program.")
    parser.add_argument("--workers", type=int, default=200)
    parser.add_argument("--tasks", type=int, default=1_000_000)
    parser.add_argument("--deaths", type=int, default=10)
    options = parser.parse_args()
    sizes = [str(options.workers), str(options.tasks), str(options.deaths)]
    with _program(sizes) as program:
        alone = _measured(program)
    with (
        _program(sizes) as program,
        _dashboard(program.pid) as (server, address),
        browsers.opened() as browser,
    ):
        page = browser.new_page()
        page.goto(address)
        page.wait_for_selector("#figures dd")
        page.evaluate(_NOTE_CHANGES)
        before = _processor_seconds(server)
        watched = _measured(program)
        cost = PageCost(_processor_seconds(server) - before, _memory(server))
        latencies = _latencies(page, watched.deaths)
        shown = page.locator('#figures dd[data-figure="tasks done"]').inner_text()
    _print(alone, watched, cost, latencies, shown)


def _print(
    alone: ProgramRun, watched: ProgramRun, cost: PageCost, latencies: list[float], shown: str
) -> None:
    share = (watched.processor - alone.processor) / watched.seconds
    rows = [
        ("program alone", f"{alone.seconds:.1f} s, {alone.processor:.1f} s of processor time"),
        ("with its page", f"{watched.seconds:.1f} s, {watched.processor:.1f} s of processor time"),
        ("cost for the program", f"{share:.1%} of one processor"),
        ("process of the page", f"{cost.processor / watched.seconds:.1%} of one processor"),
        ("its memory", f"{cost.memory / 1e6:.0f} MB"),
        ("from an event to the page", _in_words(latencies)),
        ("tasks done, as the page says", shown),
    ]
    for name, value in rows:
        print(f"{name:30}{value}")


def _in_words(latencies: list[float]) -> str:
    if not latencies:
        return "not measured"
    return f"median {statistics.median(latencies):.2f} s, longest {max(latencies):.2f} s"


@contextmanager
def _program(sizes: list[str]) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, str(_PROGRAM), *sizes],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    ) as program:
        _next(program)
        yield program
        _go_on(program)


@contextmanager
def _dashboard(pid: int) -> Iterator[tuple[int, str]]:
    """Yield the pid of ``fiber dashboard`` and the address of its page."""
    command = [sys.executable, "-m", "fiber._cli.main", "dashboard", str(pid), "--no-open"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        found = _ADDRESS.search(server.stdout.readline())
        assert found is not None
        yield server.pid, found[0]
        server.terminate()


def _measured(program: subprocess.Popen[str]) -> ProgramRun:
    _go_on(program)
    deaths = []
    while "seconds" not in (line := _next(program)):
        deaths.append(line["death"])
    return ProgramRun(line["seconds"], line["processor"], deaths)


def _go_on(program: subprocess.Popen[str]) -> None:
    assert program.stdin is not None
    program.stdin.write("\n")
    program.stdin.flush()


def _next(program: subprocess.Popen[str]) -> dict[str, Any]:
    assert program.stdout is not None
    return dict(json.loads(program.stdout.readline()))


def _latencies(page: Page, deaths: list[float]) -> list[float]:
    """Return the seconds from each death to the first change of the table after it."""
    time.sleep(2.0)
    changes: list[float] = page.evaluate("window.changes")
    following = [min((at for at in changes if at >= death), default=None) for death in deaths]
    return [at - death for at, death in zip(following, deaths, strict=True) if at is not None]


def _processor_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _memory(pid: int) -> int:
    status = Path(f"/proc/{pid}/status").read_text()
    found = re.search(r"VmHWM:\s+(\d+) kB", status)
    assert found is not None
    return int(found[1]) * 1024


if __name__ == "__main__":
    main()
