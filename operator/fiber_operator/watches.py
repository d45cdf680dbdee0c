"""State of the watches, by the answers of the API server.

kopf tries again for ever and tells nobody; an operator without the right to watch would seem well
and see nothing.  So its requests are looked at as they are answered.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from types import SimpleNamespace

import aiohttp

from fiber_operator.api_errors import ApiError, complaint, document_of
from fiber_operator.watch_session import WATCHED

Answered = Callable[[str, ApiError | None], None]
"""Told of an answer: what was asked (``watch pods in team``) and why that failed, if it did."""

_PASSES = frozenset({401, 410})
"""A login that has expired and a watch that is too old: both are begun anew at once."""

log = logging.getLogger(__name__)


class Watches:
    """State of the watches.  ``namespaces`` are those that are watched; empty: all."""

    def __init__(self, namespaces: Sequence[str]) -> None:
        self._needed = [
            f"watch {resource.plural}{where}"
            for where in ([f" in {namespace}" for namespace in namespaces] or [""])
            for resource in WATCHED
        ]
        self._running = False
        self._open: set[str] = set()
        self._failures: dict[str, str] = {}

    def started(self, running: bool) -> None:
        """Watching begins, or ends."""
        self._running = running
        self._open.clear()

    def answered(self, what: str, error: ApiError | None) -> None:
        """A list or a watch was answered."""
        if error is None:
            self._open.add(what)
            if self._failures.pop(what, None):
                log.info("%s works again", what)
            return
        failure = complaint(error)
        if self._failures.get(what) != failure:
            log.warning("changes are not seen: %s", failure)
        self._failures[what] = failure

    def wrong(self) -> list[str]:
        """Why changes are not seen, or late, a sentence each."""
        wrong = [f"changes are not seen: {failure}" for failure in self._failures.values()]
        if not self._running:
            wrong.append("nothing is watched: changes are seen late")
        elif not wrong:
            missing = [what for what in self._needed if what not in self._open]
            wrong += [f"changes are seen late: {what} has not begun yet" for what in missing]
        return wrong


def tracing(answered: Answered) -> aiohttp.TraceConfig:
    """Makes a session tell of each answer to a GET."""

    async def ended(
        session: aiohttp.ClientSession,
        context: SimpleNamespace,
        request: aiohttp.TraceRequestEndParams,
    ) -> None:
        if request.method.upper() != "GET" or request.response.status in _PASSES:
            return
        what, response = _asked(request), request.response
        if response.status < 400:
            answered(what, None)
            return
        try:
            # It is kept, so that whoever asked reads it too.
            document_of(response.status, response.headers, await response.read(), what)
        except ApiError as error:
            answered(what, error)

    trace = aiohttp.TraceConfig()
    trace.on_request_end.append(ended)
    return trace


def _asked(request: aiohttp.TraceRequestEndParams) -> str:
    path = request.url.path
    before, namespace, plural = ["", "", *path.split("/")][-3:]
    if plural not in [resource.plural for resource in WATCHED]:
        return f"get {path}"  # kopf asks first what the API server serves
    verb = "watch" if request.url.query.get("watch") == "true" else "list"
    return f"{verb} {plural} in {namespace}" if before == "namespaces" else f"{verb} {plural}"
