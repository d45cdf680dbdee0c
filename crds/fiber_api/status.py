"""``status``: what the operator says of a pool, and what it remembers of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, Final, Literal

from pydantic import Field, ValidationError

from fiber_api.model import LIST_AS_MAP, Model, Time, describe

_Path = tuple[int | str, ...]

MAX_COUNT: Final = 2**31 - 1
Count = Annotated[int, Field(ge=0, le=MAX_COUNT)]
ExitCode = Annotated[int, Field(ge=-(2**31), le=2**31 - 1)]


class Failures(Model):
    """Workers that ended and were not meant to. Those that end before the next ones come are one
    wave."""

    consecutive: Count = 0
    """Waves in a row since half of the workers wanted were last ready for a minute. With more than
    failurePolicy.backoffLimit nothing more is created."""
    waves: Count = 0
    """Waves in a row since a new worker was last ready for a minute. Each doubles the time until
    those that failed are replaced."""
    waiting: Count = 0
    """Workers that are not replaced before nextCreateTime."""
    total: Count = 0
    """Workers that failed, since the pool was made."""
    disrupted: Count = 0
    """Workers that the cluster ended, since the pool was made. They do not count as failures."""
    last_exit_code: ExitCode | None = None
    """Exit code of the worker that failed last."""
    last_reason: str | None = None
    """Why it failed."""
    next_create_time: Time | None = None
    """Workers that failed are not replaced before this time."""
    counted: Annotated[
        tuple[str, ...],
        Field(strict=False, json_schema_extra={"x-kubernetes-list-type": "atomic"}),
    ] = ()
    """Pods that are in these sums and still exist."""
    spec_hash: str | None = None
    """Hash of the part of the spec that these waves are of; when it changes they are forgotten."""


class Problem(Model):
    """Something that keeps workers from running."""

    reason: str
    """One word for programs, such as ImagePullError or Unschedulable."""
    severity: Literal["Error", "Warning"] = "Error"
    """A Warning may pass by itself; an Error is raised in the program that waits."""
    terminal: bool = False
    """Whether waiting cannot help: something must be changed first."""
    count: Count = 1
    """Pods that have this problem, or attempts that failed with it."""
    since: Time | None = None
    """Since when it is there."""
    pod: str | None = None
    """One pod that has it, to look at."""
    message: str = ""
    """What happened, why, and what to do."""


class Condition(Model):
    """One condition, as in every Kubernetes resource."""

    type: str
    """Which condition."""
    status: Literal["True", "False", "Unknown"]
    """True, False or Unknown."""
    reason: str = ""
    """Why, in one word for programs."""
    message: str = ""
    """Why, for people."""
    last_transition_time: Time | None = None
    """When the status of the condition changed last."""
    observed_generation: int | None = None
    """The generation of the resource that this was found of."""


class FiberPoolStatus(Model):
    """What is there. Written by the operator."""

    observed_generation: int | None = None
    """The generation of the resource that this status is of."""
    phase: str | None = None
    """The conditions in one word, for people: Pending, Scaling, Ready, Degraded, Failed, Suspended
    or Terminating."""
    desired_replicas: Count | None = None
    """Workers wanted, after the bounds."""
    replicas: Count | None = None
    """Workers that live: pending, starting or ready."""
    ready_replicas: Count | None = None
    """Workers that are ready: each has reached its master, or waits for one on purpose."""
    connected_replicas: Count | None = None
    """Workers that are linked to the master, as its Lease says. Absent where it says nothing."""
    pending_replicas: Count | None = None
    """Workers that do not run yet."""
    terminating_replicas: Count | None = None
    """Workers that are being deleted."""
    updated_replicas: Count | None = None
    """Workers that live and are of the current template."""
    selector: str | None = None
    """Selects the pool's pods, for the scale subresource."""
    endpoint: str | None = None
    """Where the workers dial: the pool's Service."""
    master: str | None = None
    """Address of the master that the endpoint leads to now."""
    master_epoch: Annotated[int | None, Field(ge=0, le=2**53)] = None
    """The highest epoch that a master of this pool has had. A new master takes a higher one."""
    idle_since: Time | None = None
    """Since when the master has asked for no workers, where spec.idle is set."""
    credentials_secret: str | None = None
    """Name of the Secret that the master listens with, once it is made and whole."""
    template_hash: str | None = None
    """Hash of the current template; the pods' label fiber.dev/template-hash."""
    proven_template_hash: str | None = None
    """Hash of the last template of which a worker became ready."""
    failures: Failures = Failures()
    problems: Annotated[
        tuple[Problem, ...],
        Field(strict=False, json_schema_extra={"x-kubernetes-list-type": "atomic"}),
    ] = ()
    """What is wrong, worst first, at most ten."""
    conditions: Annotated[
        tuple[Condition, ...],
        Field(
            strict=False,
            json_schema_extra={**LIST_AS_MAP, "x-kubernetes-list-map-keys": ["type"]},
        ),
    ] = ()
    """Accepted, Ready, Progressing, Degraded, MasterAlive, ScalingLimited and Suspended."""

    @classmethod
    def salvage(cls, document: object) -> tuple[FiberPoolStatus, tuple[str, ...]]:
        """What can be read of ``document``, and what is wrong with the rest, naming each field.

        Never raises: a status is what the operator remembers, and it goes on with less.
        """
        complaints: tuple[str, ...] = ()
        rest, before = document, None
        while rest != before:
            try:
                return cls.model_validate(rest), complaints
            except ValidationError as error:
                complaints += describe(error, ("status",))
                locations = {_to_item(detail["loc"]) for detail in error.errors()}
                rest, before = _without(rest, locations), rest
        return cls(), complaints


def _to_item(location: _Path) -> _Path:
    """``location``, or the innermost list item that it is in: half an item is no use."""
    for end in range(len(location), 0, -1):
        if isinstance(location[end - 1], int):
            return location[:end]
    return location


def _without(document: object, locations: set[_Path]) -> object:
    """``document`` less what is at ``locations``."""
    if () in locations:
        return {}
    if isinstance(document, Mapping):
        return dict(_kept(document.items(), locations))
    if isinstance(document, list):
        return [value for _, value in _kept(enumerate(document), locations)]
    return document


def _kept(
    items: Iterable[tuple[Any, object]], locations: set[_Path]
) -> Iterator[tuple[Any, object]]:
    for key, value in items:
        inside = {path[1:] for path in locations if path[0] == key}
        if () not in inside:
            yield key, _without(value, inside)
