"""Problems of FiberPools and ends of pods, in sentences for the user of the program.

* Functions over a FiberPool's status: which problems are new, whether they are terminal, a summary.
* ``pod_end``: why a pod ended, from its document.
* ``Reporter``: warns of a problem once while it lasts.
"""

from __future__ import annotations

import contextlib
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from fiber._backends.kubernetes.published import install_command
from fiber._transport.loop import Loop
from fiber.errors import FiberPoolError
from fiber_api import names
from fiber_api.names import ConditionType, Reason
from fiber_api.rest import (
    ApiError,
    Forbidden,
    Invalid,
    NotFound,
    NotServed,
    ServerError,
    ServerUnreachable,
    TooManyRequests,
    Transient,
    Unauthorized,
)
from fiber_api.times import parse_time

Status = Mapping[str, Any]
"""Status of a FiberPool, as the API has it: any part may be absent."""


class PoolName(NamedTuple):
    """Name of a FiberPool."""

    name: str
    namespace: str

    def __str__(self) -> str:
        return f"the FiberPool {self.name!r} in namespace {self.namespace!r}"

    def error(self, message: str, reason: str) -> FiberPoolError:
        """Return an error of this pool."""
        return FiberPoolError(
            f"{self}: {message}", pool=self.name, namespace=self.namespace, reason=str(reason)
        )


class AgentRoute(NamedTuple):
    """Route of agents to this program."""

    address: str
    """``host:port`` that the pool's Service leads to."""
    displaced: str = ""
    """Identity of the lost master that this program took the pool from."""
    relay: str = ""
    """Name of the relay's Deployment, if agents connect to a relay."""

    @property
    def advice(self) -> str:
        """Reasons why agents do not arrive, and remedies."""
        if self.relay:
            return (
                "Pods cannot connect to the relay, or the relay has ended: see `kubectl logs "
                f"deployment/{self.relay}`, and allow connections of the pool's pods to port "
                f"{names.MASTER_PORT} of the pods with the label {names.LABEL_RELAY} if a "
                "NetworkPolicy is in between"
            )
        others = (
            f". Or the pods still serve {self.displaced}, the master before, which does not renew "
            "its Lease: end that program"
            if self.displaced
            else ""
        )
        return (
            "Pods cannot connect to that address: it is behind NAT, or a firewall or a "
            "NetworkPolicy is in between. Set relay='auto' (FIBER_RELAY=auto), run the program in "
            "a pod of the cluster, or set listen_host (FIBER_LISTEN_HOST) to an address of this "
            "machine that pods reach, or advertised_host (FIBER_ADVERTISED_HOST) to one that is "
            f"forwarded to it, or allow the connection{others}"
        )


# ---- warnings -------------------------------------------------------------------------------


def new_problems(pool: PoolName, before: Status, status: Status) -> Iterator[str]:
    """Yield a sentence for each problem that ``before`` did not have, or only as a warning."""
    known = {(problem.get("reason"), problem.get("severity")) for problem in _problems(before)}
    for problem in _problems(status):
        reason = problem.get("reason")
        if not known & {(reason, problem.get("severity")), (reason, "Error")}:
            count = problem.get("count", 1)
            many = f" ({count} pods)" if problem.get("pod") and count > 1 else ""
            yield f"{pool}: {reason}{many}: {problem.get('message', '')}"


# ---- errors that end the wait ---------------------------------------------------------------

_NEEDS_A_PERSON = frozenset(
    {
        Reason.CONTAINER_CONFIG_ERROR,
        Reason.CONTAINER_ERROR,
        Reason.FORBIDDEN,
        Reason.IMAGE_PULL_ERROR,
        Reason.QUOTA_EXCEEDED,
        Reason.REQUESTS_MISSING,
        Reason.UNSCHEDULABLE,
    }
)
"""Reasons that pass only after a person changes something.  At other errors the operator tries
again, and marks them as terminal when it gives up."""


def running(status: Status) -> int:
    """Return how many pods run, ready or not.  A pod whose agent is not linked is never ready."""
    return max(0, (status.get("replicas") or 0) - (status.get("pendingReplicas") or 0))


