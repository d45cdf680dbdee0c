"""Messages of problems and events: what happened, in the cluster's words; why; what to do."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from fiber_api import names
from fiber_api.names import Reason
from fiber_api.rest import ApiError, Forbidden, Invalid
from fiber_api.times import format_time
from fiber_api.v1alpha1 import Failures, FiberPool, MasterSpec
from fiber_operator.planning.documents import items, mapping, text
from fiber_operator.planning.plans import LeaseVerdict, Obstacle, PodRefusal
from fiber_operator.planning.pods import PodView

_SIGNALS = {4: "SIGILL", 6: "SIGABRT", 7: "SIGBUS", 8: "SIGFPE", 9: "SIGKILL", 11: "SIGSEGV"}
_SIGNALS |= {1: "SIGHUP", 2: "SIGINT", 15: "SIGTERM"}


def quoted(words: str) -> str:
    """Return the cluster's words as the end of a clause: a colon and the words, or nothing."""
    words = words.strip().rstrip(".: ")  # a probe that says nothing leaves a colon
    return f": {words}" if words else ""


# -- Pods that do not start

_NOT_STARTING: Mapping[Reason, tuple[str, str]] = {
    Reason.INVALID_IMAGE_NAME: (
        "has an invalid image name",
        "Correct the image in spec.template.",
    ),
    Reason.IMAGE_NEVER_PULL: (
        "has an image that is not on its node, and imagePullPolicy Never forbids fetching it",
        "Load the image onto every node, or change imagePullPolicy in spec.template.",
    ),
    Reason.IMAGE_PULL_ERROR: (
        "cannot get its image",
        "Correct the image, its tag or the imagePullSecrets in spec.template if they are wrong. "
        "If the registry is to blame, wait: the kubelet tries again by itself.",
    ),
    Reason.CONTAINER_CONFIG_ERROR: (
        "has a container that cannot be configured",
        "Create the missing Secret, ConfigMap or key, or correct spec.template. The kubelet tries "
        "again by itself.",
    ),
    Reason.CONTAINER_ERROR: (
        "has a container that cannot be created",
        "Correct spec.template if it is to blame. The kubelet tries again by itself.",
    ),
    Reason.RUN_CONTAINER_ERROR: (
        "has a container that cannot be run",
        "Correct the command in spec.template, or the image.",
    ),
    Reason.CONTAINER_FAILED: (
        "has an init container that fails again and again",
        "Look at its log with kubectl logs --container, and correct spec.template.",
    ),
}

_ROOT = (
    "Workers do not run as root unless the template says so. Give the image a numeric USER, or "
    "set securityContext.runAsUser in spec.template. If the worker must be root, set runAsNonRoot: "
    "false there."
)


def not_starting(reason: Reason, pod: PodView) -> str:
    """Return the message of a pod that the kubelet cannot start."""
    what, remedy = _NOT_STARTING[reason]
    if wants_root(pod):
        remedy = _ROOT
    return f"{pod.name} {what}{quoted(_cluster_words(pod))}. {remedy}"


def _cluster_words(pod: PodView) -> str:
    return ": ".join(filter(None, (pod.reason, pod.message)))


def wants_root(pod: PodView) -> bool:
    """Return True if the pod cannot start because it would run as root."""
    return "runAsNonRoot" in pod.message or "non-root" in pod.message


def unschedulable(pod: PodView) -> str:
    """Return the message of a pod that no node takes."""
    if pod.reason == "SchedulingGated":
        return (
            f"{pod.name} is held back by a scheduling gate{quoted(pod.message)}. The component "
            "that has set schedulingGates, for example a queue, must remove them."
        )
    return (
        f"No node takes {pod.name}{quoted(pod.message)}. Add nodes, wait for a cluster autoscaler "
        "to add some, or request less in spec.template: resources, nodeSelector, affinity."
    )


def stuck(pod: PodView, warning: str) -> str:
    """Return the message of a pod that does not start, with the cause from its events."""
    return (
        f"{pod.name} has a node but does not start{quoted(warning)}. Correct this cause; the "
        "kubelet tries again by itself."
    )


def late(pod: PodView, seconds: int) -> str:
    """Return the message of a pod whose container takes too long to start; the pod is kept."""
    return (
        f"{pod.name} did not become ready in {seconds} s (failurePolicy.startupTimeoutSeconds). "
        f"See what it waits for with kubectl describe pod {pod.name}, or raise the timeout."
    )


