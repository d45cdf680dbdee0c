"""Views of pods with the facts that the planner needs.

A pod comes as the API's JSON, in which any field may be missing or have the wrong type.  The
fields of a ``PodView`` always have their types.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from fiber_api import names
from fiber_operator.planning.documents import items, mapping, seconds, text, whole

BRIEF = 10.0
"""Seconds.  A worker that ends sooner never did its job, with any exit code."""

PROBE_PROGRAM = f"{names.CREDENTIALS_DIRECTORY}/{names.PROBE_PROGRAM}"
"""Command by which a worker's startup probe is recognized as the operator's."""

LONGEST_MESSAGE = 1000
"""Characters that are kept from the end of a message.  A traceback has its cause at the end."""


class PodState(StrEnum):
    """State of a pod.  All are live except ``TERMINATING`` and ``ENDED``."""

    PENDING = "Pending"
    """The worker container does not run yet."""
    STARTING = "Starting"
    """The container runs, and the pod has never been Ready."""
    READY = "Ready"
    NOT_READY = "NotReady"
    """The pod was Ready and is not now: its node is silent, or a probe fails."""
    TERMINATING = "Terminating"
    """The pod is being deleted."""
    ENDED = "Ended"
    """The phase is Failed or Succeeded, or the worker container has ended for good."""


class Trouble(StrEnum):
    """Trouble of a pod, by its consequence."""

    DISRUPTED = "Disrupted"
    """The cluster ended the pod: replaced at once, not counted as a failure."""
    COMPLETED = "Completed"
    """The worker ended with exit code 0 after it had worked: replaced like a failed one, but no
    reason to give up the pool."""
    APPLICATION = "Application"
    """The worker failed or ended at once: counted, and replaced after a delay."""
    CANNOT_START = "CannotStart"
    """The image or the configuration is wrong.  The kubelet retries, so the pod is kept."""
    UNSCHEDULABLE = "Unschedulable"
    """No node takes the pod now.  The scheduler retries, so the pod is kept."""


@dataclass(frozen=True, slots=True)
class PodView:
    """View of a pod.  Times are unix seconds as the cluster wrote them; 0.0 if there is none."""

    name: str
    uid: str
    resource_version: str
    owner: str
    """Uid of the controller that owns the pod; empty if there is none."""
    created: float
    template_hash: str
    state: PodState
    since: float
    """Time at which the pod came into this state, as far as the cluster says.  For TERMINATING: the
    end of the grace period, which may be in the future."""
    was_ready: bool = False
    """True if the pod is or was Ready, as far as its conditions tell."""
    joining: bool = False
    """True if the pod runs and its agent has not reached a master yet.  Only the status shows it;
    plans count such a pod as ``READY``."""
    trouble: Trouble | None = None
    reason: str = ""
    """Cluster's word for the trouble: ``ErrImagePull``, ``OOMKilled``, ``Evicted``."""
    message: str = ""
    """Message of the kubelet or the scheduler, or the worker's last lines."""
    exit_code: int | None = None
    ran: float = 0.0
    """Seconds that the worker container ran, once it has ended."""
    scheduled: bool = False
    """True if the pod has a node."""
    lingers: bool = False
    """True if the worker has ended and other containers of the pod have not."""
    deletion_cost: int = 0
    address: str = ""
    """Address that the agent dials; empty if the pod does not state one."""
    init_container: str = ""
    """Init container that failed, so that the worker never ran; empty if none failed."""

    @property
    def live(self) -> bool:
        """True if the pod counts as a replica."""
        return self.state not in (PodState.TERMINATING, PodState.ENDED)


def observe(pod: Mapping[str, Any], container: str) -> PodView:
    """Return the view of ``pod``, judged by the container of that name.  Never raises."""
    return _Observation(pod, container).view()


def worker_container(pod: Mapping[str, Any]) -> str:
    """Return the name of the container with the agent: the one that knows where to dial."""
    dialing = [
        text(container.get("name"))
        for container in items(mapping(pod, "spec").get("containers"))
        if any(
            variable.get("name") == names.ENV_ADDRESS for variable in items(container.get("env"))
        )
    ]
    if dialing and names.WORKER_CONTAINER not in dialing:
        return dialing[0]
    return names.WORKER_CONTAINER


# The kubelet's reasons for a container that cannot start.  The kubelet goes on trying.
_CANNOT_START = frozenset(
    {
        "CrashLoopBackOff",  # in a worker's pod only a restartable init container can have it
        "CreateContainerConfigError",
        "CreateContainerError",
        "ErrImageNeverPull",
        "ErrImagePull",
        "ImageInspectError",
        "ImagePullBackOff",
        "InvalidImageName",
        "PostStartHookError",
        "PreCreateHookError",
        "PreStartHookError",
        "RegistryUnavailable",
        "RunContainerError",
        "SignatureValidationFailed",
    }
)


