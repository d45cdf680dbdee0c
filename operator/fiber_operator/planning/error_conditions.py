"""Obstacles for a pool that follow from failed calls: what, why, what to do.

Whatever cannot be asked or done is told in the pool's status; silence would look like success.
"""

from __future__ import annotations

from fiber_api.names import Reason
from fiber_api.v1alpha1 import FiberPool
from fiber_operator.api_errors import ApiError, Invalid, Refused
from fiber_operator.planning.plans import Obstacle
from fiber_operator.planning.wording import quoted

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


def with_object(error: ApiError, what: str) -> Obstacle:
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


def with_creation(error: ApiError) -> Obstacle:
    """Return the obstacle after a failed creation of a pod."""
    message = (
        f"The API server does not make workers{quoted(error.message)}. Those that run go on. "
        f"{_WEBHOOKS.format(what='pods')}"
    )
    return Obstacle(Reason.API_UNAVAILABLE, message)


def with_deletion(error: ApiError) -> Obstacle:
    """Return the obstacle after a failed deletion."""
    if isinstance(error, Refused | Invalid):
        return _forbidden(error, "to remove what is not wanted any more")
    message = (
        f"The call to {error.call} failed{quoted(error.message)}, and what is not wanted any more "
        f"is still there. {_WEBHOOKS.format(what=error.call.split()[-1])}"
    )
    return Obstacle(Reason.API_UNAVAILABLE, message)


def with_list(error: ApiError) -> Obstacle:
    """Return the obstacle after a failed list of pods."""
    blind = "Until they are known none is made or deleted, and the numbers are those of before."
    if isinstance(error, Refused | Invalid):
        return _forbidden(error, "to see the pool's workers", blind)
    message = f"The pool's workers cannot be listed{quoted(error.message)}. {blind} {_SERVER}"
    return Obstacle(Reason.API_UNAVAILABLE, message)


def with_lease(pool: FiberPool, words: str) -> str:
    """Return the words for a Lease that cannot be read."""
    lease = pool.spec.master.lease_name if pool.spec.master else None
    return (
        f"The operator may not get leases, so that nobody sees whether the master renews the Lease "
        f"{lease}{quoted(words)}. Until then onLost ({pool.spec.on_lost}) is never applied"
        f", and a pool whose master is gone stays. {_RIGHTS}"
    )


def with_status(error: ApiError) -> str:
    """The status cannot be written; an event is all that is left to tell it."""
    remedy = _RIGHTS if isinstance(error, Refused) else _SCHEMA
    return (
        f"What the status of this pool says is out of date: {error}. Nothing is made or deleted "
        f"until it can be written. {remedy}"
    )


def _forbidden(error: ApiError, purpose: str, effect: str = "") -> Obstacle:
    what = f"The operator may not {error.call}, which it needs {purpose}{quoted(error.message)}."
    return Obstacle(Reason.FORBIDDEN, " ".join(filter(None, (what, effect, _RIGHTS))))
