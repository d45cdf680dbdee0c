"""The agent: starts, watches and kills the children of one host.

In a program with the local backend it lives in the program itself, on its loop; elsewhere it is a
process of its own (``python -m fiber.agent``) whose ``ChildObserver`` is the link to the master.

Who touches what: ``start``, ``deliver``, ``recall`` and ``signal`` come from any thread and only
append to outboxes or tables under ``_lock``; everything that arrives is handled on the loop's
thread.
"""

from __future__ import annotations

import itertools
import os
import signal
import threading
from typing import Any

from fiber._agent import zygote
from fiber._agent.interface import ChildObserver, ChildSpec, ExitReport
from fiber._agent.local_child import LocalChild
from fiber._agent.progress import ProgressTable
from fiber._agent.zygote_link import ZygoteLink, close_all
from fiber._hub import access
from fiber._hub.access import Access
from fiber._hub.hub import Hub
from fiber._transport.loop import Loop


class Agent:
    """Runs the children of this host; an ``AgentHandle``."""

    def __init__(self, loop: Loop, host: str, hub: Hub | None = None) -> None:
        self.host = host
        self.loop = loop
        self.progress_table = ProgressTable()
        self._hub = hub
        self._lock = threading.Lock()
        self._ids = itertools.count(1)
        self._children: dict[int, LocalChild] = {}
        self._abandoned: dict[int, int | None] = {}
        self._zygotes: list[ZygoteLink] = []
        self._closed = False

    def start(self, spec: ChildSpec, observer: ChildObserver) -> LocalChild:
        """Start a child; it has its pid when ``observer.started`` is called."""
        with self._lock:
            if self._closed:
                close_all(spec.fds)
                raise RuntimeError("this process is ending: no process can be started any more")
            child = LocalChild(self, next(self._ids), spec, observer)
            self._children[child.id] = child
            try:
                child.start(self._zygote(), self._access())
            except BaseException:
                del self._children[child.id]
                self.loop.call_soon(self._release, child)
                raise
        return child

    def close(self) -> None:
        """Kill every child and end the zygotes.  Not on the loop's thread."""
        with self._lock:
            self._closed = True
            zygotes, self._zygotes = self._zygotes, []
        for link in zygotes:
            link.quit()
        self.loop.call_soon(self.progress_table.close)

    def _access(self) -> Access | None:
        """What our children are told of this host's hub."""
        return self._hub.access if self._hub is not None else access.told()

    def _zygote(self, *, preload: bool = True) -> ZygoteLink:
        if not self._zygotes or not preload:
            directory = None if self._hub is None else os.path.dirname(self._hub.access.address)
            self._zygotes.append(
                ZygoteLink(self, self.loop, self.progress_table.fd, directory, preload=preload)
            )
        return self._zygotes[-1]

    # What zygotes say, on the loop's thread

    def on_reply(self, link: ZygoteLink, reply: tuple[Any, ...]) -> None:
        """A reply of a zygote about one of our children."""
        child = self._children.get(reply[1])
        if child is None:
            self._on_reply_about_abandoned(link, reply)
        elif reply[0] == zygote.STARTED:
            child.pid = reply[2]
            child.release_descriptors()
            child.observer.started(reply[2])
        elif reply[0] == zygote.EXITED:
            self._child_exited(child, reply[2], describe(reply[2]))
        elif reply[0] == zygote.FAILED:
            self._child_exited(child, 1, f"could not be started: {reply[2]}")
        elif reply[0] == zygote.FORK_UNSAFE:
            self._restart_elsewhere(child)

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
        with self._lock:
            if link in self._zygotes:
                self._zygotes.remove(link)
            orphaned = [child for child in self._children.values() if child.zygote is link]
        for child in orphaned:
            self._child_exited(
                child, -signal.SIGKILL, "killed by SIGKILL, together with its zygote"
            )

    def _restart_elsewhere(self, child: LocalChild) -> None:
        """Its zygote must not be forked: one that imports nothing serves it and all after it.

        What the old one runs already lives on there.
        """
        try:
            with self._lock:
                if self._closed:
                    return  # and the end of its zygote is its own
                old = child.zygote
                child.start(self._zygote(preload=self._zygotes[-1] is not old), self._access())
                unused = all(other.zygote is not old for other in self._children.values())
        except Exception as error:
            self._child_exited(child, 1, f"could not be started: {error}")
            return
        if unused and old is not None:
            old.send(zygote.QUIT)

    def _child_exited(self, child: LocalChild, exitcode: int, reason: str) -> None:
        with self._lock:
            del self._children[child.id]
        unread, running = self._release(child)
        if child.fault is not None:
            reason = f"killed by its agent: {child.fault}"
        child.observer.exited(ExitReport(exitcode, reason, unread, running, host=self.host))

    def _release(self, child: LocalChild) -> tuple[tuple[int, ...], tuple[int, int] | None]:
        """Give back what it had; what it never read and what it was running."""
        unread = child.drain_and_close()
        if child.slot is None:
            return unread, None
        running = self.progress_table.running(child.slot)
        self.progress_table.release(child.slot)
        return unread, running


def describe(exitcode: int) -> str:
    """An exit code in words."""
    if exitcode >= 0:
        return f"exit status {exitcode}"
    try:
        return f"killed by {signal.Signals(-exitcode).name}"
    except ValueError:
        return f"killed by signal {-exitcode}"
