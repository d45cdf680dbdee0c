"""Every name that the SDK and the operator must agree on.  Standard library only.

A name that appears in a cluster is part of the contract: objects made by an older release carry it.
Add to this module freely; change nothing in it without a new API version.
"""

from __future__ import annotations

import re
from enum import StrEnum
from typing import Final

# -- The resource

GROUP: Final = "fiber.dev"
VERSION: Final = "v1alpha1"
API_VERSION: Final = "fiber.dev/v1alpha1"
KIND: Final = "FiberPool"
LIST_KIND: Final = "FiberPoolList"
PLURAL: Final = "fiberpools"
SINGULAR: Final = "fiberpool"
SHORT_NAMES: Final = ("fp", "fpool")
CATEGORIES: Final = ("all", "fiber")
CRD_NAME: Final = f"{PLURAL}.{GROUP}"

# -- Who writes: field managers of server-side apply, and the value of LABEL_MANAGED_BY

SDK_MANAGER: Final = "fiber-sdk"
"""Owns ``spec.replicas``, ``spec.scaleDown.release`` and ``spec.master``."""
OPERATOR_MANAGER: Final = "fiber-operator"
"""Owns the status, the pods, the Service, its EndpointSlice and the Secret, unless
``spec.credentialsSecretName`` names one; never the spec."""

# -- Labels and annotations

LABEL_POOL: Final = f"{GROUP}/pool"
LABEL_POOL_UID: Final = f"{GROUP}/pool-uid"
"""Tells a pool from an earlier one of the same name: pods are selected by it."""
LABEL_TEMPLATE_HASH: Final = f"{GROUP}/template-hash"
"""The hash of the user's template alone, so that a new operator restarts nothing."""
LABEL_EPOCH: Final = f"{GROUP}/epoch"
"""The master's epoch when the pod was made."""
LABEL_MANAGED_BY: Final = "app.kubernetes.io/managed-by"
LABEL_SERVICE_NAME: Final = "kubernetes.io/service-name"
"""Kubernetes': ties an EndpointSlice to its Service."""
LABEL_SLICE_MANAGED_BY: Final = "endpointslice.kubernetes.io/managed-by"
"""Kubernetes': who writes an EndpointSlice."""
ANNOTATION_DELETION_COST: Final = "controller.kubernetes.io/pod-deletion-cost"
"""Kubernetes': of two pods alike, policy Any deletes the one with the lower cost first."""
ANNOTATIONS_KEEP_NODE: Final = {
    "cluster-autoscaler.kubernetes.io/safe-to-evict": "false",
    "karpenter.sh/do-not-disrupt": "true",
}
"""What keeps the cluster autoscaler and Karpenter from emptying a node under workers at work."""
ANNOTATION_CONNECTED: Final = f"{GROUP}/connected-agents"
"""Of a master's Lease: how many agents were linked to it when it was renewed."""

# -- The sign that an operator serves a namespace

SERVING_LEASE: Final = f"operator.{GROUP}"
"""The Lease that each operator renews where it serves.  Several operators may write it: a fresh one
says that an operator lives.  ``operator_lease_name`` never gives this name."""
SERVING_NAMESPACE: Final = "kube-public"
"""Where that Lease is if the operator serves all namespaces; else in each that it serves.  Every
cluster has this namespace."""
SERVING_SECONDS: Final = 300
"""How long the Lease is fresh: longer than a restart or an upgrade of the operator takes."""

# -- The worker container

WORKER_CONTAINER: Final = "worker"
"""What ``spec.workerContainer`` is when left out."""

