"""``fiber logs``: the output of a program, or of one of its workers."""

from __future__ import annotations

import re
from collections.abc import Callable

import click

from fiber._cli import local_logs, streams
from fiber._cli.failures import NOT_FOUND, USAGE, CommandError, explained, not_found
from fiber._cli.local import find_local
from fiber._cli.log_following import follow_log
from fiber._cli.programs import find_job, find_pod
from fiber._cli.ps import host_of, list_pools
from fiber._cli.session import Session, cluster_options, connect
from fiber_api import names
from fiber_api.rest import PODS, NotFound

_UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86_400}
_BROKEN_PIPE = 141
_TAIL, _MOST_BYTES = "500", str(1 << 20)
"""Lines at the end of a log, and most of their bytes."""

_WHY_EMPTY = {
    names.PROGRAM_CONTAINER: "the log is empty; a node keeps only the last 10 MiB or so of it",
    names.WORKER_CONTAINER: (
        "the worker's own log is empty; what its tasks print is in the program's: fiber logs NAME"
    ),
}
"""Hints by container."""


@click.command("logs")
@click.argument("name")
@click.option("--worker", metavar="WORKER", help="Worker instead of the program: pod or name.")
@click.option("-f", "--follow", is_flag=True, help="Go on until the end.")
@click.option("--since", metavar="TIME", help="Only newer output: 30s, 5m, 2h or 1d.")
@cluster_options
def command(
    name: str,
    worker: str | None,
    follow: bool,
    since: str | None,
    namespace: str | None,
    context: str | None,
) -> int:
    """Show the output of a program that `fiber run` started, or of a worker.

    A program in a pod that has ended keeps its log for an hour.  A program of this machine has a
    log if its output goes to a file, and its workers have logs if it sets `log_to`.

    \b
    Examples:
      fiber logs train-4f2a1 --follow
      fiber logs train-4f2a1 --worker train-1c0de-9e107d9d37 --since 5m
    """
    if (program := find_local(name, context, namespace)) is not None:
        return _passing_on(
            lambda: local_logs.show(program, worker=worker, follow=follow, since=since)
        )
    container = names.WORKER_CONTAINER if worker else names.PROGRAM_CONTAINER
    query = {"container": container}
    if since is not None:
        query["sinceSeconds"] = str(_seconds(since))
    session = connect(context, namespace)
    find_job(session, name)
    pod = _worker(session, name, worker) if worker else _pod(session, name)
    with explained(f"read the log of {pod}"):
        return _passing_on(lambda: _show(session, pod, query, follow))


def _passing_on(show: Callable[[], None]) -> int:
    try:
        show()
    except streams.OutputClosed:
        return _BROKEN_PIPE
    return 0


def _show(session: Session, pod: str, query: dict[str, str], follow: bool) -> None:
    try:
        if follow:
            follow_log(session, pod, query)
        elif not _show_now(session, pod, query) and "sinceSeconds" not in query:
            streams.say(f"[fiber] {_WHY_EMPTY[query['container']]}")
    except NotFound as error:
        raise CommandError(
            f"there is no pod {pod!r} any longer",
            error.message,
            f"see `kubectl get pods -n {session.namespace}` for those that there are",
        ) from error


def _show_now(session: Session, pod: str, query: dict[str, str]) -> bool:
    """Show the log, and return whether it has anything."""
    found = False
    for piece in session.api.log(PODS.path(session.namespace, pod), query):
        streams.write(piece)
        found = True
    return found


def last_lines(name: str, context: str | None, namespace: str | None) -> str:
    """Return the end of the log of a program in a pod; CommandError."""
    session = connect(context, namespace)
    find_job(session, name)
    pod = _pod(session, name)
    query = {"container": names.PROGRAM_CONTAINER, "tailLines": _TAIL, "limitBytes": _MOST_BYTES}
    with explained(f"read the log of {pod}"):
        pieces = list(session.api.log(PODS.path(session.namespace, pod), query))
    return b"".join(pieces).decode(errors="replace")


def _pod(session: Session, program: str) -> str:
    pod = find_pod(session, program)
    if pod is None:
        raise CommandError(
            f"the program {program!r} has no pod",
            "it has not started yet, or its pod was deleted",
            f"see `kubectl describe job {program} -n {session.namespace}`",
        )
    return pod.name


def _worker(session: Session, program: str, worker: str) -> str:
    """Return ``worker`` if it is one of the program's."""
    found = workers_of(session, program)
    if not found:
        raise CommandError(
            f"there is no worker {worker!r}",
            f"the program {program!r} has no workers now",
            f"see its own output: `fiber logs {program}`",
            NOT_FOUND,
        )
    if worker not in found:
        raise not_found("worker", worker, found, f"the program {program!r}")
    return worker


def workers_of(session: Session, program: str) -> list[str]:
    """Return the names of the pods of a program's workers."""
    host = _pod(session, program)
    with explained("list the workers"):
        pools = list_pools(session)
        uids = [str(pool["metadata"]["uid"]) for pool in pools if host_of(pool) == host]
        found: list[str] = []
        for uid in uids:
            pods = session.items(PODS, f"{names.LABEL_POOL_UID}={uid}")
            found += [str(pod["metadata"]["name"]) for pod in pods]
    return found


def _seconds(text: str) -> int:
    found = re.fullmatch(r"([0-9]{1,9})([smhd])", text)
    if found is None or not int(found[1]):
        raise CommandError(
            f"{text!r} is no time", "--since needs a number and a unit", "--since 5m", USAGE
        )
    return int(found[1]) * _UNITS[found[2]]
