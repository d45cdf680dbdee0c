"""Commands for FiberPools, for people who do not use kubectl."""

from __future__ import annotations

from typing import Any

import click

from fiber._cli import (
    display,
    pool_access,
    pool_apply,
    pool_changes,
    pool_hand_back,
    pool_show,
    pool_warm,
)
from fiber._cli.session import cluster_options, output_option
from fiber_api.rest import Body
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
    session = pool_access.opened(context, namespace)
    rows = [row_of(pool) for pool in pool_access.pools(session)]
    columns = ["name", "phase", "ready", "wanted", "master", "age"]
    display.show(rows, columns, output, f"there is no FiberPool in {session.where}")


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


for _each in (
    pool_show.show,
    pool_apply.apply,
    pool_changes.scale,
    pool_changes.suspend,
    pool_changes.resume,
    pool_warm.warm,
    pool_hand_back.hand_back,
    pool_hand_back.delete,
):
    command.add_command(_each)
