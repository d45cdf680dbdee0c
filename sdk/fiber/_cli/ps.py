"""``fiber ps``: the programs of a namespace."""

from __future__ import annotations

from collections import Counter
from typing import Any

import click

from fiber._cli import display
from fiber._cli.failures import explained
from fiber._cli.programs import list_jobs
from fiber._cli.session import Session, cluster_options, connect, output_option
from fiber_api import names
from fiber_api.rest import PODS, POOLS, Body
from fiber_api.times import parse_time

_SECONDS = 5.0
_COLUMNS = ["name", "state", "workers", "runs in", "age", "command"]


@click.command("ps")
@cluster_options
@output_option
def command(namespace: str | None, context: str | None, output: str) -> None:
    """List the programs that run in a namespace, and their workers.

    Programs that `fiber run` started are in pods.  Other programs are listed by the FiberPools that
    they use.

    \b
    Examples:
      fiber ps
      fiber ps --namespace team-a --output json
    """
    session = connect(context, namespace)
    rows = [*_of_jobs(session), *_elsewhere(session)]
    display.show(rows, _COLUMNS, output, f"no program runs in {session.where}")
    if output == "table" and any(row["state"] == "running" and row["job"] for row in rows):
        click.echo("`fiber run --attach NAME` follows one again", err=True)


def _of_jobs(session: Session) -> list[dict[str, Any]]:
    """Return a row for each program that ``fiber run`` has started."""
    workers = _workers(session)
    return [
        {
            "name": job["metadata"]["name"],
            "state": state_of_job(job),
            "workers": workers[str(job["metadata"]["name"])],
            "runs in": "pod",
            "age": display.age(parse_time(job["metadata"]["creationTimestamp"])),
            "command": (job["metadata"].get("annotations") or {}).get(names.ANNOTATION_COMMAND),
            "job": True,
        }
        for job in list_jobs(session)
    ]


def state_of_job(job: Body) -> str:
    """Return running, starting, succeeded or failed."""
    status = job.get("status") or {}
    for condition in status.get("conditions") or ():
        if condition.get("status") == "True" and condition.get("type") in ("Complete", "Failed"):
            return "succeeded" if condition["type"] == "Complete" else "failed"
    return "running" if status.get("ready") else "starting"


def _pools(session: Session) -> list[Body]:
    with explained("list the FiberPools"):
        return list(
            session.api.list(POOLS.path(session.namespace), timeout=_SECONDS).get("items") or ()
        )


def _workers(session: Session) -> Counter[str]:
    """Return the number of ready workers of each program in a pod."""
    with explained("list the pods of programs"):
        listing = session.api.list(
            PODS.path(session.namespace),
            {"labelSelector": names.LABEL_PROGRAM},
            timeout=_SECONDS,
        )
    programs = {
        str(pod["metadata"]["name"]): str(pod["metadata"]["labels"][names.LABEL_PROGRAM])
        for pod in listing.get("items") or ()
    }
    found: Counter[str] = Counter()
    for pool in _pools(session):
        if (program := programs.get(host_of(pool))) is not None:
            found[program] += int((pool.get("status") or {}).get("readyReplicas") or 0)
    return found


def host_of(pool: Body) -> str:
    """Return the host of a pool's master: the first part of its identity."""
    identity = str((pool["spec"].get("master") or {}).get("identity", ""))
    return identity.partition(":")[0]


def _elsewhere(session: Session) -> list[dict[str, Any]]:
    """Return a row for each program that is in no pod of ``fiber run``, by its FiberPools."""
    jobs = {str(job["metadata"]["name"]) for job in list_jobs(session)}
    rows = []
    for pool in _pools(session):
        identity = (pool["spec"].get("master") or {}).get("identity")
        if identity is None or any(host_of(pool).startswith(f"{job}-") for job in jobs):
            continue
        status = pool.get("status") or {}
        alive = {c["type"]: c["status"] for c in status.get("conditions") or ()}
        rows.append(
            {
                "name": pool["metadata"]["name"],
                "state": "lost" if alive.get("MasterAlive") == "False" else "running",
                "workers": status.get("readyReplicas") or 0,
                "runs in": host_of(pool),
                "age": display.age(parse_time(pool["metadata"]["creationTimestamp"])),
                "command": None,
                "job": False,
            }
        )
    return rows
