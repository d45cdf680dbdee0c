"""The calls of the Kubernetes API that a program makes: JSON documents go in and come out."""

from __future__ import annotations

import contextlib
import json
import random
import threading
import time
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, TypedDict, Unpack

from fiber._backends.kubernetes.api_errors import (
    Body,
    Conflict,
    Transient,
    Unreachable,
    document_of,
    error_of,
)
from fiber._backends.kubernetes.session import (
    CONNECT_TIMEOUT,
    Login,
    Request,
    Session,
    network_errors,
)
from fiber_api import names

if TYPE_CHECKING:
    from urllib3 import BaseHTTPResponse

READ_TIMEOUT = 30.0
TIMEOUT = 30.0
"""Seconds for one call, all its attempts together, if the caller says nothing else."""

_PAUSE_MIN, _PAUSE_MAX = 0.1, 5.0
"""Seconds between two attempts, growing; each is drawn from the upper half."""

_WATCH_SECONDS = 60.0
"""After so long the API server ends a watch; one that says nothing for twice that was cut off."""

_AS_SDK: Mapping[str, str] = {"fieldManager": names.SDK_MANAGER}


class _How(TypedDict, total=False):
    timeout: float
    cancel: threading.Event | None


class Api:
    """Client of one API server with one login.  Any thread; calls block and raise ``ApiError``.

    ``timeout`` bounds a call with all its attempts, in seconds: what may pass (no connection, 429,
    5xx) is tried again until then, at 0 never.  Setting ``cancel`` ends a pause between attempts.
    A call that was tried again, or ends in Transient, may have been carried out before.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self.trouble: str | None = None
        """Why the newest call is tried again, or was given up; None once one succeeds."""

    @classmethod
    def connect(cls, context: str | None = None) -> Api:
        """Connect by the kubeconfig's ``context`` or its current one.

        A pod without KUBECONFIG uses its account.  This makes no call.  ConfigError if there is
        neither.
        """
        return cls(Session(Login.find(context)))

    @property
    def namespace(self) -> str:
        """The context's, or the account's."""
        return self._session.login.namespace

    @property
    def in_cluster(self) -> bool:
        """True in a pod that uses its own account."""
        return self._session.login.in_cluster

    @property
    def server(self) -> str:
        """The API server's host name or address."""
        return self._session.server

    def close(self) -> None:
        """Close the connections; one that is in use is closed after that."""
        self._session.close()

    def get(self, path: str, **how: Unpack[_How]) -> Body:
        """The object at ``path``."""
        return self._call(Request("GET", path), **how)

    def list(
        self, path: str, selector: Mapping[str, str] | None = None, **how: Unpack[_How]
    ) -> Body:
        """The list at ``path``.  ``selector`` may have labelSelector and fieldSelector."""
        return self._call(Request("GET", path, selector or {}), **how)

    def create(self, path: str, body: Body, *, strict: bool = False, **how: Unpack[_How]) -> Body:
        """Add ``body`` to the collection ``path``.

        ``strict``: Invalid for fields that the API server does not know, which it else drops.
        """
        query = {**_AS_SDK, "fieldValidation": "Strict"} if strict else _AS_SDK
        return self._call(Request("POST", path, query, body), **how)

    def apply(self, path: str, body: Body, **how: Unpack[_How]) -> Body:
        """Server-side apply: what the last one had and ``body`` has not is removed."""
        kind = "application/apply-patch+yaml"
        return self._call(Request("PATCH", path, {**_AS_SDK, "force": "true"}, body, kind), **how)

    def merge_patch(self, path: str, patch: Body, **how: Unpack[_How]) -> Body:
        """None removes a field, a list replaces the list."""
        kind = "application/merge-patch+json"
        return self._call(Request("PATCH", path, _AS_SDK, patch, kind), **how)

    def delete(self, path: str, *, uid: str | None = None, **how: Unpack[_How]) -> Body:
        """Delete the object and what it owns; Conflict if it is not the one with this ``uid``."""
        options: Body = {"propagationPolicy": "Background"}
        if uid is not None:
            options["preconditions"] = {"uid": uid}
        return self._call(Request("DELETE", path, {}, options), **how)

    def watch(self, path: str, selector: Mapping[str, str], resource_version: str) -> Watch:
        """Watch the changes at ``path`` after ``resource_version``."""
        query = {
            **selector,
            "watch": "true",
            "resourceVersion": resource_version,
            "allowWatchBookmarks": "true",
            "timeoutSeconds": f"{_WATCH_SECONDS:.0f}",
        }
        return Watch(self._session, Request("GET", path, query))

    def _call(
        self,
        request: Request,
        *,
        timeout: float = TIMEOUT,
        cancel: threading.Event | None = None,
    ) -> Body:
        wait = (cancel or threading.Event()).wait
        deadline = time.monotonic() + timeout
        pause = _PAUSE_MIN
        repeated = False
        while True:
            try:
                seconds = min(READ_TIMEOUT, max(deadline - time.monotonic(), CONNECT_TIMEOUT))
                found = _document(self._session.send(request, seconds))
                self.trouble = None
                return found
            except Conflict as error:
                error.repeated = repeated
                raise
            except Transient as error:
                self.trouble = str(error)
                repeated = True
                delay = max(pause * random.uniform(0.5, 1.0), error.retry_after)
                if delay > deadline - time.monotonic() or wait(delay):
                    raise
            pause = min(2 * pause, _PAUSE_MAX)


class Watch:
    """The events of one watch, ``{"type": …, "object": …}``, until it ends or ``stop``.

    Any end is one: whoever wants more asks for another watch from where this one came to.
    """

    def __init__(self, session: Session, request: Request) -> None:
        self._session = session
        self._request = request
        self._lock = threading.Lock()
        self._response: BaseHTTPResponse | None = None
        self._stopped = False

    def __iter__(self) -> Iterator[Body]:
        """The events; raises ``ApiError``: Expired where it cannot go on from where it was."""
        response = self._session.send(self._request, 2 * _WATCH_SECONDS)
        with self._lock:
            self._response = response
            stopped = self._stopped
        try:
            if response.status != 200:
                _document(response)
            if not stopped:
                yield from self._events(response)
        except Unreachable:
            if not self._stopped:
                raise
        finally:
            with self._lock:
                self._response = None
            response.close()

    def _events(self, response: BaseHTTPResponse) -> Iterator[Body]:
        for line in _lines(response):
            try:
                event = json.loads(line)
                kind, found = event["type"], event["object"]
            except (ValueError, RecursionError, KeyError, TypeError):
                raise Unreachable(f"an event of {len(line)} bytes is no JSON") from None
            if kind == "ERROR":
                raise error_of(int(found.get("code") or 500), {}, found)
            yield {"type": kind, "object": found}

    def stop(self) -> None:
        """End it, also in the middle of waiting for an event.  Any thread."""
        with self._lock:
            self._stopped = True
            if self._response is not None:
                with contextlib.suppress(OSError, ValueError, RuntimeError):  # it has just ended
                    self._response.shutdown()


def _document(response: BaseHTTPResponse) -> Body:
    with network_errors():
        data = response.data
    return document_of(response.status, response.headers, data)


def _lines(response: BaseHTTPResponse) -> Iterator[bytes]:
    rest = b""
    with network_errors():
        for piece in response.stream(None, decode_content=True):
            *whole, rest = (rest + piece).split(b"\n")
            yield from filter(None, whole)
