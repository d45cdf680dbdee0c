"""Questions to the monitor of a program, on this machine or in a pod."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from typing import Any

from fiber._cli.failures import NOT_FOUND, CommandError, explained
from fiber._cli.local import find_local
from fiber._cli.programs import LauncherClient, find_job, find_pod
from fiber._cli.session import connect
from fiber._monitor import client


def answer_of(
    name: str, request: dict[str, Any], context: str | None, namespace: str | None
) -> Iterator[dict[str, Any]]:
    """Yield the lines of a program's answer, on this machine or in its pod; CommandError."""
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
            f"cannot ask the program {name!r}",
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
            f"the program {name!r} has nothing to show",
            "no process of its pod has used Fiber yet",
            "try again when it has started a process or a pool",
        )
