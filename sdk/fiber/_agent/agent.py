"""The agent: starts, watches and kills the children of one host.

In a program with the local backend it lives in the program itself, on its loop; elsewhere it is a
process of its own (``python -m fiber.agent``) whose ``ChildObserver`` is the link to the master.

Who touches what: ``start``, ``deliver``, ``take_back`` and ``signal`` come from any thread and only
append to outboxes or tables under ``_lock``; everything that arrives is handled on the loop's
thread.
"""

from __future__ import annotations

import itertools
import os
import signal
import socket
import struct
import threading
from collections.abc import Sequence
from typing import Any

from fiber._agent import zygote
from fiber._agent.board import Board
from fiber._agent.port import ChildObserver, ChildSpec, ExitReport
from fiber._agent.zygote_link import ZygoteLink, close_all, dup_or_null
from fiber._hub import client as hub_client
from fiber._hub.hub import Hub
from fiber._hub.protocol import HubAddress
from fiber._transport.loop import Loop
from fiber._transport.outbox import Outbox
from fiber._transport.unix import naming_the_limit, socketpair, wait_readable
from fiber._wire import packet
from fiber._wire.packet import BytesLike
from fiber.errors import TooManyOpenFiles

_SEQ = struct.Struct("<Q")
_ATTENTION = 5e-3
"""Seconds that a caller waits for a worker itself before it leaves the answer to the loop."""


class Agent:
    """Runs the children of this host; an ``AgentPort``."""

    def __init__(self, loop: Loop, host: str, hub: Hub | None = None) -> None:
        self.host = host
        self._hub = hub
        self._loop = loop
        self._lock = threading.Lock()
        self._ids = itertools.count(1)
        self._children: dict[int, LocalChild] = {}
        self._forsaken: dict[int, int | None] = {}
        self._board = Board()
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
                child.zygote = self._zygote()
                child.zygote.request(child)
            except BaseException:
                del self._children[child.id]
                self._loop.call_soon(self._bury, child)
                raise
        return child

    def close(self) -> None:
        """Kill every child and end the zygotes.  Not on the loop's thread."""
        with self._lock:
            self._closed = True
            zygotes, self._zygotes = self._zygotes, []
        for link in zygotes:
            link.quit()
        self._loop.call_soon(self._board.close)

    def access(self) -> HubAddress | None:
        """What our children are told of this host's hub."""
        if self._hub is None:
            return hub_client.inherited_address()
        return self._hub.address_or_problem

    def _zygote(self, *, preload: bool = True) -> ZygoteLink:
        if not self._zygotes or not preload:
            self.access()  # makes the hub's directory, if there is to be one
            directory = None if self._hub is None else self._hub.directory
            self._zygotes.append(
                ZygoteLink(self, self._loop, self._board.fd, directory, preload=preload)
            )
        return self._zygotes[-1]

    # What zygotes say, on the loop's thread

    def heard(self, link: ZygoteLink, answer: tuple[Any, ...]) -> None:
        """An answer of a zygote about one of our children."""
        child = self._children.get(answer[1])
        if child is None:
            self._heard_of_forsaken(link, answer)
        elif answer[0] == zygote.STARTED:
            child.pid = answer[2]
            child.release_descriptors()
            child.observer.started(answer[2])
        elif answer[0] == zygote.EXITED:
            self._gone(child, answer[2], describe(answer[2]))
        elif answer[0] == zygote.FAILED:
            self._gone(child, 1, f"could not be started: {answer[2]}")
        elif answer[0] == zygote.UNFIT:
            self._start_elsewhere(child)

    def forsake(self, child: LocalChild) -> None:
        """It was killed before it was born, and its zygote may be busy for long: it is gone now."""
        if child.pid is None and child.id in self._children:
            self._forsaken[child.id], child.slot = child.slot, None
            self._gone(child, -signal.SIGKILL, describe(-signal.SIGKILL))

    def _heard_of_forsaken(self, link: ZygoteLink, answer: tuple[Any, ...]) -> None:
        if answer[0] == zygote.STARTED:
            link.send(zygote.SIGNAL, answer[1], signal.SIGKILL)
        elif (slot := self._forsaken.pop(answer[1], None)) is not None:
            self._board.release(slot)  # it can no longer write there

    def zygote_gone(self, link: ZygoteLink) -> None:
        """A zygote died, and its children with it."""
        with self._lock:
            if link in self._zygotes:
                self._zygotes.remove(link)
            bereft = [child for child in self._children.values() if child.zygote is link]
        for child in bereft:
            self._gone(child, -signal.SIGKILL, "killed by SIGKILL, together with its zygote")

    def _start_elsewhere(self, child: LocalChild) -> None:
        """Its zygote must not be forked: one that imports nothing serves it and all after it.

        What the old one runs already lives on there.
        """
        try:
            with self._lock:
                if self._closed:
                    return  # and the end of its zygote is its own
                old = child.zygote
                child.zygote = self._zygote(preload=self._zygotes[-1] is not old)
                child.zygote.request(child)
                deserted = all(other.zygote is not old for other in self._children.values())
        except Exception as error:
            self._gone(child, 1, f"could not be started: {error}")
            return
        if deserted and old is not None:
            old.send(zygote.QUIT)

    def _gone(self, child: LocalChild, exitcode: int, reason: str) -> None:
        with self._lock:
            del self._children[child.id]
        unread, running = self._bury(child)
        if child.fault is not None:
            reason = f"killed by its agent: {child.fault}"
        child.observer.exited(ExitReport(exitcode, reason, unread, running, host=self.host))

    def _bury(self, child: LocalChild) -> tuple[tuple[int, ...], tuple[int, int] | None]:
        """Give back what it had; what it never read and what it was running."""
        unread = child.hang_up()
        if child.slot is None:
            return unread, None
        running = self._board.running(child.slot)
        self._board.release(child.slot)
        return unread, running


