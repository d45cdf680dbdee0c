"""Output of the commands: tables for people, JSON for programs."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from typing import Any

import click

_GAP = "   "


def show(rows: Sequence[Mapping[str, Any]], columns: Sequence[str], output: str, none: str) -> None:
    """Print ``rows`` as a table of ``columns`` or, for the output ``json``, whole.

    ``none`` is the line that a table without rows consists of.
    """
    if output == "json":
        click.echo(json.dumps(list(rows), indent=2))
    elif not rows:
        click.echo(none, err=True)
    else:
        click.echo(table([[_text(row.get(column)) for column in columns] for row in rows], columns))


def table(rows: Sequence[Sequence[str]], columns: Sequence[str]) -> str:
    """Return a table with a head line, as kubectl prints it."""
    lines = [[column.upper() for column in columns], *rows]
    widths = [max(len(line[index]) for line in lines) for index in range(len(columns))]
    return "\n".join(
        _GAP.join(word.ljust(width) for word, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def utc(seconds: float) -> str:
    """Return a unix time as Kubernetes writes it."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(seconds))


def counted(number: int, noun: str) -> str:
    """Return a number with its noun: ``1 worker``, ``2 workers``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def age(since: float | None) -> str:
    """Return how long ago a unix time was, as kubectl writes it; empty for None."""
    if since is None:
        return ""
    seconds = max(int(time.time() - since), 0)
    for size, unit in ((86_400, "d"), (3_600, "h"), (60, "m")):
        if seconds >= 2 * size:
            return f"{seconds // size}{unit}"
    return f"{seconds}s"


def _text(value: object) -> str:
    return "" if value is None else str(value)
