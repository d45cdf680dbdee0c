"""Status of a pool: the operator's report on it, and its memory of it."""

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
    failurePolicy.backoffLimit no pod is created."""
    waves: Count = 0
    """Waves in a row since a new worker was last ready for a minute. Each doubles the time until
    failed workers are replaced."""
    waiting: Count = 0
    """Workers that are not replaced before nextCreateTime."""
    total: Count = 0
    """Workers that failed, since the pool was made."""
    disrupted: Count = 0
    """Workers that the cluster ended, since the pool was made. They do not count as failures."""
    last_exit_code: ExitCode | None = None
    """Exit code of the worker that failed last."""
    last_reason: str | None = None
    """Reason of that failure."""
    next_create_time: Time | None = None
    """Time before which failed workers are not replaced."""
    counted: Annotated[
        tuple[str, ...],
        Field(strict=False, json_schema_extra={"x-kubernetes-list-type": "atomic"}),
    ] = ()
    """Pods that are in these sums and still exist."""
    spec_hash: str | None = None
    """Hash of the part of the spec that these waves belong to; when it changes they are
    forgotten."""


class Problem(Model):
    """Problem that keeps workers from running."""

    reason: str
    """Word for programs, such as ImagePullError or Unschedulable."""
    severity: Literal["Error", "Warning"] = "Error"
    """Warning or Error. A Warning may pass by itself; an Error is raised in the program that
    waits."""
    terminal: bool = False
    """True if waiting cannot help: the pool or the cluster must be changed first."""
    count: Count = 1
    """Pods that have this problem, or attempts that failed with it."""
    since: Time | None = None
    """Time since which the problem exists."""
    pod: str | None = None
    """Example pod that has the problem."""
    message: str = ""
    """Sentences: what happened, why, and what to do."""


class PoolCondition(Model):
    """Condition, as in every Kubernetes resource."""

    type: str
    """Type of the condition."""
    status: Literal["True", "False", "Unknown"]
    """True, False or Unknown."""
    reason: str = ""
    """Reason, in one word for programs."""
    message: str = ""
    """Reason, in words for people."""
    last_transition_time: Time | None = None
    """Time at which the status of the condition changed last."""
    observed_generation: int | None = None
    """Generation of the resource that the condition describes."""


class FiberPoolStatus(Model):
    """Observed state of the pool. Written by the operator."""

    observed_generation: int | None = None
    """Generation of the resource that this status describes."""
    phase: str | None = None
    """Conditions in one word, for people: Pending, Scaling, Ready, Degraded, Failed, Suspended or
    Terminating."""
    desired_replicas: Count | None = None
    """Workers wanted, after the bounds."""
    replicas: Count | None = None
    """Workers that live: pending, starting or ready."""
    ready_replicas: Count | None = None
    """Workers that are ready: each has reached its master, or waits for one on purpose."""
    connected_replicas: Count | None = None
    """Workers that are linked to the master, by its Lease. Absent if the Lease does not say it."""
    pending_replicas: Count | None = None
    """Workers that do not run yet."""
    terminating_replicas: Count | None = None
    """Workers that are being deleted."""
    updated_replicas: Count | None = None
    """Workers that live and have the current template."""
    selector: str | None = None
    """Selector of the pool's pods, for the scale subresource."""
    endpoint: str | None = None
    """Address that the workers dial: the pool's Service."""
    master: str | None = None
    """Address of the master that the endpoint leads to now."""
    relay: str | None = None
    """Name of the Deployment of the pool's relay."""
    master_epoch: Annotated[int | None, Field(ge=0, le=2**53)] = None
    """Highest epoch that a master of this pool has had. A new master takes a higher one."""
    master_signature: str | None = None
    """Signature of the pool for spec.master.certificate and masterEpoch, in hexadecimal digits."""
    public_key: str | None = None
    """Public key of the pool, which agents and masters check signatures with. Absent if the Secret
    names the only master of the pool."""
    idle_since: Time | None = None
    """Time since which the master has asked for no workers, if spec.idle is set."""
    credentials_secret: str | None = None
    """Name of the Secret with the pool's key, once it is complete."""
    template_hash: str | None = None
    """Hash of the current template; the pods' label fiber.dev/template-hash."""
    proven_template_hash: str | None = None
    """Hash of the last template that gave a ready worker."""
    failures: Failures = Failures()
    problems: Annotated[
        tuple[Problem, ...],
        Field(strict=False, json_schema_extra={"x-kubernetes-list-type": "atomic"}),
    ] = ()
    """Problems, worst first, at most ten."""
    conditions: Annotated[
        tuple[PoolCondition, ...],
        Field(
            strict=False,
            json_schema_extra={**LIST_AS_MAP, "x-kubernetes-list-map-keys": ["type"]},
        ),
    ] = ()
    """Accepted, Ready, Progressing, Degraded, MasterAlive, ScalingLimited and Suspended."""

    @classmethod
    def salvage(cls, document: object) -> tuple[FiberPoolStatus, tuple[str, ...]]:
        """Return the readable part of ``document``, and the errors of the rest, naming each field.

        Never raises: the status is the operator's memory, and it goes on with less.
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
    """Return ``location``, or the innermost list item that it is in, since half an item is of no
    use."""
    for end in range(len(location), 0, -1):
        if isinstance(location[end - 1], int):
            return location[:end]
    return location


def _without(document: object, locations: set[_Path]) -> object:
    """Return ``document`` without what is at ``locations``."""
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