def failure(pool: PoolName, status: Status, joined: int) -> FiberPoolError | None:
    """Return the error for which no worker will come; None if workers may come.

    A pool with ``joined`` workers, or with pods that run, has none: it works with these.
    """
    if joined or running(status):
        return None
    if _is_true(status, ConditionType.SUSPENDED):
        return pool.error(
            "it is suspended, so it has no workers. Set spec.suspend to false, or use another "
            "pool.",
            Reason.SUSPENDED,
        )
    for problem in _problems(status):
        if problem.get("terminal") or _concerns_all(problem, status):
            return pool.error(_reason_and_message(problem), problem["reason"])
    return None


def overdue(
    pool: PoolName, status: Status, waited: float, now: float, way: AgentRoute
) -> FiberPoolError:
    """Return the error for no worker in time.  ``now`` is in unix seconds."""
    worst = next(_problems(status), None)
    why = f"{way.advice}." if running(status) else ""
    if not why and worst is not None:
        why = _reason_and_message(worst)
    return pool.error(
        f"no worker has joined after {waited:g} s: {summary(status, now)}. {why}".rstrip()
        + f" See kubectl describe fiberpool {pool.name} --namespace {pool.namespace}, or allow "
        "more time (pod_timeout).",
        "StartTimeout" if worst is None else worst["reason"],
    )


def unreachable(pool: PoolName, status: Status, waited: float, way: AgentRoute) -> FiberPoolError:
    """Return the error for running pods whose agents do not dial."""
    number = running(status)
    pods = f"its {number} running pods" if number != 1 else "its running pod"
    return pool.error(
        f"no agent of {pods} has reached this program at {way.address} within {waited:.0f} s. "
        f"{way.advice}",
        "Unreachable",
    )


def _concerns_all(problem: Mapping[str, Any], status: Status) -> bool:
    """Return whether a problem is an error of every pod that only a person can mend."""
    if problem.get("severity") != "Error" or problem.get("reason") not in _NEEDS_A_PERSON:
        return False
    replicas = status.get("replicas") or 0
    return problem.get("count", 1) >= replicas if problem.get("pod") else not replicas


def _reason_and_message(problem: Mapping[str, Any]) -> str:
    return f"{problem.get('reason')}: {problem.get('message', '')}"


# ---- summary in one line --------------------------------------------------------------------

_SCHEDULER = re.compile(r"\d+/\d+ nodes are available: (?:[^.\n]|\.(?! ))+")

_LONGEST_CAUSE = 120


def summary(status: Status, now: float) -> str:
    """Return the number of pods and the main problem: ``12 of 50 pods ready, 30 pending:
    0/3 nodes are available: insufficient cpu (for 14 s)``.  ``now`` is in unix seconds.
    """
    if "observedGeneration" not in status:
        return "the operator has not looked at it yet"
    wanted, ready = status.get("desiredReplicas") or 0, status.get("readyReplicas") or 0
    parts = [f"{ready} of {wanted} pods ready"]
    if pending := status.get("pendingReplicas"):
        parts.append(f"{pending} pending")
    worst = next(_problems(status), None)
    return ", ".join(parts) + ("" if worst is None else f": {_cause(worst, now)}")


def _cause(problem: Mapping[str, Any], now: float) -> str:
    message = str(problem.get("message", ""))
    # The summary has the scheduler's words only, without those of the operator around them.
    scheduler = _SCHEDULER.search(message)
    cause = scheduler[0] if scheduler else f"{problem.get('reason')}: {message}"
    cause = cause.partition("\n")[0].partition(". ")[0].rstrip(".")
    if len(cause) > _LONGEST_CAUSE:
        cause = cause[: _LONGEST_CAUSE - 3] + "..."
    try:
        seconds = max(0.0, now - parse_time(str(problem.get("since"))))
    except ValueError:
        return cause
    return f"{cause} (for {seconds:.0f} s)"


