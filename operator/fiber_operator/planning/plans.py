"""Input and result of ``reconcile.plan``, beside the pool and its pods.

All classes are frozen values.  The controller fills a ``Knowledge`` with what it knows of the
cluster, and carries out the ``Plan``.  Times are unix seconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from fiber_api.names import Reason
from fiber_api.signatures import Signer

QUOTA_IS_FULL = "exceeded quota"
"""Words of the API server if a quota is full."""
_QUOTA_WANTS_REQUESTS = "must specify "
"""Words of the API server if a quota counts a resource that a container does not request."""
_NAMESPACE_ENDS = "because it is being terminated"
"""Words of the API server in a namespace that is being deleted."""
_NO_ACCOUNT_YET = "error looking up service account"
"""Words of the API server in a new namespace whose ServiceAccounts do not exist yet."""


@dataclass(frozen=True)
class PodRefusal:
    """Last refusal of the API server to create a pod, or to accept one in a dry run.

    The controller makes one at the first 403, 422 or 400, and forgets it when a pod is created.
    """

    template_hash: str
    """``manifests.template_hash`` of the refused pod."""
    status: int
    """403: quota, policy or rights.  422: the pod is invalid.  400: in a dry run, the template
    cannot be read as a pod; else a webhook refuses the pod at the moment."""
    message: str
    """The API server's own words."""
    at: float
    count: int = 1
    """Number of refusals in a row, including this one.  The delay grows with it."""
    dry_run: bool = False
    """True if a dry run was refused, which judges the template alone."""

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
        """True if the template is not to blame, because it passed the dry run.

        Admission webhooks answer 400 for what they refuse at the moment.
        """
        return self.lacks_account or (self.status not in (403, 422) and not self.dry_run)

    @property
    def terminal(self) -> bool:
        """True if another try cannot succeed."""
        return self.reason != Reason.QUOTA_EXCEEDED and not self.may_pass

    @property
    def lacks_account(self) -> bool:
        """True if the template's ServiceAccount does not exist, or not yet."""
        return _NO_ACCOUNT_YET in self.message

    @property
    def namespace_ends(self) -> bool:
        """True if the namespace is being deleted."""
        return _NAMESPACE_ENDS in self.message


@dataclass(frozen=True)
class Obstacle:
    """Obstacle for the operator, such as an object of the pool that could not be created.

    The reason ``API_UNAVAILABLE`` counts as an error only if it lasts.  ``message`` says what
    happened, why, and what to do; it is shown unchanged.
    """

    reason: Reason
    message: str
    terminal: bool = False
    """True if a retry cannot succeed."""


@dataclass(frozen=True)
class LeaseVerdict:
    """Verdict on the master's Lease, by the operator's monotonic clock.

    ``lease_monitor.py`` makes one for each pool whose ``spec.master.leaseName`` is set, and a new
    one for each epoch.  After a restart of the operator ``alive`` is None until the Lease changes
    (True) or its whole duration passes without a change (False).  A Lease that does not exist does
    not change.
    """

    alive: bool | None = None
    missing: bool = False
    """True if there is no Lease of that name."""
    connected: int | None = None
    """Number of agents with a link to the master at the last renewal, if the Lease states it."""
    unreadable: str = ""
    """Words of the API server if the operator lacks the right to read the Lease."""


@dataclass(frozen=True)
class PoolSecret:
    """Secret of a pool."""

    made: float = 0.0
    """Creation time, if the operator made it; else 0.0."""
    signer: Signer | None = None
    """Signer with the pool's key; None if the Secret names the only master of the pool."""


