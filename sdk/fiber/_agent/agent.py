"""The agent: starts, watches and kills the children of one host.

In a program with the local backend it lives in the program itself, on its loop; elsewhere it is a
process of its own (``python -m fiber.agent``) whose ``ChildObserver`` is the link to the master.

Everything happens on the loop's thread.  ``child``, which changes nothing here, and a child's
``recall`` and ``signal``, which only put into the loop's queue, come from anywhere; so no lock is
needed that a finalizer or a signal handler could meet.
"""

from __future__ import annotations

import itertools
import os
import signal
import threading
from typing import Any

from fiber._agent import zygote
from fiber._agent.interface import Cause, ChildObserver, ChildSpec, ExitReport
from fiber._agent.local_child import LocalChild
from fiber._agent.memory_limit import MemoryLimit
from fiber._agent.preload import Imports
from fiber._agent.progress import ProgressTable
from fiber._agent.zygote_link import ZygoteLink
from fiber._hub import client as hub_client
from fiber._hub.hub import Hub
from fiber._hub.protocol import HubAddress
from fiber._transport.loop import Loop
from fiber._wire.blob import Blob

_ENDING = "this process is ending: no process can be started any more"

_CLOSE_TIMEOUT = 10.0
"""Seconds that the loop may take to come to the end of what it was asked before."""


class Agent:
    """Runs the children of this host."""

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
        """A child to be started; it has its pid when ``observer.started`` is called.

        What keeps it from starting is its ``exited``, but for what can be seen here and now.
        """
        if self._closed:
            spec.close()
            raise RuntimeError(_ENDING)
        return LocalChild(self, next(self._ids), spec, observer)

    def start(self, child: LocalChild) -> None:
        """Start one of our children."""
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
        """Kill every child and end the zygotes.  Not on the loop's thread."""
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
        """What our children are told of this host's hub."""
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
        """Return the zygote of ``program``'s children; a new one makes ``imports``."""
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
        """End those of a program that has changed since, once they have no children."""
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
        """The hub's directory, made now if there is to be one."""
        self._access()
        return None if self._hub is None else self._hub.directory

    # What zygotes say, on the loop's thread

    def on_reply(self, link: ZygoteLink, reply: tuple[Any, ...]) -> None:
        """An answer of a zygote about one of our children."""
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
        """It was killed before it was born, and its zygote may be busy for long: it is gone now."""
        if child.pid is None and child.id in self._children:
            self._abandoned[child.id], child.slot = child.slot, None
            self._child_exited(child, -signal.SIGKILL, describe(-signal.SIGKILL))

    def _on_reply_about_abandoned(self, link: ZygoteLink, reply: tuple[Any, ...]) -> None:
        if reply[0] == zygote.STARTED:
            link.send(zygote.SIGNAL, reply[1], signal.SIGKILL)
        elif (slot := self._abandoned.pop(reply[1], None)) is not None:
            self.progress_table.release(slot)  # it can no longer write there

    def on_zygote_exit(self, link: ZygoteLink) -> None:
        """A zygote died, and its children with it."""
        if link in self._zygotes:
            self._zygotes.remove(link)
        orphaned = [child for child in self._children.values() if child.zygote is link]
        for child in orphaned:
            self._child_exited(
                child, -signal.SIGKILL, "killed by SIGKILL, together with its zygote"
            )

    def _restart_elsewhere(self, child: LocalChild, imports: Imports) -> None:
        """Start a child whose zygote must not be forked in one that makes ``imports`` alone.

        The same zygote then serves all later children.  Those of the old one live on.
        """
        if self._closed:
            return  # and the end of its zygote is its own
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
        """An exit code in words, with what the kernel knows of a SIGKILL."""
        if exitcode == -signal.SIGKILL and self.memory_limit.was_exceeded():
            return f"OOMKilled: {self.memory_limit.describe()}"
        return describe(exitcode)

    def _release(self, child: LocalChild) -> tuple[tuple[int, ...], tuple[int, int] | None]:
        """Give back what it had; what it never read and what it was running."""
        unread = child.drain_and_close()
        if child.slot is None:
            return unread, None
        running = self.progress_table.running(child.slot)
        self.progress_table.release(child.slot)
        return unread, running


def _same(one: Blob | None, other: Blob | None) -> bool:
    return one is other or (one is not None and other is not None and one.digest == other.digest)


def describe(exitcode: int) -> str:
    """An exit code in words."""
    if exitcode >= 0:
        return f"exit status {exitcode}"
    try:
        return f"killed by {signal.Signals(-exitcode).name}"
    except ValueError:
        return f"killed by signal {-exitcode}"
