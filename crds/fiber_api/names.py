"""Names that the SDK and the operator must agree on. Standard library only.

A name that appears in a cluster is part of the contract: objects made by an older release carry it.
Add to this module freely; change no name without a new API version.
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

# -- Writers: field managers of server-side apply, and the value of LABEL_MANAGED_BY

SDK_MANAGER: Final = "fiber-sdk"
"""Owner of ``spec.replicas``, ``spec.scaleDown.release``, ``spec.master`` and ``spec.relay``."""
COMMAND_MANAGER: Final = "fiber-cli"
"""Owner of what a person sets by the command ``fiber``.  A program's next apply leaves it alone."""
OPERATOR_MANAGER: Final = "fiber-operator"
"""Owner of the status, the pods, the Service, its EndpointSlice, the relay and the Secret, unless
``spec.credentialsSecretName`` names one; never of the spec."""

# -- Labels and annotations

LABEL_POOL: Final = f"{GROUP}/pool"
LABEL_POOL_UID: Final = f"{GROUP}/pool-uid"
"""Uid of the pool, which tells it from an earlier one of the same name: pods are selected by it."""
LABEL_TEMPLATE_HASH: Final = f"{GROUP}/template-hash"
"""Hash of the user's template alone, so that a new operator restarts no worker."""
LABEL_EPOCH: Final = f"{GROUP}/epoch"
"""Epoch of the master when the pod was made."""
LABEL_MANAGED_BY: Final = "app.kubernetes.io/managed-by"
LABEL_SERVICE_NAME: Final = "kubernetes.io/service-name"
"""Kubernetes' label that ties an EndpointSlice to its Service."""
LABEL_SLICE_MANAGED_BY: Final = "endpointslice.kubernetes.io/managed-by"
"""Kubernetes' label for the writer of an EndpointSlice."""
ANNOTATION_DELETION_COST: Final = "controller.kubernetes.io/pod-deletion-cost"
"""Kubernetes' annotation: of two equal pods, policy Any deletes the one with the lower cost
first."""
ANNOTATIONS_KEEP_NODE: Final = {
    "cluster-autoscaler.kubernetes.io/safe-to-evict": "false",
    "karpenter.sh/do-not-disrupt": "true",
}
"""Annotations that keep the cluster autoscaler and Karpenter from emptying a node with working
workers."""
ANNOTATION_CONNECTED: Final = f"{GROUP}/connected-agents"
"""Annotation of a master's Lease: number of agents that were linked to it at the renewal."""

# -- The sign that an operator serves a namespace

SERVING_LEASE: Final = f"operator.{GROUP}"
"""Lease that each operator renews in the namespaces that it serves. Several operators may write it:
a fresh one says that an operator lives. ``operator_lease_name`` never gives this name."""
SERVING_NAMESPACE: Final = "kube-public"
"""Namespace of that Lease if the operator serves all namespaces; else it is in each served one.
Every cluster has this namespace."""
SERVING_SECONDS: Final = 300
"""Seconds for which the Lease is fresh: longer than a restart or an upgrade of the operator
takes."""

# -- The worker container

WORKER_CONTAINER: Final = "worker"
"""Default of ``spec.workerContainer``."""

ENV_NAME: Final = "FIBER_AGENT_NAME"
"""Pod's name: the master calls the agent by it, and releases it by it. Always the operator's value,
even if the template sets another."""
ENV_UID: Final = "FIBER_AGENT_UID"
"""Pod's uid, which no other pod of that name has."""
ENV_TEMPLATE_HASH: Final = "FIBER_AGENT_TEMPLATE_HASH"
"""Pod's LABEL_TEMPLATE_HASH, by which the master finds outdated agents."""
ENV_ADDRESS: Final = "FIBER_AGENT_ADDRESS"
"""Address of the pool's Service, ``host:port``."""
ENV_CREDENTIALS: Final = "FIBER_AGENT_CREDENTIALS"
"""File with the agent's credentials. The agent removes it before it starts a child."""
ENV_KEY: Final = "FIBER_AGENT_KEY"
"""Folder with the pool's key. Only the init container has it, which writes ENV_CREDENTIALS."""
ENV_POOL_UID: Final = "FIBER_AGENT_POOL_UID"
"""Uid of the pool. Only the init container has it, which signs with the pool's key."""
ENV_EPOCH: Final = "FIBER_AGENT_EPOCH"
"""Highest epoch that a master of the pool had when the pod was made. Only the init container has
it; the agent serves no master with a lower epoch."""
ENV_POOL: Final = "FIBER_AGENT_POOL"
ENV_NAMESPACE: Final = "FIBER_AGENT_NAMESPACE"
ENV_PROCESSES: Final = "FIBER_AGENT_PROCESSES"
"""Number of children that the agent runs: ``spec.processesPerPod``."""
ENV_LOST_GRACE: Final = "FIBER_AGENT_LOST_GRACE"
"""Seconds that an agent outlives its master: ``spec.master.lostGraceSeconds``."""
ENV_TERMINATION_GRACE: Final = "FIBER_AGENT_TERMINATION_GRACE"
"""Seconds that a pod has after SIGTERM: the template's ``terminationGracePeriodSeconds``."""
ENV_LINKED: Final = "FIBER_AGENT_LINKED"
"""File that the agent makes once a master has answered it; the startup probe waits for it."""