ENV_NAME: Final = "FIBER_AGENT_NAME"
"""The pod's name: what the master calls the agent, and releases it by.  Always the operator's,
whatever the template says."""
ENV_UID: Final = "FIBER_AGENT_UID"
"""The pod's uid, which no other pod of that name has."""
ENV_TEMPLATE_HASH: Final = "FIBER_AGENT_TEMPLATE_HASH"
"""The pod's LABEL_TEMPLATE_HASH: by it the master tells which agents are outdated."""
ENV_ADDRESS: Final = "FIBER_AGENT_ADDRESS"
"""``host:port`` of the pool's Service."""
ENV_CREDENTIALS: Final = "FIBER_AGENT_CREDENTIALS"
"""The file with the agent's credentials.  The agent removes it before it starts a child."""
ENV_KEY: Final = "FIBER_AGENT_KEY"
"""The folder with the pool's key: set in the init container alone, which writes ENV_CREDENTIALS."""
ENV_POOL: Final = "FIBER_AGENT_POOL"
ENV_NAMESPACE: Final = "FIBER_AGENT_NAMESPACE"
ENV_PROCESSES: Final = "FIBER_AGENT_PROCESSES"
"""How many children the agent runs: ``spec.processesPerPod``."""
ENV_LOST_GRACE: Final = "FIBER_AGENT_LOST_GRACE"
"""Seconds that an agent outlives its master: ``spec.master.lostGraceSeconds``."""
ENV_TERMINATION_GRACE: Final = "FIBER_AGENT_TERMINATION_GRACE"
"""Seconds that a pod has after SIGTERM: the template's ``terminationGracePeriodSeconds``."""
ENV_LINKED: Final = "FIBER_AGENT_LINKED"
"""The file that the agent makes once a master has answered it; the startup probe waits for it."""

IDENTITY_CONTAINER: Final = "fiber-identity"
"""The first init container: derives the agent's key from the pool's."""
KEY_VOLUME: Final = "fiber-key"
KEY_DIRECTORY: Final = "/etc/fiber/key"
"""The pool's Secret, which no other container mounts."""
CREDENTIALS_VOLUME: Final = "fiber-credentials"
CREDENTIALS_DIRECTORY: Final = "/etc/fiber/credentials"
CREDENTIALS_FILE: Final = "agent.json"
PROBE_PROGRAM: Final = "python"
"""Beside the credentials: the interpreter that runs the startup probe.  The init container links it
to its own, since nobody else knows where an image has one."""
LINKED_FILE: Final = "linked"

# -- The way to the master

MASTER_PORT: Final = 7070
"""The port of the Service; the master itself listens where ``spec.master.port`` says."""
MASTER_PORT_NAME: Final = "fiber"
ENDPOINT_SCHEME: Final = "tls+tcp"

# -- The Secret: its keys

KEY_POOL: Final = "key"
"""256 random bits in hexadecimal digits, from which the key of each agent is derived."""
KEY_MASTER: Final = "master"
"""The SHA-256 of the certificate of the only master that the pool ever has; absent where one master
may follow another."""

# -- Limits

MAX_POOL_NAME: Final = 50
"""Leaves room for what is appended to it: pod and Service names end at 63 characters."""
MAX_RELEASE: Final = 500
"""Pods that one ``spec.scaleDown.release`` may name."""
MAX_PROBLEMS: Final = 10
"""Problems that a status shows."""
POD_SUFFIX_LENGTH: Final = 10
"""Hexadecimal digits that end a pod's name; forty bits, drawn at random and never used again."""

POOL_NAME_PATTERN: Final = "[a-z]([-a-z0-9]*[a-z0-9])?"
"""A Service is called after the pool: its name must be a DNS label that begins with a letter."""

_POOL_NAME = re.compile(POOL_NAME_PATTERN)
_POD_SUFFIX = re.compile(f"[0-9a-f]{{{POD_SUFFIX_LENGTH}}}")


class InvalidName(ValueError):
    """A name that Kubernetes would refuse; the message says which, why, and what to use."""


def check_pool_name(pool: str) -> str:
    """``pool`` itself, if a FiberPool may have that name; else ``InvalidName``."""
    if len(pool) > MAX_POOL_NAME:
        raise InvalidName(
            f"the pool name {pool!r} has {len(pool)} characters, more than {MAX_POOL_NAME}: the "
            "names of its pods and its Service are made from it. Use a shorter one."
        )
    if not _POOL_NAME.fullmatch(pool):
        raise InvalidName(
            f"{pool!r} cannot be the name of a pool: its Service is called after it. Use "
            "lower-case letters, digits and '-', with a letter first and no '-' at the end."
        )
    return pool


