"""FiberPool in fiber.dev/v1alpha1: the only definition of its fields.

The schema that the API server enforces is generated from these models (``schema.py``), docstrings
and rules included. The operator and the tests read resources with them. Lists are tuples and
everything is frozen: a pool that was read is a value.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import Field, PrivateAttr, ValidationError

from fiber_api import names
from fiber_api.model import Model, Rule, Time, describe
from fiber_api.status import Failures, FiberPoolStatus, PoolCondition, Problem
from fiber_api.template import Template, container_names

__all__ = [
    "FailurePolicy",
    "Failures",
    "FiberPool",
    "FiberPoolSpec",
    "FiberPoolStatus",
    "Idle",
    "InvalidPool",
    "MasterSpec",
    "Metadata",
    "PoolCondition",
    "Problem",
    "ScaleDown",
    "ScaleUp",
    "Update",
]

_DAY = 86_400


class InvalidPool(ValueError):
    """Resource that cannot be understood; ``errors`` give the reasons, each naming its field."""

    def __init__(self, errors: tuple[str, ...]) -> None:
        super().__init__("; ".join(errors))
        self.errors = errors


# -- spec

ObjectName = Annotated[
    str, Field(min_length=1, max_length=253, pattern=r"^[a-z0-9]([-a-z0-9.]*[a-z0-9])?$")
]
"""Name of an object of Kubernetes."""


def _is_reachable(host: str) -> bool:
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return False
    return not (
        address.is_unspecified
        or address.is_loopback
        or address.is_multicast
        or address.is_link_local
        or host == "255.255.255.255"
        or getattr(address, "ipv4_mapped", None)
        or getattr(address, "scope_id", None)
    )


def _unchanged(field: str) -> str:
    """Return CEL for an optional field that did not change. ``self.?field`` would be shorter, but
    the API server takes it for too expensive."""
    return (
        f"has(self.{field}) == has(oldSelf.{field})"
        f" && (!has(self.{field}) || self.{field} == oldSelf.{field})"
    )


class MasterSpec(Model):
    """Program that uses the pool. Written by the SDK when it attaches; absent in a warm pool that
    waits for one."""

    RULES: ClassVar = (
        Rule(
            "host",
            "isIP(self.host) && ip(self.host).isGlobalUnicast()",
            "must be an IP address that the pods can reach, for it is put in an "
            "EndpointSlice: no host name, no loopback and no link-local address. Write the "
            "address of the master's pod or host.",
            lambda master: _is_reachable(master.host),
        ),
        Rule(
            "epoch",
            "self.epoch >= oldSelf.epoch",
            "must never fall: a lower one is that of a master that was "
            "replaced. Let the new master take an epoch above the one that is there.",
            None,
        ),
        Rule(
            "epoch",
            "self.epoch > oldSelf.epoch || (self.host == oldSelf.host && self.port == oldSelf.port"
            f" && self.identity == oldSelf.identity && {_unchanged('leaseName')}"
            f" && {_unchanged('certificate')})",
            "must rise where host, port, identity, leaseName or certificate change: that is "
            "another master, and one that is there would be replaced unseen. Take an epoch above "
            "the one that is there.",
            None,
        ),
    )

    host: Annotated[str, Field(min_length=1, max_length=45)]
    """IP address that the master listens at; the pods must be able to reach it."""
    port: Annotated[int, Field(ge=1, le=65535)]
    """TCP port that the master listens at."""
    epoch: Annotated[int, Field(ge=1, le=2**53)]
    """Number of this master: higher with every new one, and never lower than before."""
    identity: Annotated[str, Field(min_length=1, max_length=253)]
    """Name of the pool's holder, for people and for the next program, such as laptop-7:4711."""
    certificate: Annotated[
        str | None, Field(min_length=64, max_length=64, pattern="^[0-9a-f]{64}$")
    ] = None
    """SHA-256 of the certificate that the master shows its agents. The operator signs it, and the
    agents of a warm pool serve no master without that signature."""
    lease_name: ObjectName | None = None
    """Name of the Lease in this namespace that the master renews. Left out, the master counts as
    alive without a check."""
    lease_duration_seconds: Annotated[int, Field(ge=5, le=3600)] = 30
    """Seconds after which the master counts as lost if its Lease was not renewed, or does not
    exist. It renews it every third of this."""
    lost_grace_seconds: Annotated[int, Field(ge=0, le=_DAY)] = 60
    """Seconds that the workers and the pool outlive a lost master, so that it may come back."""


class Idle(Model):
    """Policy for a master that is alive and may have been forgotten."""

    timeout_seconds: Annotated[int, Field(ge=1, le=30 * _DAY)]
    """Seconds after which a master whose replicas was 0 no longer holds minReplicas. Without a
    master minReplicas is kept."""


PodName = Annotated[str, Field(min_length=1, max_length=63)]


