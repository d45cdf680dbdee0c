"""Log lines: one JSON object a line for programs, or text for people.

The subject of a line is in its fields, not in its text: ``log.info("...", extra=about(*key,
uid=..., reason=...))`` gives the fields ``namespace``, ``pool``, ``uid`` and ``reason``.
"""

from __future__ import annotations

import datetime
import json
import logging
import sys
from collections.abc import Mapping
from typing import IO, Any

_ABOUT = "about"

# Loggers of kopf that say too much: a line for every event of every pod, for each login, and a
# warning that it does not handle signals, which is the main program's part.
_QUIETER = {
    "kopf.objects": logging.WARNING,
    "kopf.activities": logging.WARNING,
    "kopf._core.engines.activities": logging.WARNING,
    "kopf._core.reactor.running": logging.ERROR,
}


def about(
    namespace: str = "", pool: str = "", *, uid: str = "", reason: str = "", **more: object
) -> dict[str, Any]:
    """The ``extra`` of a log line; what is empty is left out."""
    fields = {"namespace": namespace, "pool": pool, "uid": uid, "reason": reason, **more}
    return {_ABOUT: {name: value for name, value in fields.items() if value not in ("", None)}}


class JsonLines(logging.Formatter):
    """Formatter of records as JSON objects, one a line."""

    def format(self, record: logging.LogRecord) -> str:
        """The line of ``record``, without its end."""
        when = datetime.datetime.fromtimestamp(record.created, datetime.UTC)
        line: dict[str, object] = {
            "time": when.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **_fields(record),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class TextLines(logging.Formatter):
    """The same for people: the fields after the message."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)-7s %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:
        """The line of ``record``, without the traceback."""
        fields = " ".join(f"{name}={value}" for name, value in _fields(record).items())
        line = super().formatMessage(record)
        return f"{line}  [{fields}]" if fields else line


def set_up(level: str, style: str, stream: IO[str] | None = None) -> logging.Handler:
    """Send every log line of this process to ``stream`` (standard error if left out)."""
    handler = logging.StreamHandler(sys.stderr if stream is None else stream)
    handler.setFormatter(JsonLines() if style == "json" else TextLines())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level)
    for name, quieter in _QUIETER.items():
        logging.getLogger(name).setLevel(max(quieter, root.level))
    return handler


def _fields(record: logging.LogRecord) -> dict[str, object]:
    ours = getattr(record, _ABOUT, None)
    if isinstance(ours, Mapping):
        return dict(ours)
    # kopf's own way to say which object a line is about.
    theirs = getattr(record, "k8s_ref", None)
    if isinstance(theirs, Mapping):
        return {
            name: theirs[name] for name in ("kind", "namespace", "name", "uid") if theirs.get(name)
        }
    return {}
