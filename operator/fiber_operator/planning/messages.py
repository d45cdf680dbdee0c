"""Messages of problems and events: what happened, in the cluster's words; why; what to do."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from fiber_api import names
from fiber_api.names import Reason
from fiber_api.times import format_time
from fiber_api.v1alpha1 import Failures, FiberPool, MasterSpec
from fiber_operator.planning.documents import items, mapping, text
from fiber_operator.planning.plans import LeaseVerdict, Obstacle, PodRefusal
from fiber_operator.planning.pods import PodView
from fiber_operator.responses import ApiError, Invalid, Refused

_SIGNALS = {4: "SIGILL", 6: "SIGABRT", 7: "SIGBUS", 8: "SIGFPE", 9: "SIGKILL", 11: "SIGSEGV"}
_SIGNALS |= {1: "SIGHUP", 2: "SIGINT", 15: "SIGTERM"}


def quoted(words: str) -> str:
    """The cluster's words as the end of a clause."""
    words = words.strip().rstrip(".: ")  # a probe that says nothing leaves a colon
    return f": {words}" if words else ""


# -- Pods that do not start

_NOT_STARTING: Mapping[Reason, tuple[str, str]] = {
    Reason.INVALID_IMAGE_NAME: (
        "has an image name that is none",
        "Correct the image in spec.template.",
    ),
    Reason.IMAGE_NEVER_PULL: (
        "has an image that is not on its node, and imagePullPolicy Never forbids to fetch it",
        "Load the image onto every node, or change imagePullPolicy in spec.template.",
    ),
    Reason.IMAGE_PULL_ERROR: (
        "cannot get its image",
        "If the image, its tag or the imagePullSecrets in spec.template are wrong, correct them; "
        "if the registry is to blame, wait: the kubelet tries again by itself.",
    ),
    Reason.CONTAINER_CONFIG_ERROR: (
        "has a container that cannot be configured",
        "Create the Secret, ConfigMap or key that is missing, upon which the kubelet goes on by "
        "itself, or correct spec.template.",
    ),
    Reason.CONTAINER_ERROR: (
        "has a container that cannot be created",
        "Correct spec.template if it is to blame; the kubelet tries again by itself.",
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
    "set securityContext.runAsUser in spec.template, or runAsNonRoot: false there if it must be "
    "root."
)


def not_starting(reason: Reason, pod: PodView) -> str:
    """A pod that the kubelet cannot start."""
    what, remedy = _NOT_STARTING[reason]
    if wants_root(pod):
        remedy = _ROOT
    return f"{pod.name} {what}{quoted(_said(pod))}. {remedy}"


def _said(pod: PodView) -> str:
    return ": ".join(filter(None, (pod.reason, pod.message)))


def wants_root(pod: PodView) -> bool:
    """Tell whether the pod cannot start because it would be root."""
    return "runAsNonRoot" in pod.message or "non-root" in pod.message


def unschedulable(pod: PodView) -> str:
    """A pod that no node takes."""
    if pod.reason == "SchedulingGated":
        return (
            f"{pod.name} is held back by a scheduling gate{quoted(pod.message)}. What has set "
            "schedulingGates, a queue for instance, must lift them."
        )
    return (
        f"No node takes {pod.name}{quoted(pod.message)}. Add nodes, or wait for a cluster "
        "autoscaler to do so, or ask for less in spec.template: resources, nodeSelector, affinity."
    )


def stuck(pod: PodView, warning: str) -> str:
    """A pod whose status does not say why it does not start, and what its events say."""
    return (
        f"{pod.name} has a node but does not start{quoted(warning)}. Correct what is named "
        "there; the kubelet goes on by itself."
    )


def late(pod: PodView, seconds: int) -> str:
    """A pod whose container takes too long to start; it is kept."""
    return (
        f"{pod.name} did not become ready in {seconds} s (failurePolicy.startupTimeoutSeconds). "
        f"See what it waits for with kubectl describe pod {pod.name}, or allow it more time."
    )


def never_ready(pool: FiberPool, pod: PodView, warning: str) -> str:
    """A pod whose container ran for too long without getting ready; it is deleted."""
    seconds = pool.spec.failure_policy.startup_timeout_seconds
    return (
        f"{pod.name} ran for {seconds} s (failurePolicy.startupTimeoutSeconds) and did not become "
        f"ready{quoted(warning or pod.message)}. It was deleted, since it holds what a node has. "
        "Correct the readiness probe in spec.template or what that waits for, or allow more time. "
        "To see the next one start: kubectl logs --follow --selector "
        f"{names.LABEL_POOL}={pool.metadata.name}"
    )


def not_ready(pod: PodView) -> str:
    """A pod that was ready."""
    return (
        f"{pod.name} was ready and is not any more{quoted(pod.message or pod.reason)}. If its "
        "node is silent it is replaced when Kubernetes gives the node up; else see "
        f"kubectl describe pod {pod.name}."
    )


# -- Pods that fail

LAST_LINES = " Its last lines:\n"
"""Ends what is said of a failure; a worker's own output follows."""


def failure(pool: FiberPool, failures: Failures, reason: Reason, pod: PodView) -> str:
    """Return how a worker failed, when the next one comes, and its last lines."""
    wait = _wait(failures)
    own = pod.message and not _ended_by_node(pod) and reason != Reason.RUN_CONTAINER_ERROR
    lines = f"{LAST_LINES}{pod.message}" if own else ""
    return f"{_ending(pool, reason, pod)}{wait}{lines}"


def late_failure(pool: FiberPool, failures: Failures, pod: PodView, warning: str) -> str:
    """A worker that runs and counts as failed, and when the next one comes."""
    return f"{never_ready(pool, pod, warning)}.{_wait(failures)}"


def _wait(failures: Failures) -> str:
    due = failures.next_create_time
    return f" It is not replaced before {format_time(due)}." if due else ""


def forgotten_failure(pool: FiberPool, failures: Failures) -> str:
    """A failure of which nothing is left but what the status says, if that."""
    code = None if failures.last_exit_code is None else f"exit code {failures.last_exit_code}"
    known = ", ".join(filter(None, (failures.last_reason, code)))
    return (
        f"A worker failed{f' ({known})' if known else ''}, and its pod is gone. See the events of "
        f"the pool with kubectl describe fiberpool {pool.metadata.name}."
    )


def completed(pool: FiberPool, failures: Failures, pod: PodView) -> str:
    """Workers that end of themselves, wave after wave."""
    if pod.reason == "DeadlineExceeded":
        what = f"{pod.name} was ended by activeDeadlineSeconds of spec.template{_after(pod)}"
    else:
        what = f"{pod.name} ended with exit code 0{_after(pod)} and was not released"
    return (
        f"{what}, and so did those before it: {failures.waves} waves in a row. A worker is to "
        f"run until it is released, so the container {pool.spec.worker_container!r} must run "
        "python -m fiber.agent and nothing that ends. The agent itself ends so when it has had no "
        "master for master.lostGraceSeconds: see whether the master can be reached."
        f"{_wait(failures)}"
    )


def _ending(pool: FiberPool, reason: Reason, pod: PodView) -> str:
    if pod.init_container == names.IDENTITY_CONTAINER and reason != Reason.OOM_KILLED:
        return _without_identity(reason, pod)
    if reason == Reason.OOM_KILLED:
        limit = _memory_limit(pool)
        return (
            f"{pod.name} ran out of memory{f' (its limit is {limit})' if limit else ''} and was "
            "killed. Raise resources.limits.memory in spec.template, or let a worker hold less."
        )
    if reason == Reason.COMPLETED:
        return (
            f"{pod.name} ended at once with exit code 0, without having worked. The container "
            f"{pool.spec.worker_container!r} must run python -m fiber.agent: correct its command "
            "in spec.template."
        )
    if reason == Reason.RUN_CONTAINER_ERROR:
        return (
            f"{pod.name} could not be run{quoted(_said(pod))}. Correct the command in "
            "spec.template, or the image."
        )
    if _ended_by_node(pod):
        return (
            f"{pod.name} failed{quoted(_said(pod))}. See kubectl describe pod {pod.name}; correct "
            "spec.template if it asks for what a node cannot give."
        )
    return f"{pod.name} {_exit(pod)}. See kubectl logs {pod.name} while the pod is kept."


def _without_identity(reason: Reason, pod: PodView) -> str:
    could_not = reason == Reason.RUN_CONTAINER_ERROR
    what = f"could not be run{quoted(_said(pod))}" if could_not else _exit(pod)
    return (
        f"The init container {names.IDENTITY_CONTAINER} of {pod.name} {what}. It has the pool's "
        "key, and runs the worker's command on the image alone: without environment, working "
        "directory and volumes of spec.template, but for a volume whose path the command names. "
        "Install Fiber in the image, or name its interpreter by its path in the command."
    )


def _ended_by_node(pod: PodView) -> bool:
    """Tell whether the message is the node's, not the worker's."""
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
    """Return the message of a pool that creates no more pods."""
    limit = pool.spec.failure_policy.backoff_limit
    return (
        f"{failures.consecutive} waves of failures in a row, while fewer than half of the workers "
        f"wanted were ready for a minute, are more than failurePolicy.backoffLimit allows ({limit})"
        ": no more workers are created until the spec changes, in template, processesPerPod, "
        "failurePolicy, update or suspend, or by a master with a new epoch. "
        "Correct the cause and spec.template, or set spec.suspend and unset it to try again as it "
        f"is. The last one: {last}"
    )


# -- What the API server refuses


def refusal(reason: Reason, refused: PodRefusal) -> str:
    """A pod that the API server does not take."""
    what, remedy = _REFUSALS[reason]
    # The pod that it names never was, and is called differently at each attempt.
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
    "A field that the API server does not know has no effect: correct its name or its place, or "
    "leave it out; the running workers stay as they are."
)