@dataclass(frozen=True)
class Knowledge:
    """Knowledge of the operator about a pool, beside the resource and its pods.

    After a restart of the operator an empty ``Knowledge()`` leads to right plans, only later.
    """

    address: str | None = None
    """``host:port`` of the pool's Service.  While it is None, no pod is created."""
    credentials: bool | None = None
    """True if the Secret belongs to the pool and has a valid key; None: it was not checked."""
    secret: PoolSecret | None = None
    """The pool's Secret; None if there is none, or it was not checked."""
    obstacles: tuple[Obstacle, ...] = ()
    """Obstacles of the pool's objects.  While there is one, no pod is created."""
    relay: str | None = None
    """Name of the relay's Deployment; empty if there is none, None if that was not checked."""
    led: bool = True
    """True if the EndpointSlice leads to ``spec.master``."""
    creation: Obstacle | None = None
    """Error of the last creation or dry run, if that failed and was not refused."""
    deletion: Obstacle | None = None
    """Failure of the last deletion."""
    accepted: str | None = None
    """The template hash that passed the server-side dry run in this process."""
    refusal: PodRefusal | None = None
    master: LeaseVerdict = field(default_factory=LeaseVerdict)
    warnings: Mapping[str, str] = field(default_factory=dict)
    """Newest event of each pod that ``Plan.inspect`` named, as ``Reason: message``, if it is a
    Warning."""


@dataclass(frozen=True)
class Deletion:
    """Pod to delete, with preconditions that fail if the plan is out of date.

    Status 404 means that the pod is gone.  409 means that it has changed: plan again.
    """

    name: str
    uid: str
    """Always a precondition."""
    resource_version: str | None
    """A precondition if set: the pod must not have started since."""
    reason: Reason
    may_work: bool = False
    """True if the pod could have work in case a master attached after the pool was read.

    It was not released and has no precondition.  It is deleted only if the pool is unchanged."""


@dataclass(frozen=True)
class PoolEvent:
    """Kubernetes event on the pool.  The planner emits it once at a transition."""

    type: str
    """``Normal`` or ``Warning``."""
    reason: str
    message: str


@dataclass(frozen=True)
class Plan:
    """Plan of the work to do now, in this order:

    0. If ``delete_pool``, delete the FiberPool and do nothing else.  Its uid and the
       resourceVersion of the plan are preconditions, so a master that comes back in this moment
       and writes the spec wins.  ``status`` is for the case that the pool cannot be deleted.
    1. If ``dry_run``, send ``podspec.pod(...)`` with ``dryRun=All`` and
       ``fieldValidation=Strict``; without the latter a misspelt field is dropped in silence.  Then
       plan again with the outcome in ``Knowledge.accepted`` or ``Knowledge.refusal``; without an
       outcome, go on with this plan.
    2. Write ``status`` if it is not None.  Counts and names of pods must be stored before these
       pods are deleted.
    3. Delete ``delete``.  Read the pool again before deleting pods that ``may_work``; if the pool
       has changed, plan again.
    4. Create ``create`` pods in batches of 1, 2, 4 and so on, up to ``batch_limit``.  Stop at the
       first 403 or 422, which becomes ``Knowledge.refusal``.
    5. Post ``events``.

    A failed step ends the work; the next plan starts from the state of the cluster.
    """

    delete_pool: bool = False
    create: int = 0
    batch_limit: int = 1
    delete: tuple[Deletion, ...] = ()
    dry_run: bool = False
    template_hash: str = ""
    """Hash of the current template; the label of new pods."""
    status: Mapping[str, Any] | None = None
    """Merge patch with the whole status if it differs from the pool's, else None.

    Fields to remove are None in it; lists are complete."""
    events: tuple[PoolEvent, ...] = ()
    inspect: tuple[str, ...] = ()
    """Name of at most one pod that has a node, is not Ready after some seconds, and whose status
    does not say why.

    The cause, such as a missing Secret of a volume, a network that fails or a probe, is only in
    the pod's events: read those with its ``involvedObject.uid``.  If the newest is a Warning, it
    goes into ``Knowledge.warnings``.  A Warning that is followed by a Normal event is over."""
    requeue_at: float | None = None
    """Time at which to plan again even without an event."""