class _Observation:
    """Observation of one pod."""

    def __init__(self, pod: Mapping[str, Any], container: str) -> None:
        self._meta = mapping(pod, "metadata")
        self._status = mapping(pod, "status")
        self._conditions = {
            text(condition.get("type")): condition
            for condition in items(self._status.get("conditions"))
        }
        statuses = {text(s.get("name")): s for s in items(self._status.get("containerStatuses"))}
        self._own = mapping(statuses.get(container))
        self._state = mapping(self._own, "state")
        self._others = [s for name, s in statuses.items() if name != container]
        self._init = list(items(self._status.get("initContainerStatuses")))
        self._end = _end(self._state)
        self._worker = next(
            (
                found
                for found in items(mapping(pod, "spec").get("containers"))
                if found.get("name") == container
            ),
            {},
        )
        self._scheduled = bool(text(mapping(pod, "spec").get("nodeName")))
        self._phase = text(self._status.get("phase"))
        self._created = seconds(self._meta.get("creationTimestamp"))

    def view(self) -> PodView:
        """Return the view."""
        state = self._pod_state()
        trouble, reason, message = self._trouble(state)
        return PodView(
            name=text(self._meta.get("name")),
            uid=text(self._meta.get("uid")),
            resource_version=text(self._meta.get("resourceVersion")),
            owner=self._owner(),
            created=self._created,
            template_hash=text(mapping(self._meta, "labels").get(names.LABEL_TEMPLATE_HASH)),
            state=state,
            since=self._since(state),
            was_ready=self._was_ready(),
            joining=state is PodState.READY and self._is_joining(),
            trouble=trouble,
            reason=reason,
            message=_shorten(message),
            exit_code=_exit_code(self._ending()),
            ran=self._ran(),
            scheduled=self._scheduled,
            lingers=state is PodState.ENDED and self._others_go_on(),
            deletion_cost=self._deletion_cost(),
            address=self._address(),
            init_container="" if self._end else text(self._failed_init().get("name")),
        )

    # The state

    def _pod_state(self) -> PodState:
        if self._meta.get("deletionTimestamp"):
            return PodState.TERMINATING
        if self._phase in ("Failed", "Succeeded") or self._end:
            return PodState.ENDED
        if self._ready():
            return PodState.READY
        if not isinstance(self._state.get("running"), Mapping):
            return PodState.PENDING
        return PodState.NOT_READY if self._was_ready() else PodState.STARTING

    def _ready(self) -> bool:
        return self._condition("Ready").get("status") == "True" or self._is_joining()

    def _is_joining(self) -> bool:
        return (
            self._condition("Ready").get("status") == "False"
            and isinstance(self._state.get("running"), Mapping)
            and _awaits_its_agent(self._worker, self._own)
            and all(other.get("ready") is True for other in self._others)
        )

    def _was_ready(self) -> bool:
        # The kubelet writes "not Ready" when it takes the pod, before any container runs.  A later
        # change to "not Ready" means that the pod was Ready in between.
        if self._ready():
            return True
        running = self._state.get("running")
        if isinstance(running, Mapping) and self._condition("Ready").get("status") != "False":
            return True  # not known: the pod must not count as one that never worked
        started = seconds(mapping(running or self._end).get("startedAt"))
        return 0 < started < seconds(self._condition("Ready").get("lastTransitionTime"))

    def _since(self, state: PodState) -> float:
        if state is PodState.TERMINATING:
            return seconds(self._meta.get("deletionTimestamp")) or self._created
        if state is PodState.ENDED:
            ended = seconds(self._ending().get("finishedAt"))
            return ended or self._changed("Ready") or self._created
        if state in (PodState.READY, PodState.NOT_READY) and not self._is_joining():
            return self._changed("Ready") or self._created
        if state in (PodState.READY, PodState.STARTING):
            started = seconds(mapping(self._state, "running").get("startedAt"))
            return started or self._created
        return self._created

    def _ending(self) -> Mapping[str, Any]:
        """Return the end of the worker or, if it never ran, of the init container that failed."""
        if self._end:
            return self._end
        return _end(self._failed_init().get("state"))

    def _failed_init(self) -> Mapping[str, Any]:
        return next((s for s in self._init if _exit_code(_end(s.get("state")))), {})

    def _ran(self) -> float:
        start, finish = seconds(self._end.get("startedAt")), seconds(self._end.get("finishedAt"))
        return max(0.0, finish - start) if start else 0.0

    def _others_go_on(self) -> bool:
        # The kubelet updates the phase up to a second after the last container's end.
        over = all(_end(status.get("state")) for status in self._others)
        return not over and self._phase not in ("Failed", "Succeeded")

    # The trouble

    def _trouble(self, state: PodState) -> tuple[Trouble | None, str, str]:
        if state is PodState.ENDED:
            return self._why_ended()
        if state is PodState.PENDING:
            return self._why_pending()
        if state in (PodState.STARTING, PodState.NOT_READY):
            condition = self._condition("Ready")
            return None, text(condition.get("reason")), text(condition.get("message"))
        if state is PodState.TERMINATING and self._disruption():
            return Trouble.DISRUPTED, *self._disruption_words()
        return None, "", ""

    def _why_pending(self) -> tuple[Trouble | None, str, str]:
        for status in self._containers():
            waiting = mapping(status, "state", "waiting")
            if (reason := text(waiting.get("reason"))) in _CANNOT_START:
                return Trouble.CANNOT_START, reason, text(waiting.get("message"))
        scheduled = self._condition("PodScheduled")
        if scheduled.get("status") == "False" and not self._scheduled:
            reason = text(scheduled.get("reason")) or "Unschedulable"
            return Trouble.UNSCHEDULABLE, reason, text(scheduled.get("message"))
        return None, "", ""

    def _why_ended(self) -> tuple[Trouble, str, str]:
        end = self._ending()
        reason, message = text(self._status.get("reason")), text(self._status.get("message"))
        if self._exceeded_own_limit():
            return Trouble.APPLICATION, reason, message
        lost = text(end.get("reason")) in names.LOST_CONTAINERS
        if self._disruption() or reason in names.DISRUPTIONS or lost:
            return Trouble.DISRUPTED, *self._disruption_words()
        if reason and not end:
            # The node refused the pod (OutOfcpu, UnexpectedAdmissionError, ...) and may refuse the
            # next one, so such pods are replaced after a delay.
            return Trouble.APPLICATION, reason, message
        return self._by_exit_code(end)

    def _by_exit_code(self, end: Mapping[str, Any]) -> tuple[Trouble, str, str]:
        # An ended pod without an exit code was lost with its node's records.
        if not end and self._phase != "Succeeded":
            return Trouble.DISRUPTED, "", text(self._status.get("message"))
        message = text(end.get("message"))
        if self._status.get("reason") == "DeadlineExceeded":
            reason, by_order = "DeadlineExceeded", True  # the template's activeDeadlineSeconds
        else:
            reason, by_order = text(end.get("reason")), whole(end.get("exitCode")) == 0
        if by_order and self._ran() >= BRIEF:
            return Trouble.COMPLETED, reason or "Completed", message
        return Trouble.APPLICATION, reason or "Error", message

    def _exceeded_own_limit(self) -> bool:
        # The pod itself caused the eviction: the next one would do so again.
        message = text(self._status.get("message"))
        return (
            self._status.get("reason") == "Evicted"
            and not self._disruption()
            and ("exceeds the" in message or "exceeded its" in message)
        )

    def _disruption(self) -> bool:
        return self._condition("DisruptionTarget").get("status") == "True"

    def _disruption_words(self) -> tuple[str, str]:
        condition = self._condition("DisruptionTarget")
        reason = text(self._status.get("reason")) or text(condition.get("reason"))
        message = text(self._status.get("message")) or text(condition.get("message"))
        end = self._ending()
        cause = text(end.get("reason"))
        # The message of any other end is the worker's output, which does not say what ended it.
        words = text(end.get("message")) if cause in names.LOST_CONTAINERS else ""
        return reason or cause, message or words

    # Fields

    def _condition(self, kind: str) -> Mapping[str, Any]:
        return self._conditions.get(kind, {})

    def _changed(self, kind: str) -> float:
        return seconds(self._condition(kind).get("lastTransitionTime"))

    def _containers(self) -> Iterator[Mapping[str, Any]]:
        yield {"state": self._state}
        yield from self._init
        yield from self._others

    def _owner(self) -> str:
        owners = items(self._meta.get("ownerReferences"))
        return next((text(o.get("uid")) for o in owners if o.get("controller") is True), "")

    def _address(self) -> str:
        variables = items(self._worker.get("env"))
        return next(
            (text(v.get("value")) for v in variables if v.get("name") == names.ENV_ADDRESS), ""
        )

    def _deletion_cost(self) -> int:
        cost = text(mapping(self._meta, "annotations").get(names.ANNOTATION_DELETION_COST))
        try:
            return int(cost or "0")
        except ValueError:
            return 0  # Kubernetes ignores it, too


def _end(state: object) -> Mapping[str, Any]:
    """Return the end of a container; empty if it runs or if its exit code is not known."""
    end = mapping(state, "terminated")
    return end if _exit_code(end) is not None else {}


def _exit_code(end: Mapping[str, Any]) -> int | None:
    code = end.get("exitCode")
    known = isinstance(code, int) and not isinstance(code, bool) and abs(code) < 2**31
    return code if known else None


def _shorten(message: str) -> str:
    message = message.strip()
    return message if len(message) <= LONGEST_MESSAGE else "..." + message[-LONGEST_MESSAGE:]


def _awaits_its_agent(worker: Mapping[str, Any], status: Mapping[str, Any]) -> bool:
    """Return True if the container with this status only waits for its agent's link."""
    if status.get("started") is not False or worker.get("readinessProbe"):
        return False
    command = mapping(worker, "startupProbe", "exec").get("command")
    return isinstance(command, list) and bool(command) and text(command[0]) == PROBE_PROGRAM