_LIMIT_RANGE = re.compile(
    r"must be less than or equal to \S+ limit|usage per \w+ is |limit to request ratio per "
)
"""Words of the API server if requests and limits do not fit each other, or a LimitRange."""

_OUT_OF_RANGE = (
    "A limit that spec.template does not set comes from a LimitRange of the namespace: kubectl get "
    "limitranges -o yaml shows its bounds and defaults. Change the LimitRange, or the requests and "
    "limits of the container in spec.template. A program does so with @fiber.meta(cpu=, memory=), "
    "which sets both, or with fiber.init(cpu_request=0, memory_request=0), which requests nothing, "
    "so that the defaults of the LimitRange hold. The running workers stay as they are."
)

_REFUSALS: Mapping[Reason, tuple[str, str]] = {
    Reason.INVALID_TEMPLATE: (
        "The API server refuses pods of this template",
        "Correct spec.template; the running workers stay as they are.",
    ),
    Reason.QUOTA_EXCEEDED: (
        "A quota of the namespace allows no more workers",
        "Lower replicas or what a worker asks for, or raise the ResourceQuota; the operator tries "
        "again by itself.",
    ),
    Reason.REQUESTS_MISSING: (
        "A quota of the namespace counts what pods of this template do not ask for",
        "Write what it names into resources.requests or resources.limits of the container in "
        "spec.template. A program does so with @fiber.meta(cpu=, memory=), which sets both, or "
        "with fiber.init(cpu_request=, memory_request=). A LimitRange of the namespace can give "
        "defaults. The running workers stay as they are.",
    ),
    Reason.FORBIDDEN: (
        "The API server forbids pods of this template",
        "Correct what it names: the spec.template, the policy of the namespace, or the rights of "
        "the operator. The running workers stay as they are.",
    ),
}