def pod_name(pool: str, suffix: str) -> str:
    """The name of one pod: at most 61 characters.  The caller draws the suffix."""
    if not _POD_SUFFIX.fullmatch(suffix):
        raise InvalidName(f"{suffix!r} is not {POD_SUFFIX_LENGTH} hexadecimal digits")
    return f"{pool}-{suffix}"


def service_name(pool: str) -> str:
    """The Service that agents dial: at most 56 characters."""
    return f"{pool}-fiber"


def endpoint_slice_name(pool: str) -> str:
    """The Service's one EndpointSlice."""
    return service_name(pool)


def budget_name(pool: str) -> str:
    """The PodDisruptionBudget of the pool's workers."""
    return service_name(pool)


def secret_name(pool: str) -> str:
    """The Secret with the pool's key: at most 60 characters."""
    return f"{pool}-fiber-key"


def master_lease_name(pool: str) -> str:
    """The Lease that the SDK makes and names in ``spec.master.leaseName``.

    Its labels are LABEL_POOL and LABEL_POOL_UID, by which the operator hears of its renewals.
    """
    return f"fiber-{pool}"


def operator_lease_name(release: str) -> str:
    """The Lease by which one process of a release acts: with dots, which no master's Lease has."""
    return f"{release}.operator.{GROUP}"


def address_of(host: str, port: int | str) -> str:
    """``host:port``, an IPv6 address in brackets; ``port`` may be a range."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def endpoint_of(address: str) -> str:
    """``host:port`` as ``status.endpoint`` shows it."""
    return f"{ENDPOINT_SCHEME}://{address}"


# -- What a status says


class ConditionType(StrEnum):
    """The types of ``status.conditions``."""

    ACCEPTED = "Accepted"
    """The operator understands the spec and the API server accepts its pods."""
    READY = "Ready"
    """As many workers as wanted are ready."""
    PROGRESSING = "Progressing"
    """Something is under way: pods are created, waited for, replaced or deleted."""
    DEGRADED = "Degraded"
    """Workers fail or cannot be had; the reason is the worst problem's."""
    MASTER_ALIVE = "MasterAlive"
    """Unknown while there is no master, or no Lease to tell by."""
    SCALING_LIMITED = "ScalingLimited"
    """``replicas`` asks for more than ``maxReplicas``, or for some and fewer than
    ``minReplicas``."""
    SUSPENDED = "Suspended"
    """``spec.suspend`` holds the pool at no pods."""


class Phase(StrEnum):
    """``status.phase``: the conditions in one word, for people.  Programs read the conditions."""

    PENDING = "Pending"
    """It has no workers, and the API server has not said yet whether it takes any."""
    SCALING = "Scaling"
    """Workers are on their way, or are leaving."""
    READY = "Ready"
    """What is wanted is there, even if that is nothing."""
    DEGRADED = "Degraded"
    """Something is wrong that may still pass; problems say what."""
    FAILED = "Failed"
    """Nothing more is created until the spec changes; problems say why."""
    SUSPENDED = "Suspended"
    TERMINATING = "Terminating"
    """The pool is being deleted."""


