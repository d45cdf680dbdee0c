"""Errors of the API server, and their words for the user of the program.

::

    ApiError
    ├── Unauthorized  401  it does not know who asks
    ├── Forbidden     403  quota, policy, or no right
    ├── NotFound      404  no such object, namespace or kind
    ├── Conflict      409  the name is taken, or a precondition does not hold
    ├── Expired       410  a watch that cannot go on from where it was
    ├── Invalid       the rest of 4xx: asking again will not help
    └── Transient          perhaps later
        ├── Unreachable      no answer that could be trusted: no connection, too late, nonsense
        ├── ServerError      5xx  it, or what it depends on, has failed
        └── TooManyRequests  429  not now
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from fiber.errors import FiberPoolError

Body = dict[str, Any]

_LONGEST_RETRY_AFTER = 30.0
"""Seconds; who asks for more is asked all the same."""

_MESSAGE_LIMIT = 2000


class ApiError(Exception):
    """A call that did not succeed.  ``reason`` is the API server's word for why, if it gave one."""

    def __init__(self, message: str, *, status: int = 0, reason: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.status = status
        self.reason = reason


class Unauthorized(ApiError):
    """The API server does not know who asks."""


class Forbidden(ApiError):
    """A quota, a policy or a missing right forbids it."""


class NotFound(ApiError):
    """No such object, no such namespace or, without a ``reason``, no such kind of object."""


class Conflict(ApiError):
    """The name is taken, or the object is not the one that was meant."""

    repeated = False
    """True if an earlier attempt of the same call had no answer, and may have taken the name."""


class Expired(ApiError):
    """The server has forgotten the version that a watch was to go on from.  List anew."""


class Invalid(ApiError):
    """The API server cannot accept this, now or later."""


class Transient(ApiError):
    """Not now: asking again may help, no sooner than after ``retry_after`` seconds.

    It is not known whether the call was carried out.
    """

    def __init__(self, message: str, *, retry_after: float = 0.0, **about: Any) -> None:
        super().__init__(message, **about)
        self.retry_after = retry_after


class Unreachable(Transient):
    """No answer came, or none of an API server."""


class ServerError(Transient):
    """The API server, or what it depends on, has failed."""


class TooManyRequests(Transient):
    """The API server has others to serve."""


_KINDS: dict[int, type[ApiError]] = {
    401: Unauthorized,
    403: Forbidden,
    404: NotFound,
    408: Unreachable,
    409: Conflict,
    410: Expired,
    429: TooManyRequests,
}


def document_of(status: int, headers: Mapping[str, str], data: bytes) -> Body:
    """The document in an answer; what is no success is raised."""
    try:
        body = json.loads(data)
    except (ValueError, RecursionError):
        body = None
    if 200 <= status < 300:
        if isinstance(body, dict):
            return body
        # Not shown: it may be half a Secret.
        raise Unreachable(f"the answer is no JSON object ({len(data)} bytes)", status=status)
    found = body if isinstance(body, dict) else {}
    text = str(found.get("message") or "") or data[:200].decode(errors="replace").strip()
    raise error_of(status, headers, found, text)


def error_of(status: int, headers: Mapping[str, str], body: Body, text: str = "") -> ApiError:
    """The error that a Status document, or what came in its place, tells."""
    message = (str(body.get("message") or "") or text or f"HTTP status {status}")[:_MESSAGE_LIMIT]
    kind = _kind_of(status)
    about: dict[str, Any] = {"status": status, "reason": str(body.get("reason") or "")}
    if issubclass(kind, Transient):
        about["retry_after"] = _retry_after(headers, body)
    return kind(message, **about)


def _kind_of(status: int) -> type[ApiError]:
    if status >= 500:
        return ServerError
    return _KINDS.get(status, Invalid) if status >= 400 else Unreachable


def _retry_after(headers: Mapping[str, str], body: Body) -> float:
    """The header is what counts; in a watch there is only the Status document."""
    text = headers.get("Retry-After") or str((body.get("details") or {}).get("retryAfterSeconds"))
    return min(float(text), _LONGEST_RETRY_AFTER) if text.isdecimal() else 0.0


def explain(
    error: ApiError, doing: str, *, pool: str, namespace: str, server: str
) -> FiberPoolError:
    """Return an error: what happened, why, what to do.  ``doing``: "make the FiberPool es"."""
    reason, advice = _advice(error, namespace, server)
    where = f"cannot {doing} in namespace {namespace!r}"
    return FiberPoolError(
        f"{where}: {error.message}. {advice}", pool=pool, namespace=namespace, reason=reason
    )


def _advice(error: ApiError, namespace: str, server: str) -> tuple[str, str]:
    match error:
        case Unauthorized():
            return "Unauthorized", (
                f"The API server {server} does not accept this program's login, and a renewed one "
                "neither: look with `kubectl auth whoami` and log in again"
            )
        case Forbidden() | Invalid() if "ValidatingAdmissionPolicy" in error.message:
            return "Refused", (
                "A policy of the cluster refuses it: change what the policy names with "
                "fiber.init(template=) or in the pod of this program, or ask an administrator for "
                "an exception"
            )
        case Forbidden() if "quota" in error.message:
            return "QuotaExceeded", (
                f"Look with `kubectl get resourcequota -n {namespace}`, and delete what is not "
                "needed or have the quota raised"
            )
        case Forbidden():
            return "Forbidden", (
                "Give this program's account the role fiber-user in this namespace: `kubectl "
                f"create rolebinding NAME -n {namespace} --clusterrole=fiber-user`, with --user= "
                "or --serviceaccount=NAMESPACE:ACCOUNT"
            )
        case NotFound(reason=""):
            return "NotInstalled", (
                f"The cluster at {server} knows no FiberPools: install the operator, whose chart "
                "brings them (`helm install fiber-operator charts/fiber-operator -n fiber-system "
                "--create-namespace`), or choose another cluster with fiber.init(context=)"
            )
        case NotFound() if error.message.startswith("namespaces "):
            return "NamespaceNotFound", (
                f"Make it with `kubectl create namespace {namespace}`, or name another one with "
                "fiber.init(namespace=) or FIBER_NAMESPACE"
            )
        case NotFound():
            return "NotFound", f"Look with `kubectl get fiberpools -n {namespace}` what is there"
        case Invalid() if "unknown field" in error.message:
            return "OutdatedDefinition", (
                "The CustomResourceDefinition fiberpools.fiber.dev is not of this version of "
                "fiberpool: upgrade the operator with its chart, or install the fiberpool that "
                "belongs to it"
            )
        case ServerError():
            return error.reason or "InternalError", (
                f"The API server {server} answers so, with HTTP status {error.status}: it or "
                "something that it depends on has failed. Look with `kubectl get --raw "
                "'/readyz?verbose'`, or try again later"
            )
        case TooManyRequests():
            return error.reason or "TooManyRequests", (
                f"The API server {server} has too much to do, or this account has its share: try "
                "again later, or look with `kubectl get flowschemas,prioritylevelconfigurations`"
            )
        case Transient():
            return "Unreachable", (
                f"The API server {server} cannot be reached or does not answer: look with "
                "`kubectl cluster-info`"
            )
    return error.reason or "Invalid", (
        "Correct what the API server names; fiber.init(template=) decides about pods"
    )
