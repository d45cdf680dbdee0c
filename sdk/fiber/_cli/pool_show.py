"""Command ``fiber pool show``: a FiberPool with its problems, conditions and pods."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import click

from fiber._backends.kubernetes.problems import node_of, pod_end
from fiber._cli import display
from fiber._cli.failures import explained
from fiber._cli.pool_access import account_of_program, get, one_line, opened, program_of
from fiber._cli.session import Session, cluster_options, output_option
from fiber_api import names
from fiber_api.rest import PODS, Body
from fiber_api.times import parse_time


@click.command("show")
@click.argument("name")
@cluster_options
@output_option
def show(name: str, namespace: str | None, context: str | None, output: str) -> None:
    """Show the status, the problems, the conditions and the pods of a FiberPool.

    \b
    Examples:
      fiber pool show warm
      fiber pool show warm --output json
    """
    session = opened(context, namespace)
    pool = get(session, name)
    pods = [pod_row(pod, container_of(pool)) for pod in _pods(session, pool)]
    if output == "json":
        click.echo(json.dumps(facts_of(pool, pods), indent=2))
    else:
        click.echo("\n".join(_lines(pool, pods)))


def container_of(pool: Body) -> str:
    """Return the name of the container that runs the agent."""
    return str(pool["spec"].get("workerContainer") or names.WORKER_CONTAINER)


def image_of(pool: Body) -> str:
    """Return the image of a pool's workers; empty if its template has none."""
    spec = (pool["spec"].get("template") or {}).get("spec") or {}
    own = container_of(pool)
    images = (c.get("image") for c in spec.get("containers") or () if c.get("name") == own)
    return str(next(images, None) or "")


def facts_of(pool: Body, pods: list[dict[str, Any]]) -> dict[str, Any]:
    """Return everything that ``show`` knows, for JSON."""
    status, spec, metadata = pool.get("status") or {}, pool["spec"], pool["metadata"]
    return {
        "name": metadata["name"],
        "namespace": metadata.get("namespace"),
        "phase": status.get("phase", "Unknown"),
        "ready": status.get("readyReplicas", 0),
        "connected": status.get("connectedReplicas"),
        "wanted": status.get("desiredReplicas", spec.get("replicas", 0)),
        "minReplicas": spec.get("minReplicas", 0),
        "maxReplicas": spec.get("maxReplicas", 1000),
        "suspended": bool(spec.get("suspend")),
        "image": image_of(pool),
        "master": spec.get("master"),
        "problems": status.get("problems") or [],
        "conditions": status.get("conditions") or [],
        "pods": pods,
    }


def pod_row(pod: Body, container: str) -> dict[str, Any]:
    """Return the facts of a pod that a list shows."""
    status = pod.get("status") or {}
    end = pod_end(pod, container)
    return {
        "name": pod["metadata"]["name"],
        "state": _state(pod),
        "ready": _is_ready(status),
        "node": node_of(pod) or None,
        "age": display.age(parse_time(pod["metadata"]["creationTimestamp"])),
        "reason": (end.reason if end else "") or _waits_for(status),
    }


def _state(pod: Body) -> str:
    leaves = bool(pod["metadata"].get("deletionTimestamp"))
    return "Terminating" if leaves else str((pod.get("status") or {}).get("phase", "Unknown"))


def _is_ready(status: Body) -> bool:
    conditions = status.get("conditions") or ()
    return any(c.get("type") == "Ready" and c.get("status") == "True" for c in conditions)


def _waits_for(status: Body) -> str:
    """Return why a container does not start, or why no node takes the pod, in one line."""
    started = (
        *(status.get("initContainerStatuses") or ()),
        *(status.get("containerStatuses") or ()),
    )
    waiting = [(each.get("state") or {}).get("waiting") or {} for each in started]
    unplaced = [
        each
        for each in status.get("conditions") or ()
        if each.get("type") == "PodScheduled" and each.get("status") == "False"
    ]
    for found in (*waiting, *unplaced):
        if found.get("reason") not in (None, "ContainerCreating", "PodInitializing"):
            said = one_line(str(found.get("message") or ""))
            return f"{found['reason']}: {said}" if said else str(found["reason"])
    return ""


def _pods(session: Session, pool: Body) -> list[Body]:
    with explained("list the pods of the FiberPool"):
        return session.items(PODS, f"{names.LABEL_POOL_UID}={pool['metadata']['uid']}")


def _lines(pool: Body, pods: list[dict[str, Any]]) -> Iterator[str]:
    facts = facts_of(pool, pods)
    yield from _head(pool, facts)
    yield from _problems(facts["problems"])
    yield from _conditions(facts["conditions"])
    yield "Pods:" if pods else "Pods:       none"
    if pods:
        shown = [{**pod, "ready": "yes" if pod["ready"] else "no"} for pod in pods]
        yield from _table(shown, ["name", "state", "ready", "node", "age", "reason"])


def _head(pool: Body, facts: dict[str, Any]) -> Iterator[str]:
    bounds = f"between {facts['minReplicas']} and {facts['maxReplicas']}"
    linked = "" if facts["connected"] is None else f", {facts['connected']} connected"
    program = account_of_program(pool) if program_of(pool) else "none"
    yield f"Name:       {facts['name']}"
    yield f"Namespace:  {facts['namespace']}"
    yield f"Phase:      {facts['phase']}{' (suspended)' if facts['suspended'] else ''}"
    yield f"Workers:    {facts['ready']} ready of {facts['wanted']} wanted ({bounds}){linked}"
    yield f"Image:      {facts['image']}"
    yield f"Program:    {program}"


def _problems(problems: list[Body]) -> Iterator[str]:
    yield "Problems:" if problems else "Problems:   none"
    for problem in problems:
        many = f" ({problem['count']} times)" if problem.get("count", 1) > 1 else ""
        where = f", pod {problem['pod']}" if problem.get("pod") else ""
        kind = problem.get("severity", "Error")
        yield f"  {kind} {problem.get('reason')}{many}{where}: {problem.get('message', '')}"
        if problem.get("terminal"):
            yield "    waiting cannot help"


def _conditions(conditions: list[Body]) -> Iterator[str]:
    yield "Conditions:" if conditions else "Conditions: none yet: does the operator run?"
    if conditions:
        yield from _table(conditions, ["type", "status", "reason", "message"])


def _table(rows: list[dict[str, Any]], columns: list[str]) -> Iterator[str]:
    cells = [[str(row.get(column) or "") for column in columns] for row in rows]
    yield from (f"  {line}" for line in display.table(cells, columns).splitlines())