class Reason(StrEnum):
    """Why: reasons of problems, conditions and events.  The SDK raises those of problems.

    Where Kubernetes has a word for it, this is Kubernetes' word.
    """

    # Problems: the spec, or what the API server makes of it.
    INVALID_SPEC = "InvalidSpec"
    """The operator cannot read the spec."""
    INVALID_TEMPLATE = "InvalidTemplate"
    """The API server refuses a pod of this template (422)."""
    QUOTA_EXCEEDED = "QuotaExceeded"
    """A ResourceQuota refuses more pods (403)."""
    REQUESTS_MISSING = "RequestsMissing"
    """A ResourceQuota counts requests or limits that the pod does not have (403)."""
    FORBIDDEN = "Forbidden"
    """An admission policy, or a right that the operator lacks (403 for any other cause)."""
    NAME_TAKEN = "NameTaken"
    """An object that is not the pool's has a name that the pool needs."""
    INVALID_CREDENTIALS = "InvalidCredentials"
    """The pool's Secret is damaged or about to expire."""
    ADDRESS_CHANGED = "AddressChanged"
    """The Service was made anew with another address than the one that workers dial."""
    CREDENTIALS_CHANGED = "CredentialsChanged"
    """The Secret was made anew, and workers hold keys of the old one."""
    INVALID_RELEASE = "InvalidRelease"
    """``scaleDown.release`` names what is not a pod of this pool."""

    # Problems: pods that do not start.
    INVALID_IMAGE_NAME = "InvalidImageName"
    IMAGE_NEVER_PULL = "ErrImageNeverPull"
    IMAGE_PULL_ERROR = "ImagePullError"
    CONTAINER_CONFIG_ERROR = "CreateContainerConfigError"
    CONTAINER_ERROR = "CreateContainerError"
    RUN_CONTAINER_ERROR = "RunContainerError"
    UNSCHEDULABLE = "Unschedulable"
    STARTUP_TIMEOUT = "StartupTimeout"
    """Not ready for ``failurePolicy.startupTimeoutSeconds``."""

    # Problems: pods that end.
    CONTAINER_FAILED = "ContainerFailed"
    """The worker exited with a code other than 0."""
    OOM_KILLED = "OOMKilled"
    COMPLETED = "Completed"
    """The worker exited with code 0 though nobody released it."""
    DISRUPTED = "Disrupted"
    """Evicted, preempted, deleted by someone, or its node is gone: replaced and not counted."""
    NOT_READY = "NotReady"
    """A pod that was ready is not any more."""
    BACKOFF_LIMIT_EXCEEDED = "BackoffLimitExceeded"
    """``failurePolicy.backoffLimit`` failures in a row: nothing more is created."""

    # Problems: the master and the API server.
    MASTER_LOST = "MasterLost"
    """The master's Lease has expired."""
    LEASE_NOT_FOUND = "LeaseNotFound"
    """There is no Lease of the name in ``spec.master.leaseName`` yet, or not any more."""
    API_UNAVAILABLE = "ApiUnavailable"
    """A call of the operator fails: an admission webhook is down, the API server is busy."""

    # Conditions: what is neither good nor bad news.
    AS_EXPECTED = "AsExpected"
    NOT_JUDGED = "NotJudged"
    """The API server has not said yet whether it takes pods of the template."""
    CREATING = "Creating"
    STARTING = "Starting"
    BACKING_OFF = "BackingOff"
    DRAINING = "Draining"
    """More workers are ready than wanted, and only the master may say which are idle."""
    DELETING = "Deleting"
    UPDATING = "Updating"
    """Pods of an older template are there."""
    SCALED_TO_ZERO = "ScaledToZero"
    SUSPENDED = "Suspended"
    NOT_SUSPENDED = "NotSuspended"
    TERMINATING = "Terminating"
    NO_MASTER = "NoMaster"
    LEASE_RENEWED = "LeaseRenewed"
    LEASE_NOT_CHECKED = "LeaseNotChecked"
    """``spec.master.leaseName`` is absent, or the Lease was not seen yet."""
    WITHIN_BOUNDS = "WithinBounds"
    ABOVE_MAXIMUM = "AboveMaximum"
    BELOW_MINIMUM = "BelowMinimum"

    # Events that are no condition.
    SCALED_UP = "ScaledUp"
    SCALED_DOWN = "ScaledDown"
    RELEASED = "Released"
    REPLACED = "Replaced"
    RECOVERED = "Recovered"
    MASTER_CHANGED = "MasterChanged"
    SERVED_TWICE = "ServedTwice"
    """Another program writes the pool's status: probably a second operator."""