def never_ready(pool: FiberPool, pod: PodView, warning: str) -> str:
    """Return the message of a pod that is deleted because it ran too long without being ready."""
    seconds = pool.spec.failure_policy.startup_timeout_seconds
    return (
        f"{pod.name} ran for {seconds} s (failurePolicy.startupTimeoutSeconds) and did not become "
        f"ready{quoted(warning or pod.message)}. It was deleted to free the resources of its "
        "node. Correct the readiness probe in spec.template or what it waits for, or raise the "
        "timeout. To see the next one start: kubectl logs --follow --selector "
        f"{names.LABEL_POOL}={pool.metadata.name}"
    )


def not_ready(pod: PodView) -> str:
    """Return the message of a pod that is no longer ready."""
    return (
        f"{pod.name} was ready and is not ready now{quoted(pod.message or pod.reason)}. If its "
        "node is silent, the pod is replaced when Kubernetes gives the node up. Else see "
        f"kubectl describe pod {pod.name}."
    )


# -- Pods that fail

LAST_LINES = " Its last lines:\n"
"""End of the message of a failure; the worker's output follows."""


def failure(pool: FiberPool, failures: Failures, reason: Reason, pod: PodView) -> str:
    """Return how a worker failed, when it is replaced, and its last lines."""
    wait = _wait(failures)
    own = pod.message and not _ended_by_node(pod) and reason != Reason.RUN_CONTAINER_ERROR
    lines = f"{LAST_LINES}{pod.message}" if own else ""
    return f"{_ending(pool, reason, pod)}{wait}{lines}"


def late_failure(pool: FiberPool, failures: Failures, pod: PodView, warning: str) -> str:
    """Return the message of a late worker that counts as failed, and when it is replaced."""
    return f"{never_ready(pool, pod, warning)}.{_wait(failures)}"


def _wait(failures: Failures) -> str:
    due = failures.next_create_time
    return f" It is not replaced before {format_time(due)}." if due else ""


def forgotten_failure(pool: FiberPool, failures: Failures) -> str:
    """Return the message of a failure whose pod is gone, from the status alone."""
    code = None if failures.last_exit_code is None else f"exit code {failures.last_exit_code}"
    known = ", ".join(filter(None, (failures.last_reason, code)))
    return (
        f"A worker failed{f' ({known})' if known else ''}, and its pod is gone. See the events of "
        f"the pool with kubectl describe fiberpool {pool.metadata.name}."
    )


def completed(pool: FiberPool, failures: Failures, pod: PodView) -> str:
    """Return the message of workers that end by themselves, wave after wave."""
    if pod.reason == "DeadlineExceeded":
        what = f"{pod.name} was ended by activeDeadlineSeconds of spec.template{_after(pod)}"
    else:
        what = f"{pod.name} ended with exit code 0{_after(pod)} and was not released"
    return (
        f"{what}, and so did those before it: {failures.waves} waves in a row. A worker must run "
        f"until it is released, so the container {pool.spec.worker_container!r} must run "
        "python -m fiber.agent. The agent itself ends with 0 after master.lostGraceSeconds without "
        "a master: check that the master can be reached."
        f"{_wait(failures)}"
    )


def _ending(pool: FiberPool, reason: Reason, pod: PodView) -> str:
    if pod.init_container == names.IDENTITY_CONTAINER and reason != Reason.OOM_KILLED:
        return _without_identity(reason, pod)
    if reason == Reason.OOM_KILLED:
        limit = _memory_limit(pool)
        return (
            f"{pod.name} ran out of memory{f' (its limit is {limit})' if limit else ''} and was "
            "killed. Raise resources.limits.memory in spec.template, or let tasks use less."
        )
    if reason == Reason.COMPLETED:
        return (
            f"{pod.name} ended at once with exit code 0. The container "
            f"{pool.spec.worker_container!r} must run python -m fiber.agent: correct its command "
            "in spec.template."
        )
    if reason == Reason.RUN_CONTAINER_ERROR:
        return (
            f"{pod.name} could not be run{quoted(_cluster_words(pod))}. Correct the command in "
            "spec.template, or the image."
        )
    if _ended_by_node(pod):
        return (
            f"{pod.name} failed{quoted(_cluster_words(pod))}. See kubectl describe pod {pod.name}; "
            "correct spec.template if it requests more than a node has."
        )
    return f"{pod.name} {_exit(pod)}. See kubectl logs {pod.name} while the pod is kept."


