"""One child of this host, as its agent holds it: its channel, its signals, its end.

``deliver``, ``recall`` and ``signal`` come from any thread and only append to outboxes; what
arrives is handled on the loop's thread, or by whoever attends to it.
"""

from __future__ import annotations

import os
import resource
import signal
import socket
import struct
import threading
from collections.abc import Sequence
from typing import Protocol

from fiber._agent import zygote
from fiber._agent.child import StartRequest, lineage
from fiber._agent.interface import ChildObserver, ChildSpec
from fiber._agent.progress import ProgressTable
from fiber._agent.zygote_link import ZygoteLink, close_all, dup_or_null
from fiber._hub.access import Access
from fiber._transport.loop import Loop
from fiber._transport.outbox import Outbox
from fiber._transport.unix import naming_the_limit, socketpair, wait_readable
from fiber._wire import packet
from fiber._wire.packet import BytesLike
from fiber.errors import TooManyOpenFiles

_SEQ = struct.Struct("<Q")
_ATTENTION = 5e-3
"""Seconds that a caller waits for a worker itself before it leaves the answer to the loop."""


class Owner(Protocol):
    """What a child needs of the agent that runs it."""

    host: str
    loop: Loop
    progress_table: ProgressTable

    def abandon(self, child: LocalChild) -> None:
        """It was killed before it was born.  On the loop's thread."""


class LocalChild:
    """One child of this host; a ``ChildHandle``."""

    def __init__(self, owner: Owner, id_: int, spec: ChildSpec, observer: ChildObserver) -> None:
        self.id = id_
        self.name = spec.name
        self.host = owner.host
        self.pid: int | None = None
        self.slot: int | None = None
        self.fault: Exception | None = None
        self.zygote: ZygoteLink | None = None
        self.observer = observer
        self._spec = spec
        self._fds = spec.fds
        self._owner = owner
        self._loop = owner.loop
        self._ours: socket.socket | None = None
        self._theirs: socket.socket | None = None
        self._outbox: Outbox | None = None
        self._hearing = threading.Lock()
        try:
            if spec.tasks:
                self._open_channel()
        except BaseException:
            self.release_descriptors()
            raise

    def _open_channel(self) -> None:
        slot = self._owner.progress_table.claim()
        try:
            ours, theirs = socketpair("starting a pool worker")
        except BaseException:
            self._owner.progress_table.release(slot)
            raise
        ours.setblocking(False)
        self.slot = slot
        # We keep the child's end too: what it has not read when it dies, or when another worker is
        # idle, is read from there.  The kernel gives each packet to exactly one reader.
        self._ours, self._theirs = ours, theirs
        self._outbox = Outbox(self._loop, ours)
        self._loop.register(ours.fileno(), self._receive)

    def start(self, zygote: ZygoteLink, hub: Access | None) -> None:
        """Have ``zygote`` start it; ``hub`` is what it is told of its host's hub."""
        self.zygote = zygote
        spec = self._spec
        fds = self._descriptors()
        request = StartRequest(
            spec.method,
            spec.preparation,
            spec.payload,
            self.slot,
            spec.executable,
            captured=spec.stdio is not None,
            open_files=resource.getrlimit(resource.RLIMIT_NOFILE),
            hub=hub,
            ancestors=lineage(),
        )
        zygote.start(self.id, request, fds)

    def _descriptors(self) -> list[int]:
        """New descriptors for the child: stdout, stderr, task channel, and those of its handles."""
        ours = [] if self._theirs is None else [self._theirs.fileno()]
        fds: list[int] = []
        try:
            with naming_the_limit("starting a process"):
                if self._spec.stdio is None:
                    fds += map(dup_or_null, (1, 2))
                fds += map(os.dup, [*(self._spec.stdio or ()), *ours, *self._fds])
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

    def recall(self) -> None:
        """Recall unread packets; answered on the loop."""
        self._loop.call_soon(self._send_recalled)

    def signal(self, signum: int) -> None:
        """Signal the child through its zygote."""
        if self.zygote is not None:
            self.zygote.send(zygote.SIGNAL, self.id, signum)
        if signum == signal.SIGKILL and self.pid is None:
            self._loop.call_soon(self._owner.abandon, self)

    def abort(self, fault: Exception) -> None:
        """Something to or from it is lost for good: only its end can tell the master so."""
        self.fault = self.fault or fault
        self.signal(signal.SIGKILL)

    def drain_and_close(self) -> tuple[int, ...]:
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

    def _send_recalled(self) -> None:
        if self._theirs is not None and self._theirs.fileno() >= 0:
            self.observer.recalled(self._recall())

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
            self.abort(error)
            return True
        try:
            self.observer.received(message)
        except Exception as error:
            self.abort(error)
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
                self.abort(error)
                continue
            seqs.append(_SEQ.unpack_from(message.payload)[0])
            message.release()
        return seqs + [_SEQ.unpack_from(payload)[0] for payload in self._outbox.recall()]
