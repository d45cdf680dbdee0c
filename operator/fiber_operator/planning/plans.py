"""Input and result of ``reconcile.plan``, beside the pool and its pods.

All classes are frozen values.  The controller fills a ``Knowledge`` with what it knows of the
cluster, and carries out the ``Plan``.  Times are unix seconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from fiber_api.names import Reason

QUOTA_IS_FULL = "exceeded quota"
"""Words of the API server where a quota allows no more."""
_QUOTA_WANTS_REQUESTS = "must specify "
"""Words of the API server where a quota counts what a container does not request."""
_NAMESPACE_ENDS = "because it is being terminated"
"""Words of the API server in a namespace that is being deleted."""
_NO_ACCOUNT_YET = "error looking up service account"
"""Words of the API server for a moment in a new namespace, whose accounts come after it."""


@dataclass(frozen=True)
class PodRefusal:
    """The API server's last refusal to create a pod, or to accept one in a dry run.

    The controller makes one at the first 403, 422 or 400 and forgets it when a pod is created.
    """

    template_hash: str
    """``manifests.template_hash`` of the pool that it refused."""
    status: int
    """403 (quota, policy, rights), else 422 (the pod is no valid pod) or 400: in a dry run the
    template cannot be read as a pod, else a webhook does not want the pod now."""
    message: str
    """The API server's own words."""
    at: float
    count: int = 1
    """Number of refusals in a row, with this one.  The next attempt waits longer each time."""
    dry_run: bool = False
    """True if the dry run was refused, which judges only the template."""

    @property
    def reason(self) -> Reason:
        """Reason of the problem."""
        if self.status != 403 and not self.may_pass:
            return Reason.INVALID_TEMPLATE
        if QUOTA_IS_FULL in self.message:
            return Reason.QUOTA_EXCEEDED
        if "failed quota" in self.message and _QUOTA_WANTS_REQUESTS in self.message:
            return Reason.REQUESTS_MISSING
        return Reason.FORBIDDEN

    @property
    def may_pass(self) -> bool:
        """True if the template is not to blame, since it was good in the dry run.

        400 is how admission webhooks refuse what they find wrong at the moment.
        """
        return self.lacks_account or (self.status not in (403, 422) and not self.dry_run)

    @property
    def lacks_account(self) -> bool:
        """True if the ServiceAccount of the template is not there, or not there yet."""
        return _NO_ACCOUNT_YET in self.message

    @property
    def namespace_ends(self) -> bool:
        """True if the namespace is being deleted."""
        return _NAMESPACE_ENDS in self.message


@dataclass(frozen=True)
class Obstacle:
    """Obstacle for the operator, such as an object of the pool that it could not make.

    ``reason`` is ``Reason.NAME_TAKEN``, ``INVALID_CREDENTIALS``, ``FORBIDDEN`` or
    ``API_UNAVAILABLE``, which is no error until it lasts; ``message`` says what, why and what to do
    and is shown as it is.
    """

    reason: Reason
    message: str
    terminal: bool = False
    """True if waiting cannot help."""


@dataclass(frozen=True)
class LeaseVerdict:
    """Verdict on the master's Lease, by the operator's own monotonic clock.

    ``lease_monitor.py`` makes one for each pool whose ``spec.master.leaseName`` is set, anew for
    each epoch.  After a restart of the operator ``alive`` is None until the Lease is seen to change
    (True) or a whole duration passes without a change (False).  A Lease that does not exist is one
    that does not change.
    """

    alive: bool | None = None
    missing: bool = False
    """True if there is no Lease of that name."""
    connected: int | None = None
    """Agents that were linked to the master at its last renewal, if the Lease says so."""
    unreadable: str = ""
    """Why the Lease cannot be read at all, in the API server's words: there is no right to."""


