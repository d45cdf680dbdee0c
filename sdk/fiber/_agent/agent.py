"""The agent: starts, watches and kills the children of one host.

With the local backend the agent runs inside the program, on the program's loop.  Elsewhere it is a
separate process (``python -m fiber.agent``), whose observers send events over the link.

The agent runs on the loop's thread.  Any thread may call ``Agent.child``, which registers nothing,
and a child's ``recall`` and ``signal``, which only put a call into the loop's queue.  So the agent
needs no lock, on which a finalizer or a signal handler could block.

``MemoryLimit`` detects children that the kernel killed because the control group was out of memory.
They look like any other child that got a SIGKILL, so the kernel's count of such deaths decides.
"""

from __future__ import annotations

import itertools
import os
import signal
import threading
from typing import Any

from fiber._agent import zygote
from fiber._agent.interface import Cause, ChildObserver, ChildSpec, ExitReport
from fiber._agent.last_words import ProgressTable
from fiber._agent.local_child import LocalChild, ZygoteLink
from fiber._agent.preload import Imports
from fiber._hub import client as hub_client
from fiber._hub.hub import Hub
from fiber._hub.protocol import HubAddress
from fiber._transport.loop import Loop
from fiber._wire.memory_files import Blob

_ENDING = "this process is ending: no process can be started any more"

_CLOSE_TIMEOUT = 10.0
"""Seconds that the loop may take to run the calls that were queued before the close."""


class Agent:
    """Agent of this host, which runs its children."""

    def __init__(self, loop: Loop, host: str, hub: Hub | None = None) -> None:
        self.host = host
        self.loop = loop
        self.progress_table = ProgressTable()
        self.memory_limit = MemoryLimit()
        self._hub = hub
        self._ids = itertools.count(1)
        self._folders = itertools.count(1)
        self._children: dict[int, LocalChild] = {}
        self._abandoned: dict[int, int | None] = {}
        self._zygotes: list[ZygoteLink] = []
        self._closed = False

    def child(self, spec: ChildSpec, observer: ChildObserver) -> LocalChild:
        """Return a child, not started yet.  It has its pid once ``observer.started`` is called.

        Start failures are reported through ``observer.exited``.  RuntimeError is raised at once if
        this agent is closed.
        """
        if self._closed:
            spec.close()
            raise RuntimeError(_ENDING)
        return LocalChild(self, next(self._ids), spec, observer)

    def start(self, child: LocalChild) -> None:
        """Start a child that ``child`` made."""
        self._children[child.id] = child
        try:
            child.open()
            if self._closed:
                raise RuntimeError(_ENDING)
            child.fork_from(self._zygote(child.program), self._access())
        except Exception as error:
            child.start_error = error
            self._refused(child, error)

    def close(self) -> None:
        """Kill every child and end the zygotes.  Must not be called on the loop's thread."""
        zygotes: list[ZygoteLink] = []
        taken = threading.Event()
        if self.loop.running:
            self.loop.call_soon(self._close, zygotes, taken)
            taken.wait(_CLOSE_TIMEOUT)
        else:
            self._close(zygotes, taken)
        for link in zygotes:
            link.quit()
        self.loop.call_soon(self.progress_table.close)

    def _close(self, zygotes: list[ZygoteLink], taken: threading.Event) -> None:
        self._closed = True
        zygotes += self._zygotes
        self._zygotes.clear()
        taken.set()

    def _access(self) -> HubAddress | None:
        """Return the address of the host's hub, which the children get."""
        if self._hub is None:
            return hub_client.inherited_address()
        return self._hub.address_or_problem

    def _zygote(
        self,
        program: Blob | None,
        *,
        instead_of: ZygoteLink | None = None,
        imports: Imports | None = None,
    ) -> ZygoteLink:
        """Return the zygote of ``program``'s children, not ``instead_of``.

        A new zygote imports ``imports`` before its first fork.
        """
        link = self._newest_zygote(program)
        if link is None or link is instead_of:
            link = ZygoteLink(
                self,
                self.loop,
                self.progress_table.fd,
                self._cleanup_directory,
                imports=imports,
                program=program,
                folder=None if program is None else self._new_folder(),
            )
            self._zygotes.append(link)
            self._retire_zygotes()
        return link

    def _newest_zygote(self, program: Blob | None) -> ZygoteLink | None:
        for link in reversed(self._zygotes):
            if not link.retired and _same(link.program, program):
                return link
        return None

    def _retire_zygotes(self) -> None:
        """End zygotes without children whose program is no longer the newest."""
        newest = self._zygotes[-1].program if self._zygotes else None
        for link in self._zygotes:
            if not (link.children or link.retired or _same(link.program, newest)):
                link.retire()

    def _new_folder(self) -> str:
        directory = self._cleanup_directory()
        if directory is None:
            raise OSError("there is no directory for the program's files on this host")
        return os.path.join(directory, f"program-{next(self._folders)}")

    def _cleanup_directory(self) -> str | None:
        """Return the hub's directory, which the hub makes if needed; None without a hub."""
        self._access()
        return None if self._hub is None else self._hub.directory

    # Messages of zygotes, on the loop's thread

    def on_reply(self, link: ZygoteLink, reply: tuple[Any, ...]) -> None:
        """Handle a zygote's message about one of this agent's children."""
        child = self._children.get(reply[1])
        if child is None:
            self._on_reply_about_abandoned(link, reply)
        elif reply[0] == zygote.STARTED:
            child.pid = reply[2]
            child.release_descriptors()
            child.observer.started(reply[2])
        elif reply[0] == zygote.EXITED:
            reason, stack = self.describe_end(reply[2]), "".join(reply[3:])
            self._child_exited(child, reply[2], reason, stack=stack)
        elif reply[0] == zygote.FAILED:
            self._refused(child, reply[2])
        elif reply[0] == zygote.FORK_UNSAFE:
            self._restart_elsewhere(child, reply[2])

    def abandon(self, child: LocalChild) -> None:
        """Report the end of a child that was killed before its zygote forked it.

        The zygote may be busy for long, so the agent does not wait for it.
        """
        if child.pid is None and child.id in self._children:
            self._abandoned[child.id], child.slot = child.slot, None
            self._child_exited(child, -signal.SIGKILL, describe(-signal.SIGKILL))

    def _on_reply_about_abandoned(self, link: ZygoteLink, reply: tuple[Any, ...]) -> None:
        if reply[0] == zygote.STARTED:
            link.send(zygote.SIGNAL, reply[1], signal.SIGKILL)
        elif (slot := self._abandoned.pop(reply[1], None)) is not None:
            self.progress_table.release(slot)  # the child can no longer write to the slot

    def on_zygote_exit(self, link: ZygoteLink) -> None:
        """Report the end of all children of a zygote that died; they died with it."""
        if link in self._zygotes:
            self._zygotes.remove(link)
        orphaned = [child for child in self._children.values() if child.zygote is link]
        for child in orphaned:
            self._child_exited(
                child, -signal.SIGKILL, "killed by SIGKILL, together with its zygote"
            )

    def _restart_elsewhere(self, child: LocalChild, imports: Imports) -> None:
        """Start a child in a new zygote that imports ``imports``; forking the old one is unsafe.

        The new zygote then serves all later children.  Children of the old one live on.
        """
        if self._closed:
            return  # the end of its zygote ends the child
        old = child.zygote
        try:
            new = self._zygote(child.program, instead_of=old, imports=imports)
            child.fork_from(new, self._access())
        except Exception as error:
            self._refused(child, error)
            return
        if old is not None and not old.children:
            old.retire()

    def _refused(self, child: LocalChild, why: object) -> None:
        self._child_exited(child, 1, f"could not be started: {why}", Cause.REFUSED)

    def _child_exited(
        self,
        child: LocalChild,
        exitcode: int,
        reason: str,
        cause: Cause = Cause.CHILD,
        stack: str = "",
    ) -> None:
        del self._children[child.id]
        child.leave_zygote()
        self._retire_zygotes()
        unread, running = self._release(child)
        if child.fault is not None:
            reason = f"killed by its agent: {child.fault}"
        report = ExitReport(
            exitcode, reason, unread, running, host=self.host, cause=cause, stack=stack
        )
        child.observer.exited(report)

    def describe_end(self, exitcode: int) -> str:
        """Return an exit code in words, and whether the memory limit caused a SIGKILL."""
        if exitcode == -signal.SIGKILL and self.memory_limit.was_exceeded():
            return f"OOMKilled: {self.memory_limit.describe()}"
        return describe(exitcode)

    def _release(self, child: LocalChild) -> tuple[tuple[int, ...], tuple[int, int] | None]:
        """Free the child's channel and slot; return its unread packets and its running task."""
        unread = child.drain_and_close()
        if child.slot is None:
            return unread, None
        running = self.progress_table.running(child.slot)
        self.progress_table.release(child.slot)
        return unread, running