IDENTITY_CONTAINER: Final = "fiber-identity"
"""First init container, which makes the agent's key with the pool's."""
KEY_VOLUME: Final = "fiber-key"
KEY_DIRECTORY: Final = "/etc/fiber/key"
"""Volume with the pool's Secret, which no other container mounts."""
CREDENTIALS_VOLUME: Final = "fiber-credentials"
CREDENTIALS_DIRECTORY: Final = "/etc/fiber/credentials"
CREDENTIALS_FILE: Final = "agent.json"
PROBE_PROGRAM: Final = "python"
"""Interpreter that runs the startup probe, beside the credentials. The init container links it to
its own, because only the image knows its path."""
LINKED_FILE: Final = "linked"

# -- The way to the master

MASTER_PORT: Final = 7070
"""Port of the Service; the master itself listens at ``spec.master.port``."""
MASTER_PORT_NAME: Final = "fiber"
ENDPOINT_SCHEME: Final = "tls+tcp"

PEER_PORT: Final = 7073
"""Port at which the agent in a pod serves large blobs to other agents."""

# -- The relay, for programs that pods cannot reach

LABEL_RELAY: Final = f"{GROUP}/relay"
"""Label of the relay's pod, with the uid of its pool. The Service selects the pod by it. The pod
has neither LABEL_POOL nor LABEL_POOL_UID, by which workers are found."""
ANNOTATION_RELAY_HASH: Final = f"{GROUP}/relay-hash"
"""Annotation of the relay's Deployment: hash of the body that the operator wrote."""
RELAY_CONTAINER: Final = "relay"
RELAY_PORT: Final = 7071
"""Port on the loopback of the relay's pod, to which the master opens a port-forward. The relay
listens for agents at MASTER_PORT."""
ENV_RELAY_AGENTS_PORT: Final = "FIBER_RELAY_AGENTS_PORT"
"""Port for agents. A worker's command that has this variable is a relay."""
ENV_RELAY_MASTER_PORT: Final = "FIBER_RELAY_MASTER_PORT"

# -- Programs that `fiber run` starts

LABEL_PROGRAM: Final = f"{GROUP}/program"
"""Label of the Job and the pod of a program, with the program's name."""
ANNOTATION_COMMAND: Final = f"{GROUP}/command"
"""Annotation of the Job: the program's command line, for people."""
ANNOTATION_RUN: Final = f"{GROUP}/run"
"""Annotation of the Job: a random word, by which `fiber run` knows what it has made."""
PROGRAM_CONTAINER: Final = "program"
PROGRAM_ACCOUNT: Final = "fiber-program"
"""ServiceAccount of programs, unless `fiber run` is given another one."""
LAUNCHER_PORT: Final = 7072
"""Port on the loopback of the program's pod, to which `fiber run` opens a port-forward."""

# -- The Secret: its keys

KEY_POOL: Final = "key"
"""Entry with 256 random bits in hexadecimal digits: the pool's key."""
KEY_MASTER: Final = "master"
"""Entry with the SHA-256 of the certificate of the only master that the pool ever has; absent if
one master may follow another."""

# -- Limits

MAX_POOL_NAME: Final = 50
"""Longest name of a pool, with room for suffixes: pod and Service names end at 63 characters."""
MAX_RELEASE: Final = 500
"""Pods that one ``spec.scaleDown.release`` may name."""
MAX_PROBLEMS: Final = 10
"""Problems that a status shows."""
POD_SUFFIX_LENGTH: Final = 10
"""Hexadecimal digits that end a pod's name; forty random bits, never used again."""
SECRET_SUFFIX_LENGTH: Final = 16
"""Hexadecimal digits that end the name of a Secret which replaces one of an unknown maker."""

