"""Client of the monitors of this machine's programs."""

from __future__ import annotations

import contextlib
import glob
import json
import os
import socket
import stat
import tempfile
from collections.abc import Iterator, Mapping
from typing import Any

from fiber._hub.directory import HUB_SOCKET, remove_directory
from fiber._monitor.server import NAME, PEER, SOCKET

PATIENCE = 10.0
"""Seconds that a program may take for a part of its answer."""


class NoAnswer(Exception):
    """Error: the program does not answer, or has ended; the message says which."""


class ProgramGone(NoAnswer):
    """Error: the program has ended."""


def sockets(parent: str | None = None) -> list[str]:
    """Return the sockets of this user's programs, whose directories are in ``parent``.

    None means the folders for temporary files.
    """
    parents = [parent] if parent else sorted({tempfile.gettempdir(), "/tmp"})
    found = [
        path for each in parents for path in glob.glob(f"{glob.escape(each)}/fiber-*/{SOCKET}")
    ]
    return sorted(path for path in found if _is_mine(path))


def ask(
    path: str, request: Mapping[str, Any], patience: float = PATIENCE
) -> Iterator[dict[str, Any]]:
    """Yield the lines of a program's answer; NoAnswer."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.settimeout(patience)
        try:
            sock.connect(path)
            sock.sendall(json.dumps(request).encode() + b"\n")
            with sock.makefile("rb") as stream:
                for line in stream:
                    yield json.loads(line)
        except ConnectionRefusedError as error:
            _remove_leftovers(os.path.dirname(path))
            raise ProgramGone("the program has ended") from error
        except (TimeoutError, BlockingIOError) as error:  # or too many clients wait already
            raise NoAnswer(f"the program does not answer within {patience:.0f} s") from error
        except (OSError, ValueError) as error:
            raise ProgramGone(f"the program has ended: {error}") from error


def ask_all(parent: str | None, request: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the lines of the answers of all programs, or that one does not answer."""
    for path in sockets(parent):
        try:
            yield from ask(path, request)
        except ProgramGone:
            pass
        except NoAnswer as error:
            yield {"error": f"{error}: a native function may hold Python's lock"}


def pid_of(path: str) -> int | None:
    """Return the pid of the program that listens at a socket; None if it has ended."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as sock:
        try:
            sock.connect(path)
        except OSError:
            return None
        credentials = sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, PEER.size)
        return int(PEER.unpack(credentials)[0])


def name_of(path: str) -> str | None:
    """Return the name of the program whose socket this is; None if it is not known."""
    try:
        with open(os.path.join(os.path.dirname(path), NAME), encoding="utf-8") as file:
            return file.read() or None
    except (OSError, ValueError):
        return None


def _is_mine(path: str) -> bool:
    """Return whether it is a socket that only this user can have made."""
    try:
        directory, found = os.lstat(os.path.dirname(path)), os.lstat(path)
    except OSError:
        return False
    is_private = directory.st_uid == os.geteuid() and directory.st_mode & 0o077 == 0
    return is_private and stat.S_ISSOCK(found.st_mode)


def _remove_leftovers(directory: str) -> None:
    """Remove the directory of a program that was killed, if it is one of Fiber's."""
    with contextlib.suppress(OSError):
        if stat.S_ISSOCK(os.lstat(os.path.join(directory, HUB_SOCKET)).st_mode):
            remove_directory(directory)
