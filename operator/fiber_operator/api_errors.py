"""Errors of the API server.

What can go wrong is one of these, so that a caller says what it does about it::

    ApiError
    ├── Gone         404  not there (any more)
    ├── Conflict     409  the name is taken, or a precondition does not hold
    ├── Refused      403  quota, policy, or no right
    ├── Invalid      400, 422 and the rest of 4xx  asking again will not help
    └── Unavailable  the answer is not known: 5xx, no connection, too late, nonsense
        └── TooMany  429  not now; ``retry_after`` says when
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

Body = dict[str, Any]

LONGEST_RETRY_AFTER = 60.0
_MESSAGE_LIMIT = 2000


class ApiError(Exception):
    """A call that did not succeed.  ``str`` says what was asked and what came back."""

    def __init__(self, message: str, *, what: str = "", status: int = 0, reason: str = "") -> None:
        super().__init__(f"{what}: {message}" if what else message)
        self.message = message
        """The API server's own words."""
        self.call = " ".join(what.split()[:2])
        """Verb and resource, as a right names them: ``get secrets``."""
        self.status = status
        self.reason = reason
        """The API server's word for the error, ``AlreadyExists`` for example."""

    @property
    def writes(self) -> bool:
        """True if the call changes something, and so passes admission webhooks."""
        return not self.call.startswith(("get ", "list "))


class Gone(ApiError):
    """The object does not exist."""


class Conflict(ApiError):
    """The name is taken, or the object is not the one that was meant."""


class Refused(ApiError):
    """A quota, a policy or a missing right forbids it."""


class Invalid(ApiError):
    """The API server cannot accept this, now or later."""


class Unavailable(ApiError):
    """The call had no answer, and may have been carried out."""


class TooMany(Unavailable):
    """The API server asks to come back after ``retry_after`` seconds."""

    def __init__(self, message: str, *, retry_after: float, **about: Any) -> None:
        super().__init__(message, **about)
        self.retry_after = retry_after


def complaint(error: ApiError) -> str:
    """Return what went wrong, and what to do if that is known."""
    if isinstance(error, Refused):
        return f"{error}. Give the operator's account this right: the chart's roles have it"
    return str(error)


def object_of(answer: Body, name: str, what: str) -> Body:
    """``answer`` if it is the object of that name: what is none must not be taken for one."""
    metadata = answer.get("metadata")
    if not isinstance(metadata, dict) or metadata.get("name") != name:
        raise Unavailable(f"the answer is not the object {name}", what=what)
    return answer


def document_of(status: int, headers: Mapping[str, str], data: bytes, what: str) -> Body:
    """The document in an answer; what is no success is raised."""
    try:
        body = json.loads(data)
    except (ValueError, RecursionError):
        body = None
    if 200 <= status < 300:
        if isinstance(body, dict):
            return body
        # Not shown: it may be half a Secret.
        raise Unavailable(f"the answer is no JSON object ({len(data)} bytes)", what=what)
    raise _error(status, headers, body if isinstance(body, dict) else {}, data, what)


def _error(status: int, headers: Mapping[str, str], body: Body, data: bytes, what: str) -> ApiError:
    message = str(body.get("message") or "") or _excerpt(data) or f"HTTP status {status}"
    about: dict[str, Any] = {
        "what": what,
        "status": status,
        "reason": str(body.get("reason") or ""),
    }
    message = message[:_MESSAGE_LIMIT]
    if status == 429:
        return TooMany(message, retry_after=_retry_after(headers), **about)
    # Without a Status it was not the API server that answered but something on the way to it.
    if status >= 500 or status in (401, 408, 410) or body.get("kind") != "Status":
        return Unavailable(message, **about)
    return {404: Gone, 409: Conflict, 403: Refused}.get(status, Invalid)(message, **about)


def _retry_after(headers: Mapping[str, str]) -> float:
    try:
        seconds = float(headers.get("Retry-After", ""))
    except ValueError:
        return 1.0
    return min(max(seconds, 0.1), LONGEST_RETRY_AFTER) if seconds == seconds else 1.0


def _excerpt(data: bytes) -> str:
    return data[:200].decode(errors="replace").strip()
