"""``fiber stop``: end a program."""

from __future__ import annotations

import http.client
import signal

import click

from fiber._cli.failures import explained
from fiber._cli.local import end, find_local
from fiber._cli.programs import LauncherClient, ProgramPod, find_job, find_pod, stop
from fiber._cli.session import Session, cluster_options, connect
from fiber_api.rest import ApiError


@click.command("stop")
@click.argument("name")
@click.option("--now", is_flag=True, help="Delete it, and do not ask it to end first.")
@cluster_options
def command(name: str, now: bool, namespace: str | None, context: str | None) -> None:
    """End a program of this machine, or one that `fiber run` started in a pod.

    The program gets SIGTERM, and its workers end with it.  A pod is kept with its log for an hour.
    With --now the program is killed and its pod deleted.

    \b
    Examples:
      fiber stop train-4f2a1
      fiber stop train-4f2a1 --now
    """
    program = find_local(name, context, namespace)
    if program is not None:
        end(program, now=now)
        return
    session = connect(context, namespace)
    job = find_job(session, name)
    pod = find_pod(session, name)
    if not now and pod is not None and pod.runs and _ask_to_end(session, pod):
        click.echo(f"asked the program {name!r} to end")
        return
    with explained(f"end the program {name!r}"):
        stop(session, job)
    click.echo(f"deleted the program {name!r}")


def _ask_to_end(session: Session, pod: ProgramPod) -> bool:
    """Send SIGTERM, and return whether the pod has got it."""
    try:
        LauncherClient(session, pod.name).signal(signal.SIGTERM)
    except (ApiError, OSError, http.client.HTTPException) as error:
        click.echo(f"fiber: the program's pod does not answer: {error}", err=True)
        return False
    return True
