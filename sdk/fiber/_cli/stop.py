"""``fiber stop``: end a program."""

from __future__ import annotations

import signal

import click

from fiber._cli import following
from fiber._cli.failures import explained
from fiber._cli.programs import Launcher, find_job, find_pod
from fiber._cli.session import cluster_options, connect
from fiber_api.rest import ApiError


@click.command("stop")
@click.argument("name")
@click.option("--now", is_flag=True, help="Delete it, and do not ask it to end first.")
@cluster_options
def command(name: str, now: bool, namespace: str | None, context: str | None) -> None:
    """End a program that `fiber run` started.

    The program gets SIGTERM, and its pod is kept with its log for an hour.  With --now the pod is
    deleted.  Its workers end with it.

    \b
    Examples:
      fiber stop train-4f2a1
      fiber stop train-4f2a1 --now
    """
    session = connect(context, namespace)
    find_job(session, name)
    pod = find_pod(session, name)
    if not now and pod is not None and pod.runs:
        try:
            Launcher(session, pod.name).signal(signal.SIGTERM)
        except (ApiError, OSError):
            now = True  # the pod does not answer
    if now or pod is None or not pod.runs:
        with explained(f"end the program {name!r}"):
            following.stop(session, name)
        click.echo(f"deleted the program {name!r}")
    else:
        click.echo(f"asked the program {name!r} to end")