class ScaleDown(Model):
    """Policy for making the pool smaller."""

    policy: Literal["ReleasedOnly", "Any"] = "ReleasedOnly"
    """ReleasedOnly: a ready worker is deleted only when the master has released it by name, so that
    no running task is lost. Any: the operator chooses; for pools that are scaled by kubectl or an
    autoscaler."""
    release: Annotated[
        tuple[PodName, ...],
        Field(
            strict=False,
            max_length=names.MAX_RELEASE,
            json_schema_extra={"x-kubernetes-list-type": "set"},
        ),
    ] = ()
    """Names of pods that the master has fenced and no longer needs; the operator deletes them.
    Written by the SDK."""
    idle_timeout_seconds: Annotated[int, Field(ge=0, le=_DAY)] = 60
    """Seconds that a worker may be idle before the SDK releases it."""


class ScaleUp(Model):
    """Policy for making the pool larger."""

    max_in_flight: Annotated[int, Field(ge=1, le=5000)] = 200
    """Pods that are created at once, at most. The operator begins with one and doubles as long as
    the API server accepts them."""


class FailurePolicy(Model):
    """Policy for workers that fail: exit with another code than 0, or run out of memory. Workers
    that the cluster ends (eviction, preemption, a lost node) are replaced at once and not counted.
    """

    RULES: ClassVar = (
        Rule(
            "backoffBaseSeconds",
            # A default of the whole is judged before those of its fields are filled in.
            "!has(self.backoffBaseSeconds) || !has(self.backoffMaxSeconds)"
            " || self.backoffBaseSeconds <= self.backoffMaxSeconds",
            "must not be above backoffMaxSeconds: lower the one or raise the other.",
            lambda policy: policy.backoff_base_seconds <= policy.backoff_max_seconds,
        ),
    )

    backoff_base_seconds: Annotated[int, Field(ge=1, le=3600)] = 5
    """Seconds before failed workers are replaced. Doubled with each wave of failures, until a new
    worker is ready for a minute."""
    backoff_max_seconds: Annotated[int, Field(ge=1, le=_DAY)] = 300
    """Longest wait between two waves."""
    backoff_limit: Annotated[int, Field(ge=0, le=10_000)] = 6
    """Waves of failures in a row, at none of which half of the workers wanted had been ready for a
    minute. After more than this no pod is created until template, processesPerPod, failurePolicy,
    update or suspend changes, or a master with a new epoch comes."""
    startup_timeout_seconds: Annotated[int, Field(ge=1, le=_DAY)] = 900
    """Seconds that a worker may take to become ready once its container runs. Then it counts as
    failed: its pod is deleted, and replaced like that of any other failure. A pod whose container
    does not run yet is always kept. This long after its creation, the status has an Error that no
    node takes it, or that it does not start."""


class Update(Model):
    """Policy for replacing pods of an older template."""

    strategy: Literal["OnIdle", "Recreate", "OnDelete"] = "OnIdle"
    """OnIdle: when the master releases them. Recreate: all at once, now. OnDelete: when they are
    deleted."""


class FiberPoolSpec(Model):
    """Wanted state of the pool."""

    RULES: ClassVar = (
        Rule(
            "minReplicas",
            "self.minReplicas <= self.maxReplicas",
            "must not be above spec.maxReplicas: lower the one or raise the other.",
            lambda spec: spec.min_replicas <= spec.max_replicas,
        ),
        Rule(
            "minAvailable",
            "!has(self.minAvailable) || self.minAvailable < self.minReplicas",
            "must be below spec.minReplicas, or no node with a worker could be drained: lower the "
            "one or raise the other.",
            lambda spec: spec.min_available is None or spec.min_available < spec.min_replicas,
        ),
        Rule(
            "workerContainer",
            "self.template.spec.containers.exists(c, c.name == self.workerContainer)",
            "must be the name of a container in "
            "spec.template.spec.containers: give the container that runs the agent this name "
            f"('{names.WORKER_CONTAINER}' where the field is left out), or write its name here.",
            lambda spec: spec.worker_container in container_names(spec.template),
        ),
        Rule(
            "workerContainer",
            "self.workerContainer == oldSelf.workerContainer",
            "cannot be changed: the pods that run are judged by it. Make a new FiberPool.",
            None,
        ),
        Rule(
            "credentialsSecretName",
            _unchanged("credentialsSecretName"),
            "cannot be changed: the pods that run hold the credentials of the old one. Make a new "
            "FiberPool.",
            None,
        ),
    )

    replicas: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0
    """Workers wanted now. Held between minReplicas and maxReplicas. Written by the SDK or by
    kubectl scale: leave it out of manifests that are applied again and again."""
    min_replicas: Annotated[int, Field(ge=0, le=100_000)] = 0
    """Workers that are kept even without work."""
    max_replicas: Annotated[int, Field(ge=1, le=100_000)] = 1000
    """Most workers, also if replicas is higher."""
    min_available: Annotated[int, Field(ge=1, le=100_000)] | None = None
    """Workers that a drain of nodes leaves ready, at least, by a PodDisruptionBudget."""
    suspend: bool = False
    """True: delete all pods and keep the resource."""
    processes_per_pod: Annotated[int, Field(ge=1, le=1024)] = 1
    """Processes that each worker's agent runs side by side."""
    template: Template
    """Pod that a worker runs in, as in a Deployment's template. Its fields win over
    Fiber's."""
    worker_container: Annotated[str, Field(min_length=1, max_length=63)] = names.WORKER_CONTAINER
    """Name of the container that runs Fiber's agent and by which a worker is judged. Cannot be
    changed."""
    master: MasterSpec | None = None
    relay: bool = False
    """True: workers connect to a relay pod, which the master reaches through the API server.
    Written by the SDK."""
    on_lost: Literal["Delete", "ScaleToMin", "Retain"] = "ScaleToMin"
    """Action when the master is lost: Delete deletes the pool with all its objects, ScaleToMin goes
    back to minReplicas, Retain changes nothing."""
    idle: Idle | None = None
    credentials_secret_name: ObjectName | None = None
    """Name of a Secret in this namespace with the workers' credentials, made by the pool's maker.
    Left out, the operator makes one. Cannot be changed."""
    scale_down: ScaleDown = ScaleDown()
    scale_up: ScaleUp = ScaleUp()
    failure_policy: FailurePolicy = FailurePolicy()
    update: Update = Update()