_OF_THE_MASTER = frozenset({Reason.LEASE_NOT_FOUND, Reason.MASTER_LOST})
"""Reasons that are false, as this program lives and renews the Lease.  The operator may have looked
between two steps of an attachment, or while the program was stopped."""


def _problems(status: Status) -> Iterator[Mapping[str, Any]]:
    """Yield the problems, the worst first, as the operator sorted them."""
    for problem in status.get("problems") or ():
        if problem.get("reason") not in _OF_THE_MASTER:
            yield problem


def _is_true(status: Status, kind: ConditionType) -> bool:
    conditions = status.get("conditions") or ()
    return any(c.get("type") == kind and c.get("status") == "True" for c in conditions)


class PodEnd(NamedTuple):
    """End of a pod, for ``ExitReport`` and ``WorkerDied``."""

    reason: str
    """Reason in one word, a colon, and details: ``OOMKilled: its memory limit is 512Mi``."""
    node: str
    """Node of the pod; empty if it never had one."""
    exitcode: int | None = None
    """Exit code as in multiprocessing; None if it is unknown."""
    disrupted: bool = False
    """True if the cluster ended the pod."""


def pod_end(pod: Mapping[str, Any], container: str = names.WORKER_CONTAINER) -> PodEnd | None:
    """Return how ``pod`` ended or is ending; None if Kubernetes reports no end.

    The cause of the pod's end goes before the exit codes that follow from it.
    """
    status = pod.get("status") or {}
    worker = _ended(status, container)
    own = _out_of_memory(pod, worker, container) or _own_excess(status)
    disruption = None if own else _disruption(pod) or _deletion(pod) or _lost_container(worker)
    reason = own or disruption or _own_end(status, worker)
    if reason is None:
        return None
    return PodEnd(reason, node_of(pod), _exitcode(worker), disruption is not None)


def node_of(pod: Mapping[str, Any]) -> str:
    """Return the name of the pod's node; empty while it has none."""
    return str((pod.get("spec") or {}).get("nodeName") or "")


def _ended(status: Mapping[str, Any], container: str) -> Mapping[str, Any]:
    """Return the end of the container of that name; empty while it runs."""
    for found in status.get("containerStatuses") or ():
        if found.get("name") == container:
            return (found.get("state") or {}).get("terminated") or {}
    return {}


def _out_of_memory(pod: Mapping[str, Any], worker: Mapping[str, Any], container: str) -> str | None:
    if worker.get("reason") != "OOMKilled":
        return None
    limit = None
    for found in (pod.get("spec") or {}).get("containers") or ():
        if found.get("name") == container:
            limit = ((found.get("resources") or {}).get("limits") or {}).get("memory")
    # Without a limit, the node had no memory left.
    return f"OOMKilled: its memory limit is {limit}" if limit else "OOMKilled: it has no limit"


def _own_excess(status: Mapping[str, Any]) -> str | None:
    """Return the reason of an eviction for what the pod itself did: the next pod would do it too.

    Such an eviction has no condition DisruptionTarget.
    """
    message = str(status.get("message") or "")
    conditions = status.get("conditions") or ()
    if (
        status.get("reason") != "Evicted"
        or not ("exceeds the" in message or "exceeded its" in message)
        or any(
            c.get("type") == "DisruptionTarget" and c.get("status") == "True" for c in conditions
        )
    ):
        return None
    return _sentence("Evicted", message)


def _disruption(pod: Mapping[str, Any]) -> str | None:
    status = pod.get("status") or {}
    conditions = status.get("conditions") or ()
    for source in (status, *(c for c in conditions if c.get("type") == "DisruptionTarget")):
        word = names.DISRUPTIONS.get(str(source.get("reason")))
        if word and source.get("status") != "False":
            return _sentence(word, str(source.get("message") or ""))
    return None


def _deletion(pod: Mapping[str, Any]) -> str | None:
    if not (pod.get("metadata") or {}).get("deletionTimestamp"):
        return None
    return "Deleted: the pod was deleted"


def _lost_container(worker: Mapping[str, Any]) -> str | None:
    lost = worker.get("reason") in names.LOST_CONTAINERS
    return "NodeLost: its node has no record of the container" if lost else None