class LocalChild:
    """One child of this host; a ``ChildPort``."""

    def __init__(self, agent: Agent, id_: int, spec: ChildSpec, observer: ChildObserver) -> None:
        self.id = id_
        self.name = spec.name
        self.host = agent.host
        self.pid: int | None = None
        self.slot: int | None = None
        self.fault: Exception | None = None
        self.zygote: ZygoteLink | None = None
        self.observer = observer
        self.spec = spec
        self._fds = spec.fds
        self._agent = agent
        self._loop = agent._loop
        self._ours: socket.socket | None = None
        self._theirs: socket.socket | None = None
        self._outbox: Outbox | None = None
        self._hearing = threading.Lock()
        try:
            if spec.tasks:
                self._open_channel(agent)
        except BaseException:
            self.release_descriptors()
            raise

    def _open_channel(self, agent: Agent) -> None:
        slot = agent._board.claim()
        try:
            ours, theirs = socketpair("starting a pool worker")
        except BaseException:
            agent._board.release(slot)
            raise
        ours.setblocking(False)
        self.slot = slot
        # We keep the child's end too: what it has not read when it dies, or when another worker is
        # idle, is read from there.  The kernel gives each packet to exactly one reader.
        self._ours, self._theirs = ours, theirs
        self._outbox = Outbox(self._loop, ours)
        self._loop.register(ours.fileno(), self._receive)

    def descriptors(self) -> list[int]:
        """New descriptors for the child: stdout, stderr, task channel, and those of its handles."""
        ours = [] if self._theirs is None else [self._theirs.fileno()]
        fds: list[int] = []
        try:
            with naming_the_limit("starting a process"):
                if self.spec.stdio is None:
                    fds += map(dup_or_null, (1, 2))
                fds += map(os.dup, [*(self.spec.stdio or ()), *ours, *self._fds])
        except BaseException:
            close_all(fds)
            raise
        return fds

    def release_descriptors(self) -> None:
        """It has its own now: the other end must see EOF when the child lets go."""
        fds, self._fds = self._fds, ()
        close_all(fds)

    def deliver(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send a packet to the worker; False if it is gone."""
        outbox = self._outbox
        return outbox is not None and outbox.send(b"".join((_SEQ.pack(seq), payload)), buffers)

    def attend(self) -> bool:
        """Wait for its answer in place of the loop."""
        ours = self._ours
        if ours is None or self._loop.on_thread() or not self._hearing.acquire(blocking=False):
            return False
        try:
            fd = ours.fileno()
            if fd < 0:
                return False
            self._loop.pause(fd)
            try:
                return wait_readable(fd, _ATTENTION) and self._hear()
            finally:
                self._loop.resume(fd)
        finally:
            self._hearing.release()

    def take_back(self) -> None:
        """Recall unread packets; answered on the loop."""
        self._loop.call_soon(self._answer_take_back)

    def signal(self, signum: int) -> None:
        """Signal the child through its zygote."""
        if self.zygote is not None:
            self.zygote.send(zygote.SIGNAL, self.id, signum)
        if signum == signal.SIGKILL and self.pid is None:
            self._loop.call_soon(self._agent.forsake, self)

    def condemn(self, fault: Exception) -> None:
        """Something to or from it is lost for good: only its end can tell the master so."""
        self.fault = self.fault or fault
        self.signal(signal.SIGKILL)

    def hang_up(self) -> tuple[int, ...]:
        """It is gone: hear its last words, recall what it never read.  On the loop."""
        self.release_descriptors()
        if self._ours is None or self._theirs is None or self._outbox is None:
            return ()
        with self._hearing:
            while self._hear():
                pass
            unread = self._recall()
            self._loop.unregister(self._ours.fileno())
            self._outbox.close()
            self._ours.close()
            self._theirs.close()
        return tuple(unread)

    def _answer_take_back(self) -> None:
        if self._theirs is not None and self._theirs.fileno() >= 0:
            self.observer.taken_back(self._recall())

    def _receive(self) -> None:
        # Whoever attends to it already hears it, in order.
        if self._hearing.acquire(blocking=False):
            try:
                self._hear()
            finally:
                self._hearing.release()

    def _hear(self) -> bool:
        assert self._ours is not None
        try:
            message = packet.receive(self._ours)
        except (BlockingIOError, EOFError):
            return False
        except TooManyOpenFiles as error:
            self.condemn(error)
            return True
        try:
            self.observer.said(message)
        except Exception as error:
            self.condemn(error)
            raise
        return True

    def _recall(self) -> list[int]:
        assert self._theirs is not None
        assert self._outbox is not None
        seqs = []
        while True:
            try:
                message = packet.receive(self._theirs, wait=False)
            except (BlockingIOError, EOFError):
                break
            except TooManyOpenFiles as error:
                self.condemn(error)
                continue
            seqs.append(_SEQ.unpack_from(message.payload)[0])
            message.release()
        return seqs + [_SEQ.unpack_from(payload)[0] for payload in self._outbox.recall()]


def describe(exitcode: int) -> str:
    """An exit code in words."""
    if exitcode >= 0:
        return f"exit status {exitcode}"
    try:
        return f"killed by {signal.Signals(-exitcode).name}"
    except ValueError:
        return f"killed by signal {-exitcode}"
