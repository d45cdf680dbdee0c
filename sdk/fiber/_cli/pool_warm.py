"""Command ``fiber pool warm``: workers that wait for programs."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import click

from fiber import config, resources
from fiber._backends.kubernetes.template import (
    ImageMissing,
    PodShape,
    merge_template,
    pod_template,
    quantity,
)
from fiber._cli.display import counted
from fiber._cli.failures import CommandError, explained, no_image
from fiber._cli.pool_access import (
    change,
    find,
    is_of_program,
    opened,
    program_of,
    refusals,
)
from fiber._cli.session import SECONDS, Session, cluster_options
from fiber.resources import GPU, Resources
from fiber_api import names
from fiber_api.rest import POOLS, Body, Conflict


def _read_by(read: Callable[[object], Any]) -> Callable[..., Any]:
    """Return a callback of click for an amount, as ``fiber.meta`` takes it."""

    def callback(ctx: click.Context, param: click.Parameter, text: str | None) -> Any:
        try:
            return None if text is None else read(int(text) if text.isdecimal() else text)
        except ValueError as error:
            raise click.BadParameter(str(error), ctx, param) from None

    return callback


@click.command("warm")
@click.argument("name")
@click.option(
    "--workers", required=True, type=click.IntRange(min=0), help="Workers that always run."
)
@click.option("--image", metavar="IMAGE", help="Image of the workers.  Default: as for a program.")
@click.option(
    "--cpu",
    metavar="AMOUNT",
    callback=_read_by(resources.read_cpus),
    help="CPUs of a process: 2, 0.5, 500m.",
)
@click.option(
    "--memory",
    metavar="AMOUNT",
    callback=_read_by(resources.read_mebibytes),
    help="Memory of a process: 512Mi, 2Gi.",
)
@click.option("--gpu", type=click.IntRange(min=0), help="GPUs of NVIDIA of a process.")
@cluster_options
def warm(
    name: str,
    workers: int,
    image: str | None,
    cpu: float | None,
    memory: int | None,
    gpu: int | None,
    namespace: str | None,
    context: str | None,
) -> None:
    """Make a FiberPool whose workers start before a program comes, or change one.

    A program that sets FIBER_POOL=NAME uses it, one program at a time.  What is not given stays as
    it is; a new FiberPool gets it from the configuration, as a program's own would.

    \b
    Examples:
      fiber pool warm warm --workers 4
      fiber pool warm big --workers 2 --image worker:1 --cpu 4 --memory 8Gi --gpu 1
    """
    wishes = Resources(cpu=cpu, memory=memory, gpu=gpu)
    session = opened(context, namespace)
    if find(session, name) is None and _made(session, name, workers, image, wishes):
        click.echo(f"the FiberPool {name!r} is made, with {counted(workers, 'worker')}")
    else:
        change(session, name, lambda pool: _changes(pool, workers, image, wishes), "change")
        click.echo(f"the FiberPool {name!r} is changed: it keeps {counted(workers, 'worker')}")
    click.echo(f"programs use it with FIBER_POOL={name}")


def _made(session: Session, name: str, workers: int, image: str | None, wishes: Resources) -> bool:
    """Make the pool; return False if another client has just made it."""
    doing = f"make the FiberPool {name!r}"
    with refusals(doing):
        try:
            body = _body(_checked_name(name), workers, image, wishes)
            path = POOLS.path(session.namespace)
            session.api.create(path, body, strict=True, timeout=SECONDS)
        except Conflict:
            return False
    return True


def _checked_name(name: str) -> str:
    try:
        return names.check_pool_name(name)
    except names.InvalidName as error:
        raise click.BadParameter(str(error), param_hint="NAME") from None


def _body(name: str, workers: int, image: str | None, wishes: Resources) -> Body:
    with explained("read the configuration"):
        settings = config.load()
        shape = PodShape.of(settings)
    shape = replace(shape.with_resources(wishes), image=image or shape.image)
    return {
        "apiVersion": names.API_VERSION,
        "kind": names.KIND,
        "metadata": {"name": name, "labels": {names.LABEL_MANAGED_BY: names.COMMAND_MANAGER}},
        "spec": {
            "minReplicas": workers,
            "maxReplicas": max(workers, settings.max_pods),
            "processesPerPod": settings.processes_per_pod,
            "template": _template(shape),
        },
    }


def _template(shape: PodShape) -> Body:
    try:
        return pod_template(shape, None, names.WORKER_CONTAINER)
    except ImageMissing as error:
        raise no_image() from error


def _changes(pool: Body, workers: int, image: str | None, wishes: Resources) -> Body:
    """Return the part of the pool's spec that changes."""
    name = pool["metadata"]["name"]
    if is_of_program(pool):
        raise CommandError(
            f"cannot change the FiberPool {name!r}",
            f"{program_of(pool) or 'a program'} made it for itself",
            "choose another name for the warm FiberPool",
        )
    spec: Body = {"minReplicas": workers}
    if workers > int(pool["spec"].get("maxReplicas", 1000)):
        spec["maxReplicas"] = workers
    if image is not None or wishes != Resources():
        processes = int(pool["spec"].get("processesPerPod", 1))
        containers = copy.deepcopy(pool["spec"]["template"]["spec"]["containers"])
        own = pool["spec"].get("workerContainer") or names.WORKER_CONTAINER
        changed = [
            _changed(container, image, wishes, processes) if container["name"] == own else container
            for container in containers
        ]
        spec["template"] = {"spec": {"containers": changed}}
    return spec


def _changed(container: Body, image: str | None, wishes: Resources, processes: int) -> Body:
    """Return the worker's container with the image and the resources that are given."""
    amounts: dict[str, str | None] = {}
    if wishes.cpu is not None:
        amounts["cpu"] = quantity(wishes.cpu * processes)
    if wishes.memory is not None:
        amounts["memory"] = f"{wishes.memory * processes}Mi"
    if wishes.gpu is not None:
        amounts[GPU] = str(wishes.gpu * processes) if wishes.gpu else None
    over: Body = {"image": image} if image is not None else {}
    if amounts:
        over["resources"] = {"limits": amounts, "requests": amounts}
    return merge_template(container, over)
