"""The Kubernetes API as both clients speak it: paths, documents, events and errors.

The SDK calls the API server from threads, and the operator from an event loop, so each has its own
way to send (decision 43).  Both give the status, the headers and the bytes of a response to this
module, which needs the standard library only.

Errors::

    ApiError
    ├── Unauthorized  401  the API server does not know the login
    ├── Forbidden     403  quota, policy, or a missing right
    ├── NotFound      404  no such object or namespace
    ├── NotServed     404  no such kind of object, or no API server at this address
    ├── Conflict      409  the name is taken, or a precondition does not hold
    ├── Expired       410  the version to watch or to list from is forgotten
    ├── Invalid       the rest of 4xx: repeating will not help
    └── Transient          repeating may help; the call may have been carried out
        ├── ServerUnreachable  no connection, too late, or no answer of an API server
        ├── ServerError        5xx  the API server, or what it depends on, has failed
        └── TooManyRequests    429  the API server is overloaded
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NamedTuple

from fiber_api import names

Body = dict[str, Any]

LONGEST_RETRY_AFTER = 30.0
"""Seconds.  A longer ``Retry-After`` counts as this."""

EXCERPT = 200
"""Bytes of an error's data that are shown if they are no Status document."""

_MESSAGE_LIMIT = 2000


class ResourceType(NamedTuple):
    """Kind of object in the API."""

    api_version: str
    kind: str
    plural: str

    def path(self, namespace: str | None = None, name: str = "", subresource: str = "") -> str:
        """Return the path of one object or, without a name, of the collection.

        Without a namespace, that is the collection of all namespaces.
        """
        group = "/apis" if "/" in self.api_version else "/api"
        scope = f"namespaces/{namespace}" if namespace is not None else ""
        parts = (group, self.api_version, scope, self.plural, name, subresource)
        return "/".join(filter(None, parts))


POOLS = ResourceType(names.API_VERSION, names.KIND, names.PLURAL)
PODS = ResourceType("v1", "Pod", "pods")
NODES = ResourceType("v1", "Node", "nodes")
CLAIMS = ResourceType("v1", "PersistentVolumeClaim", "persistentvolumeclaims")
SERVICES = ResourceType("v1", "Service", "services")
SECRETS = ResourceType("v1", "Secret", "secrets")
EVENTS = ResourceType("v1", "Event", "events")
SLICES = ResourceType("discovery.k8s.io/v1", "EndpointSlice", "endpointslices")
DEPLOYMENTS = ResourceType("apps/v1", "Deployment", "deployments")
JOBS = ResourceType("batch/v1", "Job", "jobs")
ACCOUNTS = ResourceType("v1", "ServiceAccount", "serviceaccounts")
ROLES = ResourceType("rbac.authorization.k8s.io/v1", "Role", "roles")
ROLE_BINDINGS = ResourceType("rbac.authorization.k8s.io/v1", "RoleBinding", "rolebindings")
BUDGETS = ResourceType("policy/v1", "PodDisruptionBudget", "poddisruptionbudgets")
LEASES = ResourceType("coordination.k8s.io/v1", "Lease", "leases")


class ApiError(Exception):
    """Error of a call.  ``str`` names the call, if it is known, and what went wrong."""

    def __init__(self, message: str, *, what: str = "", status: int = 0, reason: str = "") -> None:
        super().__init__(f"{what}: {message}" if what else message)
        self.message = message
        """Words of the API server."""
        self.call = " ".join(what.split()[:2])
        """Verb and resource as in a right, for example ``get secrets``; empty if not known."""
        self.status = status
        self.reason = reason
        """API server's word for the error, for example ``AlreadyExists``; empty if it has none."""


class Unauthorized(ApiError):
    """Error: the API server does not know the login."""


class Forbidden(ApiError):
    """Error: a quota, a policy or a missing right forbids the call."""


class NotFound(ApiError):
    """Error: no such object or namespace."""


class NotServed(ApiError):
    """Error: no such kind of object; or a proxy answered, and no API server."""


