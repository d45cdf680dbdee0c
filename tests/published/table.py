"""Results of the published programs: a file of JSON, and the table of docs/published.md."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from published.records import Program

BACKENDS = ("local", "loopback", "kubernetes")
BEGIN, END = "<!-- table: make published -->", "<!-- end of table -->"
NOT_RUN = "not run"

Results = dict[str, Any]
"""Cells by the program's name: its commit, its changed lines, and the result on each backend."""


def read(path: Path) -> Results:
    """Return the results of earlier runs; none if there is no file."""
    if not path.exists():
        return {}
    results: Results = json.loads(path.read_text(encoding="utf-8"))
    return results


def write(path: Path, results: Results) -> None:
    """Write the results, sorted, so that a new run changes few lines."""
    text = json.dumps(results, indent=2, sort_keys=True) + "\n"
    path.write_text(text, encoding="utf-8")


def add(
    results: Results, name: str, commit: str, changed: list[str], outcome: dict[str, str]
) -> None:
    """Add outcomes by backend; those of an older commit are forgotten."""
    old = results.get(name, {})
    earlier = old.get("outcome", {}) if old.get("commit") == commit else {}
    results[name] = {"commit": commit, "changed": changed, "outcome": {**earlier, **outcome}}


def rows(programs: dict[str, Program], results: Results) -> list[str]:
    """Return the table's lines: one for each program that has run."""
    lines = [
        "| program | Fiber by | changed lines | what ran | stood in | local | loopback | pods |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, program in programs.items():
        if name in results:
            cells = (cell.replace("|", "\\|") for cell in _cells(program, results[name]))
            lines.append(f"| {' | '.join(cells)} |")
    return lines


def put_into(page: str, lines: list[str]) -> str:
    """Return the page with these lines between its markers."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"the page needs the lines {BEGIN!r} and {END!r}, in this order")
    return before + "\n".join([BEGIN, "", *lines, "", END]) + after


def _cells(program: Program, result: Any) -> list[str]:
    link = f"[{program.name}]({program.upstream}) `{result['commit']}`"
    stood_in = ", ".join(program.stood_in) or "nothing"
    changed = str(len(result["changed"]))
    outcomes = [result["outcome"].get(backend, NOT_RUN) for backend in BACKENDS]
    return [link, program.way, changed, program.ran, stood_in, *outcomes]