def _without_identity(reason: Reason, pod: PodView) -> str:
    could_not = reason == Reason.RUN_CONTAINER_ERROR
    what = f"could not be run{quoted(_cluster_words(pod))}" if could_not else _exit(pod)
    return (
        f"The init container {names.IDENTITY_CONTAINER} of {pod.name} {what}. It has the pool's "
        "key and therefore runs the worker's command without the environment, the "
        "working directory and the volumes of spec.template, except a volume whose path is in the "
        "command. Install Fiber in the image, or write its interpreter's path into the command."
    )


def _ended_by_node(pod: PodView) -> bool:
    """Return True if the message comes from the node and not from the worker."""
    return pod.exit_code is None or pod.reason == "Evicted"


def _exit(pod: PodView) -> str:
    code = pod.exit_code or 0
    signal = _SIGNALS.get(code - 128)
    cause = f"exited with code {code}" + (f" ({signal})" if signal else "")
    special = "" if pod.reason in ("Error", "") else f", {pod.reason}"
    return f"{cause}{_after(pod)}{special}"


def _after(pod: PodView) -> str:
    return f" after {pod.ran:.0f} s" if pod.ran else ""


def _memory_limit(pool: FiberPool) -> str:
    containers = items(mapping(pool.spec.template, "spec").get("containers"))
    limits: list[Any] = [
        mapping(container, "resources", "limits").get("memory")
        for container in containers
        if container.get("name") == pool.spec.worker_container
    ]
    return text(limits[0]) if limits else ""


def limit_exceeded(pool: FiberPool, failures: Failures, last: str) -> str:
    """Return the message of a pool that was given up."""
    limit = pool.spec.failure_policy.backoff_limit
    return (
        f"Workers failed in {failures.consecutive} waves in a row, more than "
        f"failurePolicy.backoffLimit ({limit}) allows; fewer than half of the wanted workers had "
        "been ready for a minute. No workers are created until template, processesPerPod, "
        "failurePolicy, update or suspend change in the spec, or a master with a new epoch comes. "
        "Correct the cause and spec.template. To try again without a change, set spec.suspend and "
        f"unset it. The last failure: {last}"
    )


# -- What the API server refuses


def refusal(reason: Reason, refused: PodRefusal) -> str:
    """Return the message of a pod that the API server refuses."""
    what, remedy = _REFUSALS[reason]
    # The refused pod does not exist, and its name differs in each attempt.
    words = _OF_THE_POD.sub("", refused.message)
    if reason == Reason.INVALID_TEMPLATE and _UNKNOWN in words:
        words, remedy = words.replace(_UNKNOWN, f"{_UNKNOWN}spec.template."), _MISSPELT
    elif _LIMIT_RANGE.search(words):
        remedy = _OUT_OF_RANGE
    return f"{what}{quoted(words)}. {remedy}"


_OF_THE_POD = re.compile(
    r'^(pods? "[^"]*" is (forbidden|invalid)|Pod in version "v1" cannot be handled as a Pod'
    r"(: strict decoding error)?): ",
    re.IGNORECASE,
)

_UNKNOWN = 'unknown field "'

_MISSPELT = (
    "The API server ignores a field that it does not know: correct the name or place of the "
    "field, or remove it. The running workers stay as they are."
)

_LIMIT_RANGE = re.compile(
    r"must be less than or equal to \S+ limit|usage per \w+ is |limit to request ratio per "
)
"""Words of the API server if requests and limits contradict each other or a LimitRange."""

_OUT_OF_RANGE = (
    "A limit that spec.template does not set comes from a LimitRange of the namespace: kubectl get "
    "limitranges -o yaml shows its bounds and defaults. Change the LimitRange, or the requests and "
    "limits of the container in spec.template. A program does so with @fiber.meta(cpu=, memory=), "
    "which sets both, or with fiber.init(cpu_request=0, memory_request=0), which requests nothing, "
    "so that the defaults of the LimitRange apply. The running workers stay as they are."
)

_REFUSALS: Mapping[Reason, tuple[str, str]] = {
    Reason.INVALID_TEMPLATE: (
        "The API server refuses pods of this template",
        "Correct spec.template. The running workers stay as they are.",
    ),
    Reason.QUOTA_EXCEEDED: (
        "A quota of the namespace allows no more workers",
        "Lower replicas or the requests of a worker, or raise the ResourceQuota. The operator "
        "tries again by itself.",
    ),
    Reason.REQUESTS_MISSING: (
        "A quota of the namespace counts resources that pods of this template do not request",
        "Add these resources to resources.requests or resources.limits of the container in "
        "spec.template. A program does so with @fiber.meta(cpu=, memory=), which sets both, or "
        "with fiber.init(cpu_request=, memory_request=). A LimitRange of the namespace can give "
        "defaults. The running workers stay as they are.",
    ),
    Reason.FORBIDDEN: (
        "The API server forbids pods of this template",
        "Correct the cause that it names: spec.template, a policy of the namespace, or the rights "
        "of the operator. The running workers stay as they are.",
    ),
}