# -- The pool


def master_lost(pool: FiberPool, since: float, lease: LeaseVerdict) -> str:
    """A Lease that is not renewed."""
    master = pool.spec.master
    assert master is not None
    what = "was not there" if lease.missing else "was not renewed"
    end = format_time(since + master.lost_grace_seconds)
    return (
        f"The Lease {master.lease_name} {what} for {master.lease_duration_seconds} s: "
        f"the master at {_whereabouts(master)} has ended or cannot reach the API server. "
        f"{_FATE[pool.spec.on_lost].format(end=end)} Start it again to go on with this pool."
    )


def no_lease(pool: FiberPool) -> str:
    """A Lease that is not there yet, or not any more."""
    master = pool.spec.master
    assert master is not None
    return (
        f"There is no Lease {master.lease_name} in this namespace, so nobody can tell whether the "
        f"master at {_whereabouts(master)} is alive. If it is not there for "
        f"{master.lease_duration_seconds} s, that master counts as lost. Create it and renew it, "
        "or correct spec.master.leaseName; without leaseName the master is not checked."
    )


def _whereabouts(master: MasterSpec) -> str:
    where = names.address_of(master.host, master.port)
    return f"{where} ({master.identity}, epoch {master.epoch})"


_FATE = {
    "Delete": "onLost is Delete: the pool is deleted at {end} unless it comes back.",
    "ScaleToMin": "onLost is ScaleToMin: the pool goes back to minReplicas at {end} unless it "
    "comes back.",
    "Retain": "onLost is Retain: the workers stay and wait.",
}


