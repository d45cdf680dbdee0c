"""``fiber stack``: where a program and its workers are in their code."""

from __future__ import annotations

import json
from typing import Any

import click

from fiber._cli.asking import answer_of
from fiber._cli.failures import CommandError, not_found
from fiber._cli.session import cluster_options, output_option


@click.command("stack")
@click.argument("name")
@click.option("--worker", metavar="WORKER", help="Only this worker: its name, pid or pod.")
@cluster_options
@output_option
def command(
    name: str, worker: str | None, namespace: str | None, context: str | None, output: str
) -> None:
    """Show the Python stacks of a program and of its workers.

    It also works for a worker that hangs in native code.  The program and its workers go on.

    \b
    Examples:
      fiber stack train-4f2a1
      fiber stack train-4f2a1 --worker PoolWorker-3
    """
    request = {"ask": "stacks", **({"worker": worker} if worker else {})}
    found = []
    others = []
    for line in answer_of(name, request, context, namespace):
        if "stack" not in line:
            others.append(line)
            continue
        found.append(line["stack"])
        if output == "table":
            click.echo(_text(line["stack"]))
    _raise_problem(name, worker, others, any_stack=bool(found))
    if output == "json":
        click.echo(json.dumps(found, indent=2))


def _raise_problem(
    name: str, worker: str | None, lines: list[dict[str, Any]], *, any_stack: bool
) -> None:
    """Raise the first error of the programs, of which a pod may have several.

    That one program has no such worker is no error if another has one.
    """
    for line in lines:
        if "error" in line:
            raise CommandError(f"cannot read the stacks of {name!r}", line["error"])
    names = [each for line in lines if "unknown" in line for each in line["names"]]
    if worker is not None and not any_stack and any("unknown" in line for line in lines):
        raise not_found("worker", worker, names, f"the program {name!r}")


def _text(stack: dict[str, Any]) -> str:
    facts = [f"pid {stack['pid']}"] if stack.get("pid") else []
    facts += [f"host {stack['host']}"] if stack.get("host") not in (None, "", "local") else []
    facts += [stack["state"]] if stack.get("state") else []
    return f"{stack['name']} ({', '.join(facts)})\n{stack['text']}\n"