# -- The pool


def master_lost(pool: FiberPool, since: float, lease: LeaseVerdict) -> str:
    """Return the message of a master whose Lease is not renewed."""
    master = pool.spec.master
    assert master is not None
    what = "did not exist" if lease.missing else "was not renewed"
    end = format_time(since + master.lost_grace_seconds)
    return (
        f"The Lease {master.lease_name} {what} for {master.lease_duration_seconds} s: "
        f"the master at {_whereabouts(master)} has ended or cannot reach the API server. "
        f"{_FATE[pool.spec.on_lost].format(end=end)} Start it again to use this pool."
    )


def no_lease(pool: FiberPool) -> str:
    """Return the message of a Lease that does not exist."""
    master = pool.spec.master
    assert master is not None
    return (
        f"There is no Lease {master.lease_name} in this namespace, so it is not known whether the "
        f"master at {_whereabouts(master)} is alive. After {master.lease_duration_seconds} s "
        "without a Lease the master counts as lost. Create and renew the Lease, or correct "
        "spec.master.leaseName. Without leaseName the master is not checked."
    )


def _whereabouts(master: MasterSpec) -> str:
    where = names.address_of(master.host, master.port)
    return f"{where} ({master.identity}, epoch {master.epoch})"


_FATE = {
    "Delete": "onLost is Delete: the pool is deleted at {end} unless the master comes back.",
    "ScaleToMin": "onLost is ScaleToMin: the pool goes back to minReplicas at {end} unless the "
    "master comes back.",
    "Retain": "onLost is Retain: the workers stay and wait.",
}


def wrong_family(pool: FiberPool, address: str) -> str:
    """Return the message of a master with another IP family than the Service."""
    master = pool.spec.master
    assert master is not None
    return (
        f"The master's address {master.host} and the pool's Service ({address}) have "
        "different IP families, so no worker can reach the master. If the cluster has both, "
        f"delete the Service {names.service_name(pool.metadata.name)}: the operator makes one with "
        "both. Else let the master listen at an address of the Service's family, and write that to "
        "spec.master.host."
    )


def foreign_releases(pool: FiberPool, foreign: list[str]) -> str:
    """Return the message of released names that cannot be pods of the pool."""
    return (
        f"spec.scaleDown.release has names of no worker of this pool: {', '.join(foreign[:3])}. "
        "No pod is deleted for them. The names of workers are "
        f"{pool.metadata.name}-<{names.POD_SUFFIX_LENGTH} hexadecimal digits>."
    )


# -- Failed calls of the API server

_RIGHTS = (
    "Give the operator's account this right, as the chart's roles do, or change the policy or the "
    "quota that forbids it. The operator tries again by itself."
)
_WEBHOOKS = (
    "The operator tries again by itself. If the problem stays, look for an admission webhook for "
    "{what} that is down or slow (kubectl get mutatingwebhookconfigurations,"
    "validatingwebhookconfigurations), and check the API server."
)
_SCHEMA = "Upgrade the CustomResourceDefinition of FiberPools to the operator's release."
_SERVER = "The operator tries again by itself. If the problem stays, check the API server."


def object_obstacle(error: ApiError, what: str) -> Obstacle:
    """Return the obstacle after an object could not be read or created; ``what`` names it."""
    if isinstance(error, Forbidden):
        return _forbidden(error, f"for {what}")
    if isinstance(error, Invalid):
        message = (
            f"The API server refuses to {error.call} for {what}{quoted(error.message)}. The pool "
            "needs this object: change the policy or the webhook that refuses it."
        )
        return Obstacle(Reason.FORBIDDEN, message)
    # A call that changes an object passes admission webhooks.
    writes = not error.call.startswith(("get ", "list ", "watch "))
    remedy = _WEBHOOKS.format(what=error.call.split()[-1]) if writes else _SERVER
    message = (
        f"The call to {error.call} for {what} failed{quoted(error.message)}. Running workers go "
        f"on; no new ones are created meanwhile. {remedy}"
    )
    return Obstacle(Reason.API_UNAVAILABLE, message)


def refused_relay(error: Invalid, name: str) -> Obstacle:
    """Return the obstacle after the API server refused the Deployment of the pool's relay."""
    message = (
        f"The API server refuses the Deployment {name} of the pool's relay{quoted(error.message)}. "
        "The relay's pod is made from spec.template: correct that, or the policy or webhook that "
        "refuses it."
    )
    return Obstacle(Reason.INVALID_TEMPLATE, message)