# -- The resource


class Metadata(Model):
    """Part of an object's metadata that the operator needs."""

    name: Annotated[str, Field(min_length=1)]
    namespace: str = ""
    uid: str = ""
    labels: Mapping[str, str] = {}
    generation: int = 0
    creation_timestamp: Time | None = None
    deletion_timestamp: Time | None = None


class FiberPool(Model):
    """A pool of worker pods for Python programs that use Fiber."""

    RULES: ClassVar = (
        Rule(
            "metadata.name",
            f"size(self.metadata.name) <= {names.MAX_POOL_NAME}",
            f"must have at most {names.MAX_POOL_NAME} characters: the names of its "
            "pods and its Service are made from it. Use a shorter name.",
            lambda pool: len(pool.metadata.name) <= names.MAX_POOL_NAME,
        ),
        Rule(
            "metadata.name",
            f"self.metadata.name.matches('^{names.POOL_NAME_PATTERN}$')",
            "must consist of lower-case letters, digits and '-', begin with a "
            "letter and not end with '-': a Service is called after it. Use another name.",
            lambda pool: re.fullmatch(names.POOL_NAME_PATTERN, pool.metadata.name) is not None,
        ),
        Rule(
            "spec.master.epoch",
            # The master's own rules compare it with the old one. A new master is compared with
            # the status.
            "has(oldSelf.spec.master) || !has(self.spec.master) || !has(self.status)"
            " || !has(self.status.masterEpoch)"
            " || self.spec.master.epoch > self.status.masterEpoch",
            "must not be below status.masterEpoch, which an earlier master of this pool had, nor "
            "may a master that comes have the same. Let it take a higher one.",
            lambda pool: (
                pool.spec.master is None
                or pool.spec.master.epoch >= (pool.status.master_epoch or 0)
            ),
        ),
    )

    api_version: Literal["fiber.dev/v1alpha1"] = names.API_VERSION
    kind: Literal["FiberPool"] = names.KIND
    metadata: Metadata
    spec: FiberPoolSpec
    status: FiberPoolStatus = FiberPoolStatus()

    _unread: tuple[str, ...] = PrivateAttr(default=())

    @property
    def unread(self) -> tuple[str, ...]:
        """Errors of the status that this was read from, which were left out."""
        return self._unread

    @classmethod
    def read(cls, document: object) -> FiberPool:
        """Return the resource in the API's JSON.

        Raises only ``InvalidPool``, if the spec cannot be understood. The parts of the status that
        cannot be understood are left out and reported in ``unread``.
        """
        unread: tuple[str, ...] = ()
        try:
            if isinstance(document, Mapping) and "status" in document:
                status, unread = FiberPoolStatus.salvage(document["status"] or {})
                document = {**document, "status": status}
            pool = cls.model_validate(document)
        except ValidationError as error:
            raise InvalidPool(describe(error)) from None
        pool._unread = unread
        return pool

    @property
    def wanted(self) -> int:
        """Return ``replicas`` between the bounds."""
        return max(self.spec.min_replicas, min(self.spec.max_replicas, self.spec.replicas))

    @property
    def credentials_secret(self) -> str:
        """Return the name of the Secret with the workers' credentials."""
        return self.spec.credentials_secret_name or names.secret_name(self.metadata.name)