class Conflict(ApiError):
    """Error: the name is taken, or a precondition does not hold."""

    repeated = False
    """True if an earlier attempt of the same call had no answer, and may have succeeded."""


class Expired(ApiError):
    """Error: the API server has forgotten the version to go on from.  List again."""


class Invalid(ApiError):
    """Error: the API server will never accept the call."""


class Transient(ApiError):
    """Error that may pass: repeat the call after ``retry_after`` seconds or later.

    The call may have been carried out.
    """

    def __init__(self, message: str, *, retry_after: float = 0.0, **about: Any) -> None:
        super().__init__(message, **about)
        self.retry_after = retry_after


class ServerUnreachable(Transient):
    """Error: no answer came, or none of an API server."""


class ServerError(Transient):
    """Error: the API server, or a part that it depends on, has failed."""


class TooManyRequests(Transient):
    """Error: the API server is overloaded."""


_BY_ANY_SERVER: dict[int, type[ApiError]] = {
    401: Unauthorized,
    404: NotServed,
    410: Expired,
    429: TooManyRequests,
}
_BY_STATUS: dict[int, type[ApiError]] = _BY_ANY_SERVER | {
    403: Forbidden,
    404: NotFound,
    408: ServerUnreachable,
    409: Conflict,
}


def document_of(status: int, headers: Mapping[str, str], data: bytes, what: str = "") -> Body:
    """Return the document in a response; raise ``ApiError`` if the status is not a success.

    ``what`` names the call in the error: its verb, its resource, and more.
    """
    body = _json(data)
    if not 200 <= status < 300:
        raise _error_of(status, headers, body if isinstance(body, dict) else {}, data, what)
    if isinstance(body, dict):
        return body
    # The data are not shown: they may be part of a Secret.
    raise ServerUnreachable(f"the answer is no JSON object ({len(data)} bytes)", what=what)


def event_of(line: bytes, what: str = "") -> tuple[str, Body]:
    """Return the type and the object of an event of a watch; raise the error that it reports."""
    event = _json(line)
    kind, body = (
        (event.get("type"), event.get("object")) if isinstance(event, dict) else (None, None)
    )
    if not isinstance(kind, str) or not isinstance(body, dict):
        raise ServerUnreachable(f"the answer is no event of a watch ({len(line)} bytes)", what=what)
    if kind == "ERROR":
        code = body.get("code")
        raise _error_of(code if isinstance(code, int) else 500, {}, body, b"", what)
    return kind, body


def _json(data: bytes) -> object:
    try:
        return json.loads(data)
    except (ValueError, RecursionError):
        return None


def _error_of(
    status: int, headers: Mapping[str, str], body: Body, data: bytes, what: str
) -> ApiError:
    """Return the error for a Status document, or for other data in its place."""
    text = str(body.get("message") or "") or data[:EXCERPT].decode(errors="replace").strip()
    message = (text or f"HTTP status {status}")[:_MESSAGE_LIMIT]
    about: dict[str, Any] = {
        "what": what,
        "status": status,
        "reason": str(body.get("reason") or ""),
    }
    kind = _kind_of(status, body)
    if issubclass(kind, Transient):
        about["retry_after"] = _retry_after(headers, body)
    return kind(message, **about)


def _kind_of(status: int, body: Body) -> type[ApiError]:
    if status >= 500:
        return ServerError
    # A response without a Status comes from a proxy, or from an API server that does not serve the
    # path.  It says nothing of objects and rights.
    if status < 400 or body.get("kind") != "Status":
        return _BY_ANY_SERVER.get(status, ServerUnreachable)
    return _BY_STATUS.get(status, Invalid)


def _retry_after(headers: Mapping[str, str], body: Body) -> float:
    """Return the header's value, or in a watch that of the Status document."""
    details = body.get("details")
    said = details.get("retryAfterSeconds") if isinstance(details, dict) else None
    text = headers.get("Retry-After") or str(said)
    return min(float(text), LONGEST_RETRY_AFTER) if text.isdecimal() else 0.0
