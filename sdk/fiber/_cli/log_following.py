"""Log of a pod, followed to its end although the connection may break.

Each line of the log comes with its time.  After a broken connection the log is read from the second
of the last line on, and what was shown is left out.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

from fiber._cli import streams
from fiber._cli.session import SECONDS, Session
from fiber_api.rest import PODS, Invalid, Transient

_PAUSE = 1.0
"""Seconds until the next attempt to read the log."""


def follow_log(session: Session, pod: str, query: dict[str, str]) -> None:
    """Show the log of the pod's container until the container has ended; ``ApiError``."""
    path = PODS.path(session.namespace, pod)
    lines = Lines()
    while True:
        has_ended = False
        try:
            # Asked before: what is in the log at the end of this reading is then all there is.
            has_ended = _has_ended(session.api.get(path, timeout=SECONDS), query["container"])
            for piece in session.api.log(path, lines.query(query)):
                for shown in lines.new(piece):
                    streams.write(shown)
            if has_ended:
                return
        except Transient as error:
            streams.say(f"[fiber] the log broke off ({error.message}); trying again")
        except Invalid as error:  # the container has not started
            if has_ended:
                raise
            streams.say(f"[fiber] {error.message}")
        time.sleep(_PAUSE)


def _has_ended(pod: dict[str, object], container: str) -> bool:
    status = pod.get("status")
    assert status is None or isinstance(status, dict)
    for found in (status or {}).get("containerStatuses") or ():
        if found.get("name") == container:
            return "terminated" in (found.get("state") or {})
    return (status or {}).get("phase") in ("Failed", "Succeeded")


class Lines:
    """Lines of a log with their times, without those that an earlier reading has shown."""

    def __init__(self) -> None:
        self._time = b""
        """Time of the last line that was shown."""
        self._number = 0
        """Lines of that time that were shown, the last one included."""
        self._shown = 0
        """Bytes of the last line that were shown."""
        self._begun()

    def _begun(self) -> None:
        self._head = b""
        """Begin of a line whose time has not arrived whole."""
        self._in_line = False
        self._skip: float = 0
        """Bytes of the present line that were shown before."""
        self._repeats = bool(self._time)
        self._repeated = 0
        """Lines of the last time that came again."""

    def query(self, query: dict[str, str]) -> dict[str, str]:
        """Return the query for what was not shown, and begin to read anew."""
        self._begun()
        if self._time:  # the server takes one of the two limits
            query = {key: value for key, value in query.items() if key != "sinceSeconds"}
            query["sinceTime"] = self._time.decode()
        return {**query, "follow": "true", "timestamps": "true"}

    def new(self, piece: bytes) -> Iterator[bytes]:
        """Yield what is new in a piece of the log."""
        while piece:
            if not self._in_line:
                head, space, rest = (self._head + piece).partition(b" ")
                if not space:
                    self._head = head
                    return
                self._head, piece = b"", rest
                self._begin_line(head)
            line, newline, rest = piece.partition(b"\n")
            self._in_line = not newline
            piece = rest
            if found := self._without_shown(line + newline):
                yield found

    def _begin_line(self, moment: bytes) -> None:
        if self._repeats and moment <= self._time:
            self._repeated += moment == self._time
            last = moment == self._time and self._repeated == self._number
            self._skip = self._shown if last else math.inf
            self._repeats = not last
            return
        self._repeats = False
        self._number = self._number + 1 if moment == self._time else 1
        self._time, self._shown, self._skip = moment, 0, 0

    def _without_shown(self, part: bytes) -> bytes:
        new = part[int(min(self._skip, len(part))) :]
        self._skip = max(self._skip - len(part), 0) if self._skip != math.inf else math.inf
        self._shown += len(new)
        return new
