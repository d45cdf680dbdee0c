"""Output of a program of this machine, if it goes to a file."""

from __future__ import annotations

import os
import re
import stat
import time

from fiber._cli import streams
from fiber._cli.failures import NOT_FOUND, USAGE, CommandError
from fiber._cli.local import LocalProgram
from fiber._output_files import stem_of

_PIECE = 1 << 16
_PAUSE = 0.2
"""Seconds between two looks at a file that is followed."""


def show(program: LocalProgram, *, worker: str | None, follow: bool, since: str | None) -> None:
    """Show the file that the standard output of a program goes to, or the file of a worker."""
    if since is not None:
        raise CommandError(
            "--since is for programs in pods",
            f"{program.name!r} runs on this machine, and its files have no times",
            "leave out --since",
            USAGE,
        )
    path = _file(program.name, program.pid) if worker is None else _file_of(program, worker)
    with open(path, "rb") as log:
        process = os.pidfd_open(program.pid) if follow else -1
        try:
            _copy(log.fileno(), process)
        finally:
            if process >= 0:
                os.close(process)


def tail(name: str, pid: int) -> str:
    """Return the end of the file that a program's standard output goes to; CommandError."""
    try:
        with open(_file(name, pid), "rb") as log:
            size = log.seek(0, os.SEEK_END)
            log.seek(max(0, size - _PIECE))
            return log.read(_PIECE).decode(errors="replace")
    except OSError as error:
        raise CommandError(f"cannot read the output of {name!r}", str(error)) from error


def _file(name: str, pid: int) -> str:
    link = f"/proc/{pid}/fd/1"
    try:
        place, mode = os.readlink(link), os.stat(link).st_mode
    except OSError:
        place, mode = "nothing", 0
    if not stat.S_ISREG(mode):
        raise CommandError(
            f"there is no log of {name!r}",
            f"the program runs on this machine, and its output goes to {place}",
            "see it there, or start the program with its output in a file: "
            "python train.py >train.log 2>&1",
        )
    return link


def _file_of(program: LocalProgram, worker: str) -> str:
    """Return the newest file with the output of the children of that name."""
    folder = program.facts.get("log_to")
    if folder is None:
        raise CommandError(
            f"there is no log of {worker!r} alone",
            f"{program.name!r} runs on this machine, and its workers share its output",
            'leave out --worker, or start the program with fiber.init(log_to="logs")',
            USAGE,
        )
    pattern = re.compile(rf"{re.escape(stem_of(program.name, worker))}(\.\d+)?\.log")
    try:
        names = [name for name in os.listdir(folder) if name.startswith(f"{program.name}.")]
        found = [os.path.join(folder, name) for name in names if pattern.fullmatch(name)]
        if found:
            return str(max(found, key=os.path.getmtime))
    except OSError as error:
        raise CommandError(f"the logs in {folder} cannot be read", str(error)) from error
    known = {name.split(".")[1] for name in names}
    raise CommandError(
        f"there is no output of {worker!r}",
        f"{folder} has no file of that worker",
        f"choose one of {', '.join(sorted(known)[:10])}" if known else "wait for its first line",
        NOT_FOUND,
    )


def _copy(log: int, process: int) -> None:
    """Copy a file's bytes and, until ``process`` ends, those that are added."""
    while True:
        ended = process < 0 or _has_ended(process)
        while data := os.read(log, _PIECE):
            streams.write(data)
        if ended:
            return
        time.sleep(_PAUSE)


def _has_ended(process: int) -> bool:
    import select

    poller = select.poll()
    poller.register(process, select.POLLIN)
    return bool(poller.poll(0))
