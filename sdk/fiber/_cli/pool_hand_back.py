"""Commands that take a FiberPool from its program: ``hand-back`` and ``delete``."""

from __future__ import annotations

import sys

import click

from fiber._cli.failures import CommandError, explained
from fiber._cli.pool_access import (
    absent,
    account_of_program,
    change,
    get,
    is_of_program,
    opened,
    path_of,
    program_of,
)
from fiber._cli.session import SECONDS, Session, cluster_options
from fiber_api.rest import Body, Conflict, NotFound

_yes = click.option("-y", "--yes", is_flag=True, help="Do not ask for a confirmation.")


@click.command("hand-back")
@click.argument("name")
@_yes
@cluster_options
def hand_back(name: str, yes: bool, namespace: str | None, context: str | None) -> None:
    """Detach the program that uses a FiberPool, so that another program may use it.

    For a program that was lost or forgotten, such as an open notebook.  If it still runs, it loses
    the workers with the tasks that they run, and its calls raise FiberPoolError.

    \b
    Examples:
      fiber pool hand-back warm --yes
      fiber pool hand-back warm --yes --namespace lab
    """
    session = opened(context, namespace)
    pool = get(session, name)
    program = program_of(pool)
    if program is None:
        click.echo(f"no program uses the FiberPool {name!r}")
        return
    if is_of_program(pool):
        raise CommandError(
            f"cannot hand back the FiberPool {name!r}",
            f"{program} made it for itself, and no other program can use it",
            f"end that program, or delete the FiberPool: `fiber pool delete {name}`",
        )
    question = f"Detach {account_of_program(pool)} from the FiberPool {name!r}?"
    if yes or _agreed(question, f"hand back the FiberPool {name!r}"):
        _detach(session, name, pool["spec"]["master"])
        click.echo(f"{program} is detached from the FiberPool {name!r}")


def _detach(session: Session, name: str, master: Body) -> None:
    key = ("identity", "host", "port", "epoch")

    def without(pool: Body) -> Body:
        present = pool["spec"].get("master")
        if present is not None and any(present.get(each) != master.get(each) for each in key):
            raise CommandError(
                f"cannot hand back the FiberPool {name!r}",
                f"it has another program now: {program_of(pool)}",
                "repeat the command to detach that one",
            )
        # All fields that a program writes, as at its own end.
        return {"master": None, "relay": None, "replicas": 0, "scaleDown": {"release": None}}

    change(session, name, without, "hand back")


@click.command("delete")
@click.argument("name")
@_yes
@cluster_options
def delete(name: str, yes: bool, namespace: str | None, context: str | None) -> None:
    """Delete a FiberPool with its pods; ask first if a program uses it.

    \b
    Examples:
      fiber pool delete warm --yes
      fiber pool delete warm --yes --namespace lab
    """
    session = opened(context, namespace)
    pool = get(session, name)
    question = f"{account_of_program(pool)} uses the FiberPool {name!r}. Delete it?"
    if yes or program_of(pool) is None or _agreed(question, f"delete the FiberPool {name!r}"):
        _delete(session, name, pool["metadata"]["uid"])
        click.echo(f"the FiberPool {name!r} is deleted")


def _delete(session: Session, name: str, uid: str) -> None:
    with explained(f"delete the FiberPool {name!r}"):
        try:
            session.api.delete(path_of(session, name), uid=uid, timeout=SECONDS)
            return
        except (Conflict, NotFound):
            pass  # it is gone, and perhaps there is another one of its name
    raise absent(session, name)


def _agreed(question: str, doing: str) -> bool:
    """Ask on the terminal; return the answer."""
    try:
        agreed = click.confirm(question)
    except click.Abort:
        if sys.stdin.isatty():
            raise  # Ctrl-C
        raise CommandError(
            f"cannot {doing}", "it needs a confirmation, and there is no terminal", "give --yes"
        ) from None
    if not agreed:
        click.echo("nothing is changed")
    return agreed