POOL_NAME_PATTERN: Final = "[a-z]([-a-z0-9]*[a-z0-9])?"
"""Pattern of a pool's name. Its Service has the same name, which must be a DNS label that begins
with a letter."""

_POOL_NAME = re.compile(POOL_NAME_PATTERN)
_POD_SUFFIX = re.compile(f"[0-9a-f]{{{POD_SUFFIX_LENGTH}}}")
_SECRET_NAME = re.compile(
    f"({POOL_NAME_PATTERN})-fiber-key(?:-[0-9a-f]{{{SECRET_SUFFIX_LENGTH}}})?"
)


class InvalidName(ValueError):
    """Name that Kubernetes would refuse; the message says which, why, and what to use."""


def check_pool_name(pool: str) -> str:
    """Return ``pool`` itself, if a FiberPool may have that name; else raise ``InvalidName``."""
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
    """Return the name of one pod: at most 61 characters. The caller draws the suffix."""
    if not _POD_SUFFIX.fullmatch(suffix):
        raise InvalidName(f"{suffix!r} is not {POD_SUFFIX_LENGTH} hexadecimal digits")
    return f"{pool}-{suffix}"


def service_name(pool: str) -> str:
    """Return the name of the Service that agents dial: at most 56 characters."""
    return f"{pool}-fiber"


def endpoint_slice_name(pool: str) -> str:
    """Return the name of the Service's one EndpointSlice."""
    return service_name(pool)


def budget_name(pool: str) -> str:
    """Return the name of the PodDisruptionBudget of the pool's workers."""
    return service_name(pool)


def secret_name(pool: str) -> str:
    """Return the name of the Secret with the pool's key: at most 60 characters.

    A program adds a random suffix if it cannot tell who made the Secret of that name.
    """
    return f"{pool}-fiber-key"


def pool_of_secret(secret: str) -> str | None:
    """Return the pool for whose key the name ``secret`` is reserved; None if there is none."""
    found = _SECRET_NAME.fullmatch(secret)
    return None if found is None else found[1]


def relay_name(pool: str) -> str:
    """Return the name of the Deployment of the pool's relay: at most 62 characters."""
    return f"{pool}-fiber-relay"


def master_lease_name(pool: str) -> str:
    """Return the name of the Lease that the SDK makes and names in ``spec.master.leaseName``.

    Its labels are LABEL_POOL and LABEL_POOL_UID, by which the operator's watch finds it.
    """
    return f"fiber-{pool}"


def operator_lease_name(release: str) -> str:
    """Return the name of the Lease by which one process of a release acts: with dots, unlike
    masters'."""
    return f"{release}.operator.{GROUP}"


def address_of(host: str, port: int | str) -> str:
    """Return ``host:port``, an IPv6 address in brackets; ``port`` may be a range."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def endpoint_of(address: str) -> str:
    """Return ``host:port`` as ``status.endpoint`` shows it."""
    return f"{ENDPOINT_SCHEME}://{address}"


# -- Kubernetes' words for the ends of pods

DISRUPTIONS: Final = {
    "DeletionByPodGC": "NodeLost",
    "DeletionByTaintManager": "NodeLost",
    "EvictionByEvictionAPI": "Evicted",
    "PreemptionByScheduler": "Preempted",
    # In the status itself, by the kubelet.
    "Evicted": "Evicted",
    "NodeLost": "NodeLost",
    "NodeShutdown": "NodeLost",
    "Preempting": "Preempted",
    "Shutdown": "NodeLost",
    "Terminated": "NodeLost",
}
"""Kubernetes' reasons for ending a pod, and the words that Fiber shows for them."""

LOST_CONTAINERS: Final = frozenset({"ContainerStatusUnknown", "Unknown"})
"""Reasons of containers that a node lost sight of, for example in a restart.  The exit code of such
a container is made up."""


# -- Words of a status


