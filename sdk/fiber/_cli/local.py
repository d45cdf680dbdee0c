"""Programs of this machine: those of this user that have started a process or a pool."""

from __future__ import annotations

import os
import signal
import socket
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import click

from fiber import config
from fiber._backends.kubernetes.api import Login
from fiber._cli import display
from fiber._cli.failures import CommandError, explained, not_found
from fiber._monitor import client

_PATIENCE = 2.0
"""Seconds in which a program says who it is."""

_MOST_THREADS = 64
"""Programs that are asked at once.  Each that is stopped takes all its time."""


class LocalProgram(NamedTuple):
    """Program of this machine."""

    socket: str
    facts: dict[str, Any]
    answers: bool

    @property
    def name(self) -> str:
        return str(self.facts["name"])

    @property
    def pid(self) -> int:
        return int(self.facts["pid"])

    def row(self) -> dict[str, Any]:
        """Return the program's row of ``fiber ps``."""
        started = self.facts.get("started")
        return {
            "name": self.name,
            "state": "running" if self.answers else "silent",
            "workers": self.facts.get("children"),
            "host": socket.gethostname(),
            "created": None if started is None else display.utc(started),
            "age": display.age(started),
            "command": self.facts.get("command"),
            "job": False,
            "pid": self.pid,
        }


def local_programs() -> list[LocalProgram]:
    """Return the programs of this machine, the oldest first."""
    with explained("read the configuration"):
        parent = config.load().runtime_directory
    paths = client.sockets(parent)
    with ThreadPoolExecutor(max(1, min(len(paths), _MOST_THREADS))) as threads:
        found = [program for program in threads.map(_program, paths) if program is not None]
    return sorted(found, key=lambda program: program.facts.get("started") or 0.0)


def only_program() -> str:
    """Return the name of the program of this machine; CommandError unless there is one."""
    programs = [program.name for program in local_programs()]
    if len(programs) == 1:
        return programs[0]
    raise CommandError(
        "the program is not named",
        f"{len(programs) or 'no'} programs run on this machine",
        f"name one of {', '.join(programs[:10])}" if programs else "name a program of the cluster",
    )


def find_local(name: str, context: str | None, namespace: str | None) -> LocalProgram | None:
    """Return this machine's program of that name or pid; None if there is none.

    None, too, if the user has named a cluster's context or namespace.  CommandError if there is no
    cluster that may have a program of that name.
    """
    if context or namespace:
        return None
    programs = local_programs()
    for program in programs:
        if name in (program.name, str(program.pid)):
            return program
    if not Login.is_configured():
        raise not_found("program", name, [program.name for program in programs], "this machine")
    return None


def _program(path: str) -> LocalProgram | None:
    """Return the program behind a socket; None if it has ended."""
    try:
        for line in client.ask(path, {}, _PATIENCE):
            if "program" in line:
                return LocalProgram(path, line["program"], answers=True)
    except client.NoAnswer:
        pass
    pid = client.pid_of(path)
    if pid is None:
        return None
    facts = {"name": client.name_of(path) or f"program-{pid}", "pid": pid}
    return LocalProgram(path, facts, answers=False)


def end(program: LocalProgram, *, now: bool) -> None:
    """Send SIGTERM to a program, or SIGKILL if it is to end ``now``."""
    try:
        process = os.pidfd_open(program.pid)
    except ProcessLookupError:
        process = -1
    try:
        # The socket shows that the pid is not yet another process's.
        if process < 0 or client.pid_of(program.socket) != program.pid:
            raise CommandError(f"the program {program.name!r} has just ended")
        signal.pidfd_send_signal(process, signal.SIGKILL if now else signal.SIGTERM)
    finally:
        if process >= 0:
            os.close(process)
    click.echo(
        f"{'killed' if now else 'asked'} the program {program.name!r}{'' if now else ' to end'}"
    )