def _own_end(status: Mapping[str, Any], worker: Mapping[str, Any]) -> str | None:
    reason, message = str(status.get("reason") or ""), str(status.get("message") or "")
    exitcode = _exitcode(worker)
    if exitcode is not None:
        word = reason or str(worker.get("reason") or "Error")
        return _sentence(word, f"its agent {_ending(exitcode)}")
    if reason or status.get("phase") in ("Failed", "Succeeded"):
        return _sentence(reason or str(status["phase"]), message)
    return None


def _sentence(word: str, rest: str) -> str:
    rest = rest.strip().rstrip(".")
    return f"{word}: {rest}" if rest else word


def _exitcode(worker: Mapping[str, Any]) -> int | None:
    code = worker.get("exitCode")
    if not isinstance(code, int) or worker.get("reason") in names.LOST_CONTAINERS:
        return None
    return 128 - code if code > 128 else code  # runtimes add 128 to a signal


def _ending(exitcode: int) -> str:
    if exitcode >= 0:
        return f"ended with exit status {exitcode}"
    try:
        return f"was killed by {signal.Signals(-exitcode).name}"
    except ValueError:
        return f"was killed by signal {-exitcode}"


def explain(
    error: ApiError, doing: str, *, pool: str, namespace: str, server: str
) -> FiberPoolError:
    """Return an error with advice.  ``doing``: the failed action, as "make the FiberPool es"."""
    reason, advice = _advice(error, namespace, server)
    where = f"cannot {doing} in namespace {namespace!r}"
    return FiberPoolError(
        f"{where}: {error.message}. {advice}", pool=pool, namespace=namespace, reason=reason
    )


def _advice(error: ApiError, namespace: str, server: str) -> tuple[str, str]:
    match error:
        case Unauthorized():
            return "Unauthorized", (
                f"The API server {server} accepts neither this program's login nor a renewed one: "
                "check with `kubectl auth whoami` and log in again"
            )
        case Forbidden() | Invalid() if "ValidatingAdmissionPolicy" in error.message:
            return "Refused", (
                "A policy of the cluster refuses it: change the named fields with "
                "fiber.init(template=) or in the pod of this program, or ask an administrator for "
                "an exception"
            )
        case Forbidden() if "quota" in error.message:
            return "QuotaExceeded", (
                f"See `kubectl get resourcequota -n {namespace}`. Delete objects that are not "
                "needed, or ask for a larger quota"
            )
        case Forbidden():
            return "Forbidden", (
                "Give this program's account the role fiber-user in this namespace: `kubectl "
                f"create rolebinding NAME -n {namespace} --clusterrole=fiber-user`, with --user= "
                "or --serviceaccount=NAMESPACE:ACCOUNT"
            )
        case NotServed():
            return "NotInstalled", (
                f"The cluster at {server} knows no FiberPools: install the operator with its chart "
                f"(`{install_command()}`), or choose another cluster with fiber.init(context=)"
            )
        case NotFound() if error.message.startswith("namespaces "):
            return "NamespaceNotFound", (
                f"Make it with `kubectl create namespace {namespace}`, or name another one with "
                "fiber.init(namespace=) or FIBER_NAMESPACE"
            )
        case NotFound():
            return "NotFound", f"See `kubectl get fiberpools -n {namespace}` for the existing ones"
        case Invalid() if "unknown field" in error.message:
            return "OutdatedDefinition", (
                "The CustomResourceDefinition fiberpools.fiber.dev belongs to another version of "
                "fiberpool: upgrade the operator with its chart, or install that version of "
                "fiberpool"
            )
        case ServerError():
            return error.reason or "InternalError", (
                f"The API server {server} answers with HTTP status {error.status}: it or a part "
                "that it depends on has failed. Check with `kubectl get --raw "
                "'/readyz?verbose'`, or try again later"
            )
        case TooManyRequests():
            return error.reason or "TooManyRequests", (
                f"The API server {server} is overloaded, or this account sends too many calls: try "
                "again later, or see `kubectl get flowschemas,prioritylevelconfigurations`"
            )
        case Transient():
            return "Unreachable", (
                f"The API server {server} cannot be reached or does not answer: check with "
                "`kubectl cluster-info`"
            )
    return error.reason or "Invalid", (
        "Correct the named fields; fiber.init(template=) sets those of pods"
    )


