"""Questions to the monitor of a program, on this machine or in a pod."""

from __future__ import annotations

import http.client
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from fiber._cli.failures import NOT_FOUND, CommandError, explained
from fiber._cli.local import LocalProgram, find_local
from fiber._cli.programs import LauncherClient, find_job, find_pod
from fiber._cli.session import Session, connect
from fiber._monitor import client

Ask = Callable[[dict[str, Any]], Iterator[dict[str, Any]]]
"""Function that asks a program, and yields the lines of its answer; CommandError, ``NoAnswer``."""


def answer_of(
    name: str, request: dict[str, Any], context: str | None, namespace: str | None
) -> Iterator[dict[str, Any]]:
    """Yield the lines of a program's answer, on this machine or in its pod; CommandError."""
    where = ""
    try:
        program = find_local(name, context, namespace)
        if program is not None:
            where = f"; `py-spy dump --pid {program.pid}` may show where it is"
        yield from _ask_of(name, program, context, namespace)(request)
    except client.NoAnswer as error:
        raise CommandError(
            f"cannot ask the program {name!r}",
            str(error),
            f"a native function may hold Python's lock{where}",
        ) from error


def find_program(
    name: str, context: str | None, namespace: str | None, patience: float = client.PATIENCE
) -> Ask:
    """Return the function that asks a program again and again; CommandError if it is not there.

    ``patience``: seconds that a program of this machine may take for a part of its answer.
    """
    return _ask_of(name, find_local(name, context, namespace), context, namespace, patience)


def _ask_of(
    name: str,
    program: LocalProgram | None,
    context: str | None,
    namespace: str | None,
    patience: float = client.PATIENCE,
) -> Ask:
    if program is not None:
        return partial(client.ask, program.socket, patience=patience)
    return partial(_answer_of_pod, connect(context, namespace), name)


def _answer_of_pod(
    session: Session, name: str, request: dict[str, Any]
) -> Iterator[dict[str, Any]]:
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
