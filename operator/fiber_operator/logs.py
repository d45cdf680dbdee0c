"""Log lines of the operator: JSON objects for programs, or text for people.

Fields name the subject of a line, for example a pool: ``log.info("...", extra=about(*key,
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

# kopf logs a line for each event and each login, and warns that it does not handle signals.  The
# main program handles them.
_LEVELS_OF_KOPF = {
    "kopf.objects": logging.WARNING,
    "kopf.activities": logging.WARNING,
    "kopf._core.engines.activities": logging.WARNING,
    "kopf._core.reactor.running": logging.ERROR,
}


def about(
    namespace: str = "", pool: str = "", *, uid: str = "", reason: str = "", **more: object
) -> dict[str, Any]:
    """Return the ``extra`` of a log line with these fields, without the empty ones."""
    fields = {"namespace": namespace, "pool": pool, "uid": uid, "reason": reason, **more}
    return {_ABOUT: {name: value for name, value in fields.items() if value not in ("", None)}}


class JsonLines(logging.Formatter):
    """Formatter that makes one line with a JSON object from each record."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of ``record`` without a line break."""
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
    """Formatter that makes text for people, with the fields after the message."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)-7s %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:
        """Return the line of ``record`` without the traceback."""
        fields = " ".join(f"{name}={value}" for name, value in _fields(record).items())
        line = super().formatMessage(record)
        return f"{line}  [{fields}]" if fields else line


def set_up(level: str, style: str, stream: IO[str] | None = None) -> logging.Handler:
    """Send all log lines of this process to ``stream`` (default: standard error)."""
    handler = logging.StreamHandler(sys.stderr if stream is None else stream)
    handler.setFormatter(JsonLines() if style == "json" else TextLines())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level)
    for name, least in _LEVELS_OF_KOPF.items():
        logging.getLogger(name).setLevel(max(least, root.level))
    return handler


def _fields(record: logging.LogRecord) -> dict[str, object]:
    fields = getattr(record, _ABOUT, None)
    if isinstance(fields, Mapping):
        return dict(fields)
    # kopf names the object of a line in this attribute.
    reference = getattr(record, "k8s_ref", None)
    if isinstance(reference, Mapping):
        keys = ("kind", "namespace", "name", "uid")
        return {key: reference[key] for key in keys if reference.get(key)}
    return {}
