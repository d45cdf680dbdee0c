"""Log records of children: a thread that hands them to the program's loggers."""

from __future__ import annotations

import contextlib
import json
import logging
import pickle
import socket
import threading
import time
import warnings
from collections.abc import Callable
from typing import Any

from fiber._agent import child, records
from fiber._exceptions import report_uncaught
from fiber._hub.handles import GrantSet, collecting_grants
from fiber._hub.local import LocalChannel

_AT_EXIT = 2.0
"""Seconds that the program's end waits for handlers that are behind."""

_METHODS = frozenset(dir(logging.LogRecord))
"""Attributes of records that no child may set."""

Call = tuple[Callable[[str, bytes], None], tuple[str, bytes]]


class RecordReader:
    """Reader of the channel that brings the records of ``level`` and above of all children."""

    def __init__(self, level: str) -> None:
        self._level = level
        self._inbox, self._outbox = LocalChannel.pair()
        self._thread = threading.Thread(target=self._run, name="fiber-records", daemon=True)
        self._grants: GrantSet | None = None
        self._way = b""
        self._lock = threading.Lock()
        self._failed = self._closing = False

    def calls(self) -> list[Call]:
        """Return the call that makes a child send its records.  The first one starts the thread.

        If records cannot come, warn and return none: the work of the program goes on.
        """
        with self._lock:
            if self._grants is None and not self._failed:
                try:
                    self._open()
                except (OSError, RuntimeError) as error:
                    self._failed = True
                    warnings.warn(
                        f"log records of children do not come to the program: {error}. Correct "
                        "that, or leave out log_records.",
                        RuntimeWarning,
                        stacklevel=2,
                    )
        return [] if self._failed else [(records.install, (self._level, self._way))]

    def _open(self) -> None:
        with collecting_grants() as grants:
            self._way = pickle.dumps(self._outbox)
        self._thread.start()
        self._grants = grants

    def close(self) -> None:
        """Hand over the records that have come, and end the thread.  The children have ended."""
        self._closing = True
        if self._grants is not None:
            self._grants.release()
            deadline = time.monotonic() + _AT_EXIT
            with contextlib.suppress(OSError):
                # An empty message ends the thread, behind all records.
                self._outbox.send_within(b"", _AT_EXIT)
            self._thread.join(max(0.0, deadline - time.monotonic()))
            if self._thread.is_alive():  # a handler is slow or stuck
                self._inbox.sock.shutdown(socket.SHUT_RDWR)
                return
        self.forget()

    def forget(self) -> None:
        """Close the channel's descriptors of this process."""
        self._inbox.close()
        self._outbox.close()

    def _run(self) -> None:
        with contextlib.suppress(OSError, EOFError):
            while True:
                data = self._inbox.recv().tobytes()
                if not data and self._closing:
                    return
                hand_over(data)


def hand_over(data: bytes) -> None:
    """Hand a child's record to its logger, if that is enabled for it."""
    try:
        fields: dict[str, Any] = json.loads(data)
        record = logging.makeLogRecord(
            {name: value for name, value in fields.items() if name not in _METHODS}
        )
        logger = logging.getLogger(record.name)
        if logger.isEnabledFor(record.levelno):
            logger.handle(record)
    except Exception:  # of a filter of the user, or of a child that sends what no record is
        report_uncaught()


def passed_on() -> list[Call]:
    """Return the call for a child of this child, whose records go to the same program."""
    return [] if records.passed is None else [(records.install, records.passed)]


def reader_for(level: str | None) -> RecordReader | None:
    """Return the reader of a program; None if no records are wanted, or this is a child."""
    return None if level is None or child.host else RecordReader(level)
