"""``fiber top``: what a program does now, again and again."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from typing import Any

import click

from fiber._cli.asking import answer_of
from fiber._cli.dashboard_model import ProcessorShares
from fiber._cli.failures import CommandError
from fiber._cli.local import only_program
from fiber._cli.session import cluster_options
from fiber._cli.top_view import Sample, frame


@click.command("top")
@click.argument("name", required=False)
@click.option(
    "--interval", type=click.FloatRange(0.2), default=2.0, metavar="SECONDS", help="Default: 2."
)
@click.option("--once", is_flag=True, help="Show one state and end.")
@cluster_options
def command(
    name: str | None, interval: float, once: bool, namespace: str | None, context: str | None
) -> None:
    """Show what a program does now: its pools, tasks, workers and deaths.

    NAME may be left out if one program runs on this machine.  In a terminal the view is drawn again
    and again until Ctrl-C.  Elsewhere a state is printed each time.

    \b
    Examples:
      fiber top
      fiber top train-4f2a1 --once
    """
    name = name or only_program()
    states = _states(name, context, namespace, interval, once)
    if sys.stdout.isatty() and not once:
        _draw(states)
    else:
        for shown in states:
            click.echo(shown + "\n")


def _states(
    name: str, context: str | None, namespace: str | None, interval: float, once: bool
) -> Iterator[str]:
    """Yield the program's state as text, until the program ends."""
    before: Sample | None = None
    shares = ProcessorShares()
    while True:
        sample = _sample(name, context, namespace)
        shares.add_to(sample.children, sample.time)
        yield frame(sample, before)
        if once:
            return
        before = sample
        time.sleep(interval)


def _sample(name: str, context: str | None, namespace: str | None) -> Sample:
    found: dict[str, list[dict[str, Any]]] = {}
    for line in answer_of(name, {"ask": "state"}, context, namespace):
        if "error" in line:
            raise CommandError(f"cannot read the state of {name!r}", line["error"])
        for kind, facts in line.items():
            found.setdefault(kind, []).append(facts)
    return Sample(
        time.monotonic(),
        found.get("program", []),
        found.get("pool", []),
        found.get("child", []),
        found.get("death", []),
        found.get("totals", []),
    )


def _draw(states: Iterator[str]) -> None:
    """Draw the states over each other in the terminal."""
    from rich.live import Live
    from rich.text import Text

    with Live(screen=True, auto_refresh=False) as live:
        for shown in states:
            live.update(Text(shown, no_wrap=True, overflow="ellipsis"), refresh=True)