@dataclass(frozen=True)
class Knowledge:
    """Knowledge of the operator about a pool, beside its resource and its pods.

    A fresh ``Memory()`` after a restart of the operator is always right, only less informed.
    """

    address: str | None = None
    """``host:port`` of the pool's Service.  Nothing is created while it is None."""
    credentials: bool | None = None
    """True if the pool's Secret is its own and whole; None: it was not looked at."""
    credentials_made: float = 0.0
    """Time at which the pool's Secret was made, as the cluster says."""
    obstacles: tuple[Obstacle, ...] = ()
    """Obstacles.  While there is one, nothing is created."""
    led: bool = True
    """The EndpointSlice leads where ``spec.master`` says."""
    creation: Obstacle | None = None
    """Why the last creation, or the last dry run, came to nothing, other than by a refusal."""
    deletion: Obstacle | None = None
    """Why what was to be deleted last could not be."""
    accepted: str | None = None
    """The template hash that passed the server-side dry run in this process."""
    refusal: PodRefusal | None = None
    master: LeaseVerdict = field(default_factory=LeaseVerdict)
    warnings: Mapping[str, str] = field(default_factory=dict)
    """Pod name -> the newest event about it, as ``Reason: message``, where that is a Warning, of
    the pods that ``Plan.inspect`` asked about."""


@dataclass(frozen=True)
class Deletion:
    """Pod to delete, with preconditions that make it a no-op if the plan is out of date.

    404 means that it is done.  409 means that the pod changed since: plan again.
    """

    name: str
    uid: str
    """Always a precondition."""
    resource_version: str | None
    """A precondition where set: the pod must not have begun to run meanwhile."""
    reason: Reason
    may_work: bool = False
    """The pod could be at work if a master attached after the pool was read: nobody released it,
    and no precondition guards it.  It goes only while the pool is the one that was planned for."""


@dataclass(frozen=True)
class PoolEvent:
    """A Kubernetes event on the pool.  The planner emits one at a transition, never per look."""

    type: str
    """``Normal`` or ``Warning``."""
    reason: str
    message: str


@dataclass(frozen=True)
class Plan:
    """Plan of the work to do now, in this order:

    0. if ``delete_pool``, delete the FiberPool, with its uid and the resourceVersion that the plan
       was made from as preconditions, and do nothing else: a master that comes back in this very
       moment writes the spec and wins; ``status`` is for the case that it cannot be deleted;
    1. if ``dry_run``, send ``manifests.pod(...)`` with ``dryRun=All`` and
       ``fieldValidation=Strict``, without which a misspelt field is dropped in silence; then plan
       again with the outcome in ``Memory.accepted`` or ``Memory.refusal``, or go on with this plan
       if there is none;
    2. write ``status``, if it is not None: what it counts must be safe before the pods that were
       counted are deleted, and so must the names of all that are;
    3. delete ``delete``, and read the pool again before those that ``may_work``: if it is another
       or has changed, plan anew;
    4. create ``create`` pods in slow-start batches 1, 2, 4 ... ``batch_limit``, and stop at the
       first 403 or 422, which becomes ``Memory.refusal``;
    5. emit ``events``.

    A step that fails ends the rest; the next plan is as right as this one.
    """

    delete_pool: bool = False
    create: int = 0
    batch_limit: int = 1
    delete: tuple[Deletion, ...] = ()
    dry_run: bool = False
    template_hash: str = ""
    """The revision that is wanted; the label of new pods."""
    status: Mapping[str, Any] | None = None
    """The whole of ``status`` if it differs from what the pool has, else None.  For a merge patch
    on the status subresource: a field that is to go away is None in it, lists are whole."""
    events: tuple[PoolEvent, ...] = ()
    inspect: tuple[str, ...] = ()
    """Names of pods, one at most, that have a node and are not Ready for some seconds, and whose
    status does not say why.  What the kubelet is stuck at (a volume whose Secret is missing, a
    network that fails, a probe) stands in the pod's events alone: read those with its
    ``involvedObject.uid``.  If the newest is a Warning, it goes into ``Memory.warnings``; one that
    is followed by a Normal event, as when an image is being pulled at last, is over."""
    requeue_at: float | None = None
    """Plan again at this time at the latest, though nothing has happened."""