class ConditionType(StrEnum):
    """Types of ``status.conditions``.

    A new condition needs a member here, a function in the operator's ``planning/status.py``, and a
    row in docs/fiberpools.md (Read its status).
    """

    ACCEPTED = "Accepted"
    """Condition: the operator understands the spec and the API server accepts its pods."""
    READY = "Ready"
    """Condition: as many workers as wanted are ready."""
    PROGRESSING = "Progressing"
    """Condition: pods are being created, waited for, replaced or deleted."""
    DEGRADED = "Degraded"
    """Condition: workers fail or cannot be had; the reason is the worst problem's."""
    MASTER_ALIVE = "MasterAlive"
    """Condition: the master lives. Unknown without a master, or without a Lease."""
    SCALING_LIMITED = "ScalingLimited"
    """Condition: ``replicas`` asks for more than ``maxReplicas``, or for some and fewer than
    ``minReplicas``."""
    SUSPENDED = "Suspended"
    """Condition: ``spec.suspend`` holds the pool at no pods."""


class Phase(StrEnum):
    """Values of ``status.phase``: the conditions in one word, for people. Programs read the
    conditions."""

    PENDING = "Pending"
    """Phase without workers, until the API server has said whether it accepts any."""
    SCALING = "Scaling"
    """Phase in which workers are on their way, or are leaving."""
    READY = "Ready"
    """Phase in which as many workers as wanted are ready, even if that is none."""
    DEGRADED = "Degraded"
    """Phase with a problem that may still pass."""
    FAILED = "Failed"
    """Phase in which no pod is created until the spec changes; problems say why."""
    SUSPENDED = "Suspended"
    TERMINATING = "Terminating"
    """Phase in which the pool is being deleted."""


class Reason(StrEnum):
    """Reasons of problems, conditions and events. The SDK raises those of problems.

    Where Kubernetes has a word for a reason, it is used here.
    """

    # Problems: the spec, or the API server's judgement of it.
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
    """An object of another owner has a name that the pool needs."""
    INVALID_CREDENTIALS = "InvalidCredentials"
    """The pool's Secret is damaged or about to expire."""
    ADDRESS_CHANGED = "AddressChanged"
    """The Service was made anew with another address than the one that workers dial."""
    CREDENTIALS_CHANGED = "CredentialsChanged"
    """The Secret was made anew, and workers hold keys of the old one."""
    INVALID_RELEASE = "InvalidRelease"
    """``scaleDown.release`` names an object that is no pod of this pool."""

    # Problems: pods that do not start.
    INVALID_IMAGE_NAME = "InvalidImageName"
    IMAGE_NEVER_PULL = "ErrImageNeverPull"
    IMAGE_PULL_ERROR = "ImagePullError"
    CONTAINER_CONFIG_ERROR = "CreateContainerConfigError"
    CONTAINER_ERROR = "CreateContainerError"
    RUN_CONTAINER_ERROR = "RunContainerError"
    UNSCHEDULABLE = "Unschedulable"
    STARTUP_TIMEOUT = "StartupTimeout"
    """The worker was not ready for ``failurePolicy.startupTimeoutSeconds``."""

    # Problems: pods that end.
    CONTAINER_FAILED = "ContainerFailed"
    """The worker exited with a code other than 0."""
    OOM_KILLED = "OOMKilled"
    COMPLETED = "Completed"
    """The worker exited with code 0 and was not released."""
    DISRUPTED = "Disrupted"
    """Evicted, preempted, deleted, or its node is gone: replaced, and not counted as a failure."""
    NOT_READY = "NotReady"
    """A pod that was ready is no longer ready."""
    BACKOFF_LIMIT_EXCEEDED = "BackoffLimitExceeded"
    """More than ``failurePolicy.backoffLimit`` failures in a row: no pod is created."""

    # Problems: the master and the API server.
    MASTER_LOST = "MasterLost"
    """The master's Lease has expired."""
    LEASE_NOT_FOUND = "LeaseNotFound"
    """The Lease that ``spec.master.leaseName`` names does not exist yet, or was deleted."""
    API_UNAVAILABLE = "ApiUnavailable"
    """A call of the operator fails: an admission webhook is down, the API server is busy."""

    # Conditions without a problem.
    AS_EXPECTED = "AsExpected"
    NOT_JUDGED = "NotJudged"
    """The API server has not said yet whether it accepts pods of the template."""
    CREATING = "Creating"
    STARTING = "Starting"
    BACKING_OFF = "BackingOff"
    DRAINING = "Draining"
    """More workers are ready than wanted, and only the master knows which are idle."""
    DELETING = "Deleting"
    UPDATING = "Updating"
    """Some pods have an older template."""
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
    RELAY_STARTED = "RelayStarted"
    RELAY_REMOVED = "RelayRemoved"
    SERVED_TWICE = "ServedTwice"
    """Another program writes the pool's status: probably a second operator."""