def _same(one: Blob | None, other: Blob | None) -> bool:
    return one is other or (one is not None and other is not None and one.digest == other.digest)


def describe(exitcode: int) -> str:
    """Return an exit code in words."""
    if exitcode >= 0:
        return f"exit status {exitcode}"
    try:
        return f"killed by {signal.Signals(-exitcode).name}"
    except ValueError:
        return f"killed by signal {-exitcode}"


_ROOT = "/sys/fs/cgroup"
_MEMBERSHIP = "/proc/self/cgroup"

_UNITS = (("Gi", 1 << 30), ("Mi", 1 << 20), ("Ki", 1 << 10))


class MemoryLimit:
    """Memory limit of the control group that this process is in."""

    def __init__(self, root: str = _ROOT, membership: str = _MEMBERSHIP) -> None:
        self._events, self._maximum = _files(root, membership)
        self._kills = self._count()

    def was_exceeded(self) -> bool:
        """Return whether the kernel has killed a process for memory since the last call."""
        before, self._kills = self._kills, self._count()
        return self._kills > before

    def describe(self) -> str:
        """Return a sentence with the limit as Kubernetes writes it."""
        limit = _read(self._maximum).strip()
        if limit.isdigit():
            return f"its memory limit is {_quantity(int(limit))}"
        return "no limit of its own"

    def _count(self) -> int:
        for line in _read(self._events).splitlines():
            name, _, count = line.partition(" ")
            if name == "oom_kill" and count.isdigit():
                return int(count)
        return 0


def _files(root: str, membership: str) -> tuple[str, str]:
    """Return the paths of the file that counts the deaths and the file with the limit."""
    groups = {}
    for line in _read(membership).splitlines():
        _, controllers, group = line.split(":", 2)
        groups[controllers] = group.rstrip("/")
    found = []
    # In a separate cgroup namespace the group is the root of the mount, under any name.
    for group in (groups.get("", ""), ""):
        found.append((f"{root}{group}/memory.events", f"{root}{group}/memory.max"))
    for group in (groups.get("memory", ""), ""):
        old = f"{root}/memory{group}"
        found.append((f"{old}/memory.oom_control", f"{old}/memory.limit_in_bytes"))
    return next((files for files in found if _read(files[0])), found[0])


def _quantity(limit: int) -> str:
    for unit, size in _UNITS:
        if limit % size == 0:
            return f"{limit // size}{unit}"
    return f"{limit} bytes"


def _read(path: str) -> str:
    try:
        with open(path, encoding="utf-8") as file:
            return file.read()
    except OSError:  # no such file, or no such group
        return ""
