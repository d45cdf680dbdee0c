"""Commands for FiberPools, for people who do not use kubectl."""

from __future__ import annotations

from typing import Any

import click

from fiber._cli import display
from fiber._cli.failures import explained
from fiber._cli.session import Session, cluster_options, connect, output_option
from fiber_api.rest import POOLS, Body
from fiber_api.times import parse_time


@click.group("pool")
def command() -> None:
    """List, make and scale FiberPools.

    \b
    Examples:
      fiber pool list
      fiber pool scale warm 4
    """


@command.command("list")
@cluster_options
@output_option
def list_pools(namespace: str | None, context: str | None, output: str) -> None:
    """List the FiberPools of a namespace.

    \b
    Examples:
      fiber pool list
      fiber pool list --namespace team-a --output json
    """
    session = connect(context, namespace)
    rows = [row_of(pool) for pool in _pools(session)]
    columns = ["name", "phase", "ready", "wanted", "master", "age"]
    display.show(rows, columns, output, f"there is no FiberPool in {session.where}")


def _pools(session: Session) -> list[Body]:
    with explained("list the FiberPools"):
        listing = session.api.list(POOLS.path(session.namespace), timeout=5.0)
    return list(listing.get("items") or ())


def row_of(pool: Body) -> dict[str, Any]:
    """Return the facts of a pool that a list shows."""
    status, spec = pool.get("status") or {}, pool["spec"]
    return {
        "name": pool["metadata"]["name"],
        "phase": status.get("phase", "Unknown"),
        "ready": status.get("readyReplicas", 0),
        "wanted": status.get("desiredReplicas", spec.get("replicas", 0)),
        "master": (spec.get("master") or {}).get("identity"),
        "age": display.age(parse_time(pool["metadata"]["creationTimestamp"])),
    }
