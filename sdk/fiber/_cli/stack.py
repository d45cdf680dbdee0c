"""``fiber stack``: where a program and its workers are in their code."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator
from typing import Any

import click

from fiber._cli.failures import NOT_FOUND, CommandError, explained, not_found
from fiber._cli.local import find_local
from fiber._cli.programs import LauncherClient, find_job, find_pod
from fiber._cli.session import cluster_options, connect, output_option
from fiber._monitor import client


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
    for line in _answer(name, request, context, namespace):
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


def _answer(
    name: str, request: dict[str, Any], context: str | None, namespace: str | None
) -> Iterator[dict[str, Any]]:
    """Yield the lines of the program's answer, on this machine or in its pod."""
    program = find_local(name, context, namespace)
    try:
        if program is not None:
            yield from client.ask(program.socket, request)
        else:
            yield from _answer_of_pod(name, request, context, namespace)
    except client.NoAnswer as error:
        where = (
            "" if program is None else f"; `py-spy dump --pid {program.pid}` may show where it is"
        )
        raise CommandError(
            f"cannot read the stacks of {name!r}",
            str(error),
            f"a native function may hold Python's lock{where}",
        ) from error


def _answer_of_pod(
    name: str, request: dict[str, Any], context: str | None, namespace: str | None
) -> Iterator[dict[str, Any]]:
    session = connect(context, namespace)
    find_job(session, name)
    pod = find_pod(session, name)
    if pod is None or not pod.runs:
        state = "it has no pod yet" if pod is None else f"its pod {pod.state}"
        raise CommandError(f"the program {name!r} does not run", state, "see `fiber ps`", NOT_FOUND)
    answered = False
    try:
        with explained(f"ask the program {name!r}"):
            for line in LauncherClient(session, pod.name).monitor(request):
                answered = True
                yield line
    except (OSError, http.client.HTTPException) as error:
        raise client.NoAnswer(f"the program's pod does not answer: {error}") from error
    if not answered:
        raise CommandError(
            f"the program {name!r} has no stacks to show",
            "no process of its pod has used Fiber yet",
            "try again when it has started a process or a pool",
        )


def _text(stack: dict[str, Any]) -> str:
    facts = [f"pid {stack['pid']}"] if stack.get("pid") else []
    facts += [f"host {stack['host']}"] if stack.get("host") not in (None, "", "local") else []
    facts += [stack["state"]] if stack.get("state") else []
    return f"{stack['name']} ({', '.join(facts)})\n{stack['text']}\n"
