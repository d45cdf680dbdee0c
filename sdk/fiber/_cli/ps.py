"""``fiber ps``: the programs of this machine and of a namespace."""

from __future__ import annotations

from collections import Counter
from typing import Any

import click

from fiber._backends.kubernetes.api import Login
from fiber._cli import display
from fiber._cli.failures import CommandError, explained
from fiber._cli.local import local_programs
from fiber._cli.programs import ProgramPod, list_jobs
from fiber._cli.session import Session, cluster_options, connect, output_option
from fiber_api import names
from fiber_api.rest import PODS, POOLS, Body, NotServed
from fiber_api.times import parse_time

_COLUMNS = ["name", "state", "workers", "host", "age", "command"]


@click.command("ps")
@cluster_options
@output_option
def command(namespace: str | None, context: str | None, output: str) -> None:
    """List the programs of this machine and of a namespace, and their workers.

    A program of this machine is listed once it has started a process or a pool.  Programs that
    `fiber run` started are in pods, and those that have ended are listed for an hour.  Other
    programs are listed by the FiberPools that they use.

    \b
    Examples:
      fiber ps
      fiber ps --namespace team-a --output json
    """
    is_chosen = bool(context or namespace)
    rows = [] if is_chosen else [program.row() for program in local_programs()]
    places = [] if is_chosen else ["on this machine"]
    try:
        if is_chosen or Login.is_configured():
            session = connect(context, namespace)
            places.append(f"in {session.where}")
            rows += _of_namespace(session)
    except CommandError:  # the programs of this machine are known all the same
        if rows:
            _show(rows, output, places)
        raise
    _show(rows, output, places)


def _show(rows: list[dict[str, Any]], output: str, places: list[str]) -> None:
    display.show(rows, _COLUMNS, output, f"no program runs {' or '.join(places)}")
    if output == "table" and any(row["state"] == "running" and row["job"] for row in rows):
        click.echo("`fiber run --attach NAME` follows one again", err=True)


def _of_namespace(session: Session) -> list[dict[str, Any]]:
    """Return a row for each program of the namespace."""
    jobs, pools = list_jobs(session), list_pools(session)
    pods = _pods(session) if jobs else []
    hosts = {pod.name: pod.program for pod in pods}
    return [*_of_jobs(jobs, pools, pods), *_elsewhere(pools, jobs, hosts)]


def list_pools(session: Session) -> list[Body]:
    """Return the FiberPools of the namespace; none if the cluster does not know them."""
    with explained("list the FiberPools"):
        try:
            return session.items(POOLS)
        except NotServed:
            return []


def host_of(pool: Body) -> str:
    """Return the host of a pool's master: the first part of its identity."""
    identity = str((pool["spec"].get("master") or {}).get("identity", ""))
    return identity.partition(":")[0]


def state_of_job(job: Body, pod: ProgramPod | None) -> str:
    """Return running, starting, succeeded or failed.  The Job knows it later than its pod."""
    status = job.get("status") or {}
    for condition in status.get("conditions") or ():
        if condition.get("status") == "True" and condition.get("type") in ("Complete", "Failed"):
            return "succeeded" if condition["type"] == "Complete" else "failed"
    return (pod and pod.progress) or ("running" if status.get("ready") else "starting")


def _pods(session: Session) -> list[ProgramPod]:
    """Return the pods of programs, the oldest first.  A pod's name is the host of its program."""
    with explained("list the pods of programs"):
        found = session.items(PODS, names.LABEL_PROGRAM)
    found.sort(key=lambda pod: str(pod["metadata"]["creationTimestamp"]))
    return [ProgramPod(str(pod["metadata"]["name"]), pod) for pod in found]


def _of_jobs(jobs: list[Body], pools: list[Body], pods: list[ProgramPod]) -> list[dict[str, Any]]:
    """Return a row for each program that ``fiber run`` has started."""
    workers: Counter[str] = Counter()
    for pool in pools:
        workers[host_of(pool)] += _ready(pool)
    rows = []
    for job in jobs:
        metadata = job["metadata"]
        own = [pod for pod in pods if pod.program == metadata["name"]]
        newest = own[-1] if own else None
        state = state_of_job(job, newest)
        typed = (metadata.get("annotations") or {}).get(names.ANNOTATION_COMMAND)
        host = newest.name if newest else None
        rows.append(_row(job, state, sum(workers[pod.name] for pod in own), host, typed, job=True))
    return rows


def _elsewhere(pools: list[Body], jobs: list[Body], hosts: dict[str, str]) -> list[dict[str, Any]]:
    """Return a row for each pool of a program that ``fiber run`` has not started."""
    programs = {str(job["metadata"]["name"]) for job in jobs}
    rows = []
    for pool in pools:
        host = host_of(pool)
        if not host or hosts.get(host) in programs:
            continue
        conditions = (pool.get("status") or {}).get("conditions") or ()
        alive = {condition["type"]: condition["status"] for condition in conditions}
        state = "lost" if alive.get("MasterAlive") == "False" else "running"
        rows.append(_row(pool, state, _ready(pool), host, None, job=False))
    return rows


def _ready(pool: Body) -> int:
    return int((pool.get("status") or {}).get("readyReplicas") or 0)


def _row(
    body: Body, state: str, workers: int, host: str | None, typed: str | None, *, job: bool
) -> dict[str, Any]:
    """Return the facts of a program.  The keys are for programs, too, and stay."""
    created = str(body["metadata"]["creationTimestamp"])
    return {
        "name": body["metadata"]["name"],
        "state": state,
        "workers": workers,
        "host": host,
        "created": created,
        "age": display.age(parse_time(created)),
        "command": None if typed is None else " ".join(typed.split()),
        "job": job,
    }