def wrong_family(pool: FiberPool, address: str) -> str:
    """A master that the Service cannot lead to."""
    master = pool.spec.master
    assert master is not None
    return (
        f"The master's address {master.host} and the pool's Service ({address}) are not of the "
        "same IP family, so that no worker can reach the master. In a cluster of both families, "
        f"delete the Service {names.service_name(pool.metadata.name)}: the operator makes one of "
        "both. Else let the master listen at an address of the Service's family and write that in "
        "spec.master.host."
    )


def foreign_releases(pool: FiberPool, foreign: list[str]) -> str:
    """Names that can be no pods of the pool."""
    return (
        f"spec.scaleDown.release names what is no worker of this pool: {', '.join(foreign[:3])}. "
        "Nothing is deleted for these. Workers are called "
        f"{pool.metadata.name}-<{names.POD_SUFFIX_LENGTH} hexadecimal digits>."
    )


# -- Failed calls of the API server

_RIGHTS = (
    "Give the operator's account this right, as the chart's roles do, or change the policy or the "
    "quota that forbids it; the operator tries again by itself."
)
_WEBHOOKS = (
    "The operator tries again by itself. If this stays, look for an admission webhook for {what} "
    "that is down or slow (kubectl get mutatingwebhookconfigurations,"
    "validatingwebhookconfigurations), and at the API server itself."
)
_SCHEMA = "Bring the CustomResourceDefinition of FiberPools to the operator's release."
_SERVER = "The operator tries again by itself; if this stays, look at the API server."


def object_obstacle(error: ApiError, what: str) -> Obstacle:
    """An object that the pool needs could not be had; ``what`` names it."""
    if isinstance(error, Refused):
        return _forbidden(error, f"for {what}")
    if isinstance(error, Invalid):
        message = (
            f"The API server refuses to {error.call} for {what}{quoted(error.message)}. The pool "
            "needs it: remove what refuses it, a policy or a webhook for instance."
        )
        return Obstacle(Reason.FORBIDDEN, message)
    remedy = _WEBHOOKS.format(what=error.call.split()[-1]) if error.writes else _SERVER
    message = (
        f"The call to {error.call} for {what} failed{quoted(error.message)}. Workers that run go "
        f"on; none is made meanwhile. {remedy}"
    )
    return Obstacle(Reason.API_UNAVAILABLE, message)


def creation_obstacle(error: ApiError) -> Obstacle:
    """Return the obstacle after a failed creation of a pod."""
    message = (
        f"The API server does not make workers{quoted(error.message)}. Those that run go on. "
        f"{_WEBHOOKS.format(what='pods')}"
    )
    return Obstacle(Reason.API_UNAVAILABLE, message)


def deletion_obstacle(error: ApiError) -> Obstacle:
    """Return the obstacle after a failed deletion."""
    if isinstance(error, Refused | Invalid):
        return _forbidden(error, "to remove what is not wanted any more")
    message = (
        f"The call to {error.call} failed{quoted(error.message)}, and what is not wanted any more "
        f"is still there. {_WEBHOOKS.format(what=error.call.split()[-1])}"
    )
    return Obstacle(Reason.API_UNAVAILABLE, message)


def list_obstacle(error: ApiError) -> Obstacle:
    """Return the obstacle after a failed list of pods."""
    blind = "Until they are known none is made or deleted, and the numbers are those of before."
    if isinstance(error, Refused | Invalid):
        return _forbidden(error, "to see the pool's workers", blind)
    message = f"The pool's workers cannot be listed{quoted(error.message)}. {blind} {_SERVER}"
    return Obstacle(Reason.API_UNAVAILABLE, message)


def unreadable_lease(pool: FiberPool, words: str) -> str:
    """Return the words for a Lease that cannot be read."""
    lease = pool.spec.master.lease_name if pool.spec.master else None
    return (
        f"The operator may not get leases, so that nobody sees whether the master renews the Lease "
        f"{lease}{quoted(words)}. Until then onLost ({pool.spec.on_lost}) is never applied"
        f", and a pool whose master is gone stays. {_RIGHTS}"
    )


def unwritable_status(error: ApiError) -> str:
    """The status cannot be written; an event is all that is left to tell it."""
    remedy = _RIGHTS if isinstance(error, Refused) else _SCHEMA
    return (
        f"What the status of this pool says is out of date: {error}. Nothing is made or deleted "
        f"until it can be written. {remedy}"
    )


def _forbidden(error: ApiError, purpose: str, effect: str = "") -> Obstacle:
    what = f"The operator may not {error.call}, which it needs {purpose}{quoted(error.message)}."
    return Obstacle(Reason.FORBIDDEN, " ".join(filter(None, (what, effect, _RIGHTS))))
