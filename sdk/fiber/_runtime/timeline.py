"""Files with the timeline of a program: their forms, and how they are written.

A file is written beside its target under another name, and then renamed.  So a reader never sees
half a file, and a failure leaves the earlier file as it was.
"""

from __future__ import annotations

import contextlib
import errno
import gzip
import importlib.util
import io
import json
import os
import secrets
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from fiber._installation import explained_if_missing
from fiber._runtime import trace_events
from fiber._runtime.monitoring import program_facts
from fiber.errors import in_one_line

Facts = dict[str, Any]

_TRACES = (".json", ".json.gz")
_PICTURES = (".png", ".svg", ".pdf")

_PID = "%p"
"""Part of the key ``timeline`` that stands for the process id of the program."""

_PUBLIC_FACTS = ("name", "pid", "python", "fiber")
"""Facts of the program in a trace.  The command is not one: its arguments may be private."""


def public_facts() -> Facts:
    """Return facts of the program for a timeline."""
    facts = program_facts()
    return {key: facts[key] for key in _PUBLIC_FACTS}


def write_timeline(path: str, snapshot: Facts, program: Facts) -> None:
    """Write a snapshot in the form of the path's suffix; ``program``: as ``public_facts``."""
    form = _form(path)
    target = os.path.realpath(path)
    _check_target(target, path)
    make = _picture if form in _PICTURES else _trace
    data = make(snapshot, program, form)
    try:
        _replace(target, data)
    except OSError as error:
        raise _unwritable(error, path) from error
    _written[target] = _identity(target)


def _form(path: str) -> str:
    name = os.path.basename(path).lower()
    for form in (*_TRACES, *_PICTURES):
        if name.endswith(form) and name != form:
            return form
    raise ValueError(
        f"the timeline {in_one_line(path)!r} has no suffix that Fiber knows, and the suffix "
        "chooses the form. Use .json or .json.gz for Perfetto and chrome://tracing, and .png, "
        ".svg or .pdf for a picture."
    )


def _check_target(target: str, path: str) -> None:
    folder = os.path.dirname(target)
    if not os.path.isdir(folder):
        raise FileNotFoundError(
            errno.ENOENT,
            f"there is no folder {in_one_line(folder)} for the timeline. Make it, or choose "
            "another path",
            path,
        )
    if os.path.lexists(target) and not os.path.isfile(target):
        kind = "a folder" if os.path.isdir(target) else "no ordinary file"
        raise OSError(
            errno.EISDIR if os.path.isdir(target) else errno.EINVAL,
            f"the timeline cannot replace this path, which is {kind}. Choose the path of a file",
            path,
        )
    if not os.access(folder, os.W_OK | os.X_OK):
        raise _unwritable(PermissionError(errno.EACCES, os.strerror(errno.EACCES)), path)


def _unwritable(error: OSError, path: str) -> OSError:
    return OSError(
        error.errno,
        f"the timeline cannot be written: {error.strerror}. Choose a path in a folder in which "
        "this program may make files and has room",
        path,
    )


def _trace(snapshot: Facts, program: Facts, form: str) -> bytes:
    found = trace_events.trace(snapshot, program)
    data = json.dumps(found, separators=(",", ":")).encode()
    return gzip.compress(data, 6, mtime=0) if form == ".json.gz" else data


def _picture(snapshot: Facts, program: Facts, form: str) -> bytes:
    with explained_if_missing(f"a timeline in the form {form}"):
        from fiber._runtime import timeline_picture

        figure = timeline_picture.draw(snapshot, program["name"])
        data = io.BytesIO()
        figure.savefig(data, format=form[1:])
        return data.getvalue()


def _replace(target: str, data: bytes) -> None:
    temporary = f"{target}.{secrets.token_hex(4)}.part"
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        with open(descriptor, "wb") as file:
            file.write(data)
        os.replace(temporary, target)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise


_Identity = tuple[int, int, int]

_written: dict[str, _Identity | None] = {}
"""Files that this process has written, as they were then."""


def _identity(path: str) -> _Identity | None:
    """Return what changes when another program writes a file; None if there is no file."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size


def _is_of_another(path: str, before: _Identity | None) -> bool:
    """Return whether another process has written a file since it was ``before``."""
    now = _identity(path)
    return now is not None and now not in (before, _written.get(os.path.realpath(path)))


def _beside(path: str) -> str:
    """Return the path of this process beside one that another program uses."""
    folder, name = os.path.split(path)
    stem, dot, suffix = name.partition(_form(path))
    return os.path.join(folder, f"{stem}-{os.getpid()}{dot}{suffix}")


def timeline_at_end(path: str | None) -> TimelineAtEnd | None:
    """Return the timeline that the key asks for; None if there is to be none, or it is written."""
    if path is None:
        return None
    made = TimelineAtEnd(path)
    return None if made.path in _finished else made


_finished: set[str] = set()
"""Paths at which this process has written its timeline at its end."""


class TimelineAtEnd:
    """Timeline that the key ``timeline`` asks for, written when the program ends.

    A problem is printed once.  It has no other effect on the program.  The other program of two
    that run at the same time with one path finds that the file has changed since its own start, and
    writes another file.
    """

    def __init__(self, path: str) -> None:
        self.path = path.replace(_PID, str(os.getpid()))
        self._before = _identity(self.path)
        self._program = public_facts()  # the main module loses its path before the program ends
        self._has_complained = False
        try:
            if _form(self.path) in _PICTURES and importlib.util.find_spec("matplotlib") is None:
                self._complain(
                    "a picture of the timeline needs the package matplotlib, which is not "
                    "installed: pip install matplotlib."
                )
                self.path += ".json"
            _check_target(os.path.realpath(self.path), self.path)
        except (OSError, ValueError) as error:
            self._complain(f"{error}.")

    @contextmanager
    def writing(self, read: Callable[[], Facts]) -> Iterator[None]:
        """Read the activity before the body, and write the timeline after it."""
        _finished.add(self.path)
        snapshot = None
        with self._complaining():
            snapshot = read()
        try:
            yield
        finally:
            if snapshot is not None:
                with self._complaining():
                    self._write(snapshot)

    def _write(self, snapshot: Facts) -> None:
        path = self.path
        if _is_of_another(path, self._before):
            path = _beside(path)
            _say(f"another program has written {in_one_line(self.path)}. See {in_one_line(path)}.")
        try:
            write_timeline(path, snapshot, self._program)
        except (OSError, ValueError):
            raise
        except Exception as error:
            # The picture failed, and the record would be lost.
            write_timeline(f"{path}.json", snapshot, self._program)
            self._complain(f"the timeline cannot be drawn: {error!r}. See {path}.json.")

    @contextmanager
    def _complaining(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # the program's result counts, not its timeline
            self._complain(f"{error}")

    def _complain(self, problem: str) -> None:
        if not self._has_complained:
            self._has_complained = True
            _say(f"no timeline {in_one_line(self.path)}: {problem}")


def _say(news: str) -> None:
    with contextlib.suppress(OSError, ValueError, AttributeError):  # stderr is closed
        sys.stderr.write(f"fiber: {news}\n")
        sys.stderr.flush()
