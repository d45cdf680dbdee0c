"""Commands that change one field of a FiberPool: ``scale``, ``suspend`` and ``resume``."""

from __future__ import annotations

from collections.abc import Iterator

import click

from fiber._cli.display import counted
from fiber._cli.pool_access import account_of_program, opened, patch, program_of
from fiber._cli.session import cluster_options
from fiber_api.rest import Body


@click.command("scale")
@click.argument("name")
@click.argument("workers", type=click.IntRange(min=0))
@cluster_options
def scale(name: str, workers: int, namespace: str | None, context: str | None) -> None:
    """Ask for so many workers, within the bounds of the FiberPool.

    A program that uses the FiberPool writes the same field.  `fiber pool warm` sets the workers
    that stay while no program comes.

    \b
    Examples:
      fiber pool scale warm 4
      fiber pool scale warm 0 --namespace lab
    """
    session = opened(context, namespace)
    found = patch(session, name, {"replicas": workers}, "scale")
    click.echo(f"the FiberPool {name!r} is asked for {counted(workers, 'worker')}")
    for note in _notes(name, workers, found):
        click.echo(f"  note: {note}", err=True)


def _notes(name: str, workers: int, pool: Body) -> Iterator[str]:
    """Yield the reasons why the pool may get another number of workers."""
    spec = pool["spec"]
    low, high = int(spec.get("minReplicas", 0)), int(spec.get("maxReplicas", 1000))
    if workers < low:
        yield f"it keeps {low}, its minReplicas: `fiber pool warm {name} --workers {workers}`"
    if workers > high:
        yield f"it gets {high}, its maxReplicas: raise this field in its manifest"
    if spec.get("suspend"):
        yield f"it is suspended and gets none: `fiber pool resume {name}`"
    if spec.get("master"):
        yield f"{account_of_program(pool)} uses it, and may write another number at any time"


@click.command("suspend")
@click.argument("name")
@cluster_options
def suspend(name: str, namespace: str | None, context: str | None) -> None:
    """Delete the pods of a FiberPool, and keep the FiberPool.

    Tasks that run in these pods run again after `fiber pool resume`.

    \b
    Examples:
      fiber pool suspend warm
      fiber pool suspend warm --namespace lab
    """
    session = opened(context, namespace)
    found = patch(session, name, {"suspend": True}, "suspend")
    click.echo(f"the FiberPool {name!r} is suspended: its pods are deleted")
    if program_of(found):
        click.echo(f"  note: {account_of_program(found)} uses it, and waits for workers", err=True)


@click.command("resume")
@click.argument("name")
@cluster_options
def resume(name: str, namespace: str | None, context: str | None) -> None:
    """Make the pods of a suspended FiberPool again.

    \b
    Examples:
      fiber pool resume warm
      fiber pool resume warm --namespace lab
    """
    session = opened(context, namespace)
    patch(session, name, {"suspend": False}, "resume")
    click.echo(f"the FiberPool {name!r} gets its workers again")