_RELAY_REFUSALS: Mapping[Reason, tuple[str, str]] = {
    Reason.INVALID_TEMPLATE: (
        "The API server refuses the pod of the relay {name}",
        "The pod is made from spec.template: correct that.",
    ),
    Reason.QUOTA_EXCEEDED: (
        "A quota of the namespace leaves no room for the pod of the relay {name}",
        "Delete objects that are not needed, lower replicas, or raise the ResourceQuota. "
        "Kubernetes tries again by itself.",
    ),
    Reason.REQUESTS_MISSING: (
        "A quota of the namespace counts resources that the pod of the relay {name} does not "
        "request",
        "Add these resources to resources.limits of the worker's container in spec.template: the "
        "relay has a limit where the worker has one. A LimitRange of the namespace can give "
        "defaults.",
    ),
    Reason.FORBIDDEN: (
        "The API server forbids the pod of the relay {name}",
        "Correct the cause that it names: a policy of the namespace, or spec.template, from which "
        "the pod is made.",
    ),
}

_REFUSES = re.compile(r" is (forbidden|invalid): | denied the request")
"""Words of the API server after which the same pod is refused again."""

_NO_RELAY = "Running workers go on; no new ones are created until the relay has its pod."


def refused_relay_pod(words: str, name: str) -> Obstacle:
    """Return the obstacle of a Deployment whose pod is not created; ``words`` say why."""
    if not _REFUSES.search(words):
        message = (
            f"The API server does not create the pod of the relay {name}{quoted(words)}. "
            f"{_NO_RELAY} {_WEBHOOKS.format(what='pods')}"
        )
        return Obstacle(Reason.API_UNAVAILABLE, message)
    refused = PodRefusal("", 422 if " is invalid: " in words else 403, words, 0.0)
    what, remedy = _RELAY_REFUSALS[refused.reason]
    message = f"{what.format(name=name)}{quoted(_OF_THE_POD.sub('', words))}. {remedy} {_NO_RELAY}"
    return Obstacle(refused.reason, message, refused.terminal)


def creation_obstacle(error: ApiError) -> Obstacle:
    """Return the obstacle after a failed creation of a pod."""
    message = (
        f"The API server does not create workers{quoted(error.message)}. Running workers go on. "
        f"{_WEBHOOKS.format(what='pods')}"
    )
    return Obstacle(Reason.API_UNAVAILABLE, message)


def deletion_obstacle(error: ApiError) -> Obstacle:
    """Return the obstacle after a failed deletion."""
    if isinstance(error, Forbidden | Invalid):
        return _forbidden(error, "to delete objects that are not wanted")
    message = (
        f"The call to {error.call} failed{quoted(error.message)}. The unwanted object still "
        f"exists. {_WEBHOOKS.format(what=error.call.split()[-1])}"
    )
    return Obstacle(Reason.API_UNAVAILABLE, message)


def list_obstacle(error: ApiError) -> Obstacle:
    """Return the obstacle after a failed list of pods."""
    blind = "Until then no worker is created or deleted, and the status shows the old numbers."
    if isinstance(error, Forbidden | Invalid):
        return _forbidden(error, "to see the pool's workers", blind)
    message = f"The pool's workers cannot be listed{quoted(error.message)}. {blind} {_SERVER}"
    return Obstacle(Reason.API_UNAVAILABLE, message)


def unreadable_lease(pool: FiberPool, words: str) -> str:
    """Return the message of a Lease that the operator may not read."""
    lease = pool.spec.master.lease_name if pool.spec.master else None
    return (
        f"The operator may not get leases, so it does not see whether the master renews the Lease "
        f"{lease}{quoted(words)}. Until it can, onLost ({pool.spec.on_lost}) is not applied, and "
        f"a pool whose master is gone stays. {_RIGHTS}"
    )


def unwritable_status(error: ApiError) -> str:
    """Return the message of an event that reports that the status cannot be written."""
    remedy = _RIGHTS if isinstance(error, Forbidden) else _SCHEMA
    return (
        f"The status of this pool is out of date, because it cannot be written: {error}. Until it "
        f"can, no pod is created or deleted. {remedy}"
    )


def _forbidden(error: ApiError, purpose: str, effect: str = "") -> Obstacle:
    what = f"The operator may not {error.call}, which it needs {purpose}{quoted(error.message)}."
    return Obstacle(Reason.FORBIDDEN, " ".join(filter(None, (what, effect, _RIGHTS))))
