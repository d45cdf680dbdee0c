"""Log records of a child: a handler that sends them to the program.

Records travel as JSON, one message each, over one channel of the program that all children share.
The child formats the message and the text of the exception.  If the program takes records more
slowly than they come, the child waits for a moment and then drops records.  The next record that
leaves follows a record that says how many were dropped.
"""

from __future__ import annotations

import atexit
import json
import logging
import pickle
from typing import Any

from fiber._agent import child

_PATIENCE = 0.2
"""Seconds that a record waits for room.  After a record that was dropped, none waits."""

_AT_EXIT = 1.0
"""Seconds that a child waits at its end, until its last record has left."""

_LONGEST = 10_000
"""Characters of a message, or of another text of a record."""

_KEPT_BACK = frozenset({"args", "exc_info", "msg"})
_FORMATTER = logging.Formatter()

passed: tuple[str, bytes] | None = None
"""Arguments of ``install`` in this process, which its children get, too; None if not installed."""


def install(level: str, way: bytes) -> None:
    """Send records of ``level`` and above to the program; ``way`` is a pickled channel to it.

    The sender takes the place of the root logger's handlers.  Where the main module was imported
    before the fork, its ``basicConfig`` has added one.  Where it is imported later, its
    ``basicConfig`` does nothing.  So the program's handlers alone get each record.
    """
    global passed
    passed = level, way
    sender = RecordSender(level, way)
    root = logging.getLogger()
    root.handlers[:] = [sender]
    if root.level > sender.level:
        root.setLevel(sender.level)
    atexit.register(sender.finish)


def encode(record: logging.LogRecord) -> bytes:
    """Return a record as JSON: its plain attributes, with those of ``extra=``, and the host."""
    text = record.getMessage()
    if record.exc_info and not record.exc_text:
        record.exc_text = _FORMATTER.formatException(record.exc_info)
    fields: dict[str, Any] = {
        name: _shortened(value)
        for name, value in vars(record).items()
        if isinstance(value, str | int | float) and name not in _KEPT_BACK
    }
    fields["msg"] = _shortened(text)
    fields["host"] = child.host
    return json.dumps(fields).encode()


def _shortened(value: Any) -> Any:
    if isinstance(value, str) and len(value) > _LONGEST:
        half = _LONGEST // 2
        return f"{value[:half]} … {len(value) - 2 * half} characters … {value[-half:]}"
    return value


class RecordSender(logging.Handler):
    """Handler that sends records to the program.  logging's lock lets one thread in at a time."""

    def __init__(self, level: str, way: bytes) -> None:
        super().__init__(level)
        self._way = way
        self._channel: Any = None
        """Channel to the program, once there was a record."""
        self._dropped = 0
        self._busy = False
        self._ended = False

    def emit(self, record: logging.LogRecord) -> None:
        """Send a record.  Never raises."""
        if self._busy or self._ended:  # a record about the sending itself; or the program is gone
            return
        self._busy = True
        try:
            self._post(record)
        except (OSError, EOFError):
            self._ended = True
        except Exception:  # mostly a message that does not fit its arguments
            self.handleError(record)
        finally:
            self._busy = False

    def finish(self) -> None:
        """Report dropped records, and wait for a moment until the last record has left."""
        self.acquire()
        try:
            if self._channel is None or self._ended:
                return
            if self._dropped:
                self._channel.send_within(self._note(), _AT_EXIT)
            self._channel.all_taken_within(_AT_EXIT)
        except (OSError, EOFError):
            pass  # the program has ended
        finally:
            self.release()

    def _post(self, record: logging.LogRecord) -> None:
        if self._channel is None:
            self._channel = pickle.loads(self._way)
            self._channel.confirm()
        if self._dropped:
            if not self._channel.send_within(self._note(), 0):
                self._dropped += 1
                return
            self._dropped = 0
        if not self._channel.send_within(encode(record), _PATIENCE):
            self._dropped = 1

    def _note(self) -> bytes:
        text = "%d log records are left out here: the program took them more slowly than they came"
        record = logging.LogRecord(
            "fiber", logging.WARNING, __file__, 0, text, (self._dropped,), None
        )
        return encode(record)