_EXPIRED = "Lease expired"


class Reporter:
    """Reporter of the problems of one FiberPool.  Any thread may call it.

    ``on_warning`` and ``on_error`` are called on the loop thread, ``on_error`` once at most.
    ``on_failure`` follows at once, on the calling thread.
    """

    def __init__(
        self,
        loop: Loop,
        pool: PoolName,
        server: str,
        *,
        on_warning: Callable[[str], None],
        on_error: Callable[[FiberPoolError], None],
        on_failure: Callable[[], None],
    ) -> None:
        self._loop = loop
        self._pool = pool
        self._server = server
        self._on_warning = on_warning
        self._on_error = on_error
        self._on_failure = on_failure
        self._failing = threading.Lock()
        """Acquired by the first error, and never released."""
        self._warned: set[str] = set()
        self._muted = False

    def mute(self) -> None:
        """Report no more, since the pool is ending."""
        self._muted = True

    def answered(self) -> None:
        """Note that the API server answers; its next failure is reported again."""
        kinds = {kind.__name__ for kind in (ServerUnreachable, ServerError, TooManyRequests)}
        self._warned -= {*kinds, _EXPIRED}

    def warn_anew(self) -> None:
        """Repeat the warnings of problems that persist."""
        self._warned.clear()

    def warn(self, what: str, message: str) -> None:
        """Warn once of the problem ``what``, until it has passed."""
        if not self._muted and what not in self._warned:
            self._warned.add(what)
            self._loop.call_soon(self._on_warning, message)

    def trouble(self, doing: str, error: ApiError) -> None:
        """Report an error that may pass.  ``doing``: the action, before the name of the pool."""
        # A failing API server gives one warning for all actions, a missing right one for each.
        kind = type(error).__name__
        what = kind if isinstance(error, Transient) else f"{kind}: {doing}"
        self.warn(what, str(self._explained(doing, error)))

    def expired(self, seconds: float) -> None:
        """Warn that the Lease has not been renewed for its duration."""
        what = (
            f"may get another master: this program has not renewed its Lease for {seconds:.0f} s. "
            "Its agents connect again, to this program or to the next master. Check that this "
            "program reaches the API server"
        )
        self.warn(_EXPIRED, str(self.error("LeaseExpired", what)))

    def refused(self, doing: str, error: ApiError) -> None:
        """Report an error that does not pass."""
        self.fail(self._explained(doing, error))

    def fault(self, error: Exception) -> None:
        """Report a bug, so that no child waits for ever."""
        failure = self.error("Internal", f"is given up after an unexpected {error!r}")
        failure.__cause__ = error
        self.fail(failure)

    def fail(self, error: FiberPoolError) -> None:
        """Report that the pool has failed."""
        if not self._muted and self._failing.acquire(blocking=False):
            self._loop.call_soon(self._on_error, error)
            self._on_failure()  # after ``on_error`` is queued

    def error(self, reason: str, what: str) -> FiberPoolError:
        """Return an error.  ``what``: the problem, in words that follow the pool's name."""
        name, namespace = self._pool
        message = f"{self._pool} {what}"
        return FiberPoolError(message, pool=name, namespace=namespace, reason=reason)

    def _explained(self, doing: str, error: ApiError) -> FiberPoolError:
        name, namespace = self._pool
        doing = f"{doing} the FiberPool {name!r}"
        return explain(error, doing, pool=name, namespace=namespace, server=self._server)

    def say_what_stays(self, why: str, remedy: str) -> None:
        """Write to stderr that the pool is left.  ``remedy`` is the command that removes it."""
        with contextlib.suppress(Exception):  # stderr may be closed
            sys.stderr.write(
                f"fiber: {self._pool} stays behind: {why}. The operator ends it once the Lease of "
                f"this program has expired. To end it now: {remedy}\n"
            )
