"""A child of this host, as its agent holds it, and the link to the zygote that forks it.

Any thread may call a child's ``recall`` and ``signal``, which only put a call into the loop's
queue. All other methods run on the loop's thread, except those of a lent ``Channel``, which its
user calls.
"""

from __future__ import annotations

import os
import pickle
import resource
import select
import signal
import socket
import struct
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol

from fiber._agent import zygote, zygote_process
from fiber._agent.child import StartRequest, lineage
from fiber._agent.interface import ChildObserver, ChildSpec
from fiber._agent.last_words import ProgressTable
from fiber._agent.preload import Imports
from fiber._agent.zygote_process import is_standard_stream
from fiber._hub.protocol import HubAddress
from fiber._transport.channels import Outbox, naming_the_limit, socketpair
from fiber._transport.loop import Loop
from fiber._wire import packet
from fiber._wire.memory_files import Blob, BytesLike
from fiber._wire.packet import Message
from fiber.errors import TooManyOpenFiles

_SEQ = struct.Struct("<Q")

_NO_ROOM = (TooManyOpenFiles, MemoryError)
_LOST = (*_NO_ROOM, ValueError, struct.error)
"""Errors that lose a packet: it was taken from its socket and cannot be delivered."""


class Owner(Protocol):
    """Part of the agent that its children use."""

    host: str
    loop: Loop
    progress_table: ProgressTable

    def start(self, child: LocalChild) -> None:
        """Start ``child``.  Runs on the loop's thread."""

    def abandon(self, child: LocalChild) -> None:
        """Report the end of ``child``, killed before its fork.  Runs on the loop's thread."""


class LocalChild:
    """A child of this host; a ``ChildHandle``."""

    def __init__(self, owner: Owner, id_: int, spec: ChildSpec, observer: ChildObserver) -> None:
        self.id = id_
        self.name = spec.name
        self.host = owner.host
        self.node = ""
        self.pid: int | None = None
        self.waiting = False
        self.leaving = ""
        self.slot: int | None = None
        self.start_error: Exception | None = None
        self.fault: Exception | None = None
        self.zygote: ZygoteLink | None = None
        self.observer = observer
        self._spec = spec
        self._owner = owner
        self._loop = owner.loop
        self._ours: socket.socket | None = None
        self._theirs: socket.socket | None = None
        self._outbox: Outbox | None = None
        self._lent = False

    def start(self) -> None:
        """Start the child.  Calls that follow in the same turn of the loop find it registered."""
        self._owner.start(self)

    def _make_channel(self) -> None:
        slot = self._owner.progress_table.claim()
        try:
            ours, theirs = socketpair("starting a pool worker")
        except BaseException:
            self._owner.progress_table.release(slot)
            raise
        ours.setblocking(False)
        self.slot = slot
        # The agent keeps the child's end too.  From there it takes back packets that the child has
        # not read, when the child dies or another worker is idle.  The kernel gives each packet to
        # exactly one reader.
        self._ours, self._theirs = ours, theirs

    def open(self) -> None:
        """Make the task channel of a pool worker and begin to receive from it."""
        if self._spec.tasks:
            self._make_channel()
        if self._ours is not None:
            self._outbox = Outbox(self._loop, self._ours)
            self._loop.register(self._ours.fileno(), self._receive)

    def fork_from(self, zygote: ZygoteLink, hub: HubAddress | None) -> None:
        """Have ``zygote`` start the child; ``hub`` is the address of the host's hub."""
        self.leave_zygote()
        self.zygote = zygote
        zygote.children += 1
        spec = self._spec
        fds = self._descriptors()
        request = StartRequest(
            spec.name,
            self.host,
            spec.method,
            spec.preparation,
            spec.payload,
            self.slot,
            spec.executable,
            open_files=resource.getrlimit(resource.RLIMIT_NOFILE),
            hub=hub,
            ancestors=lineage(),
            folder=zygote.folder,
            has_arguments=spec.arguments is not None,
            payload_at=None if spec.payload_at is None else spec.payload_at[1:],
        )
        zygote.start(self.id, request, fds)

    def leave_zygote(self) -> None:
        """Stop counting the child among those of its zygote: it is gone, or gets another one."""
        if self.zygote is not None:
            self.zygote.children -= 1

    def _descriptors(self) -> list[int]:
        """Return new descriptors for the child: stdout, stderr, task channel, arguments, a large
        payload, and those of its handles.
        """
        ours = [] if self._theirs is None else [self._theirs.fileno()]
        if self._spec.arguments is not None:
            ours.append(self._spec.arguments.fileno())
        if self._spec.payload_at is not None:
            ours.append(self._spec.payload_at[0].fileno())
        fds: list[int] = []
        try:
            with naming_the_limit("starting a process"):
                if self._spec.stdio is None:
                    fds += map(dup_or_null, (1, 2))
                handed = [owner.fileno() for owner in self._spec.fds]
                fds += map(os.dup, [*(self._spec.stdio or ()), *ours, *handed])
        except BaseException:
            close_all(fds)
            raise
        return fds

    @property
    def tasks(self) -> bool:
        """True for a pool worker."""
        return self._spec.tasks

    @property
    def program(self) -> Blob | None:
        """Files of the program that the child needs; None once the child is started."""
        return self._spec.program

    def release_descriptors(self) -> None:
        """Close the agent's copies of the child's handles, and free its payload.

        Otherwise the other end would not see EOF when the child closes its own copies.
        """
        self._spec.close()
        self._spec = replace(
            self._spec, payload=b"", payload_at=None, fds=(), program=None, arguments=None
        )

    def deliver(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send a packet to the worker; return False if the worker is gone."""
        outbox = self._outbox
        return outbox is not None and outbox.send(b"".join((_SEQ.pack(seq), payload)), buffers)

    def lend(self) -> Channel | None:
        """Return the channel for direct use; None if there is none, or no descriptor is left."""
        if self._ours is None or self._ours.fileno() < 0:
            return None
        try:
            # A duplicate, since the kernel may reuse the number of a closed descriptor while the
            # user of the channel waits on it.
            fd = os.dup(self._ours.fileno())
        except OSError:
            return None
        self._loop.pause(self._ours.fileno())
        self._lent = True
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET, fileno=fd)
        return Channel(sock, self.abort)

    def reclaim(self) -> None:
        """Receive the child's packets again, after ``lend``."""
        self._lent = False
        self.resume()

    def pause(self) -> None:
        """Receive no packets until ``resume``; the child blocks once the socket is full."""
        if self._ours is not None and self._ours.fileno() >= 0:
            self._loop.pause(self._ours.fileno())

    def resume(self) -> None:
        """Receive the child's packets again, after ``pause``."""
        if self._ours is not None and self._ours.fileno() >= 0:
            self._loop.resume(self._ours.fileno())

    def recall(self) -> None:
        """Take back unread packets; ``observer.recalled`` gets the answer on the loop's thread."""
        self._loop.call_soon(self._send_recalled)

    def signal(self, signum: int) -> None:
        """Signal the child through its zygote."""
        if self._loop.broken:
            self._signal(signum)  # the loop runs no calls
        else:
            self._loop.call_soon(self._signal, signum)

    def _signal(self, signum: int) -> None:
        if self.zygote is not None:
            self.zygote.send(zygote.SIGNAL, self.id, signum)
        if signum == signal.SIGKILL and self.pid is None:
            self._owner.abandon(self)

    def abort(self, fault: Exception) -> None:
        """Kill the child because a packet to or from it is lost; its exit report says so."""
        self.fault = self.fault or fault
        self.signal(signal.SIGKILL)

    def drain_and_close(self) -> tuple[int, ...]:
        """Pass on the dead child's last packets, close its channel and return the unread packets.

        Runs on the loop's thread.
        """
        self.release_descriptors()
        if self._ours is None or self._theirs is None:
            return ()
        if self._outbox is None:  # the channel was never opened
            self._ours.close()
            self._theirs.close()
            return ()
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
        if not self._lent:  # an event from before ``lend``: its packet is for the channel's user
            self._hear()

    def _hear(self) -> bool:
        assert self._ours is not None
        try:
            message = packet.receive(self._ours, passing=self._spec.passing)
        except (BlockingIOError, EOFError):
            return False
        except _LOST as error:  # else the master would wait for this packet
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
            except _NO_ROOM as error:
                self.abort(error)
                continue
            seqs.append(_SEQ.unpack_from(message.payload)[0])
            message.release()
        return seqs + [_SEQ.unpack_from(payload)[0] for payload in self._outbox.recall()]


class Channel:
    """Task channel of a child, for direct use; a ``DirectChannel``."""

    def __init__(self, sock: socket.socket, abort: Callable[[Exception], None]) -> None:
        self._sock = sock
        self._abort = abort
        self._poller = select.poll()
        self._poller.register(sock, select.POLLIN)

    def send(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send a packet; raise OSError if that fails."""
        packet.send(self._sock, b"".join((_SEQ.pack(seq), payload)), buffers)

    def receive(self, timeout: float) -> Message | None:
        """Return the next packet, or None after ``timeout`` seconds; raise EOFError at the end."""
        if not self._poller.poll(timeout * 1000):
            return None
        try:
            return packet.receive(self._sock)
        except BlockingIOError:  # the agent took the packet, since the child died
            return None
        except _NO_ROOM as error:
            self._abort(error)
            raise

    def close(self) -> None:
        """Close this channel's descriptor."""
        self._sock.close()

    def __del__(self) -> None:
        self._sock.close()


_QUIT_TIMEOUT = 10.0


class ZygoteObserver(Protocol):
    """Receiver of a zygote's packets.  Called on the loop's thread."""

    def on_reply(self, link: ZygoteLink, reply: tuple[Any, ...]) -> None:
        """Handle an event of a child."""

    def on_zygote_exit(self, link: ZygoteLink) -> None:
        """Handle the death of the zygote and its children.  Called once, and last."""


class ZygoteLink:
    """Link of an agent to one zygote process."""

    def __init__(
        self,
        observer: ZygoteObserver,
        loop: Loop,
        progress_table: int,
        cleanup_directory: Callable[[], str | None],
        *,
        imports: Imports | None,
        program: Blob | None = None,
        folder: str | None = None,
    ) -> None:
        """Start the zygote's process.

        ``imports``: as in ``zygote.Zygote``.  ``program``: files that the zygote unpacks to
        ``folder``, for its children.
        """
        self.program = program
        self.folder = folder
        self.retired = False
        """True once the zygote gets no further children."""
        self.children = 0
        """Number of children that the zygote has or was asked for."""
        self._observer = observer
        self._loop = loop
        self._gone = threading.Event()
        self._has_replied = False
        self._asked: deque[int] = deque()
        """Children that the zygote has not answered for yet, in the order of its answers."""
        with naming_the_limit("starting the zygote"):
            fds = [os.dup(progress_table)]  # the outbox closes what it sends
            try:
                if program is not None:
                    fds.append(os.dup(program.fileno()))
                self._process, self._sock = zygote_process.launch()
            except BaseException:
                close_all(fds)
                raise
        self._sock.setblocking(False)
        self._outbox = Outbox(loop, self._sock)
        # The directory is made at the last moment: from here on the zygote removes it if the agent
        # is killed.
        setup = (zygote.SETUP, lineage(), imports, cleanup_directory(), folder)
        self._outbox.send(pickle.dumps(setup), fds=fds)
        loop.register(self._sock.fileno(), self._receive)

    def start(self, child: int, request: StartRequest, fds: list[int]) -> None:
        """Request a child that gets ``fds``, which this object closes."""
        self._asked.append(child)
        while len(fds) > packet.MAX_DESCRIPTORS:
            some, fds = fds[: packet.MAX_DESCRIPTORS], fds[packet.MAX_DESCRIPTORS :]
            self._outbox.send(pickle.dumps((zygote.DESCRIPTORS, child)), fds=some)
        self._outbox.send(pickle.dumps((zygote.START, child, tuple(request)), protocol=5), fds=fds)

    def retire(self) -> None:
        """End the zygote, which has no children, and request no more children from it."""
        self.retired = True
        self.send(zygote.QUIT)

    def send(self, *request: Any) -> None:
        """Send another request.  Runs on the loop's thread, as ``start``."""
        self._outbox.send(pickle.dumps(request))

    def quit(self) -> None:
        """End the zygote and its children, and wait.  Must not be called on the loop's thread."""
        if self._has_replied:
            self._loop.call_soon(self.send, zygote.QUIT)
            if not self._loop.running:
                self.send(zygote.QUIT)
        else:
            # The zygote has no child yet, and may import the program's main module for ever.
            self._process.kill()
        try:
            self._process.wait(_QUIT_TIMEOUT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._loop.running:
            # The zygote's last packets report the ends of its children.
            self._gone.wait(_QUIT_TIMEOUT)
        else:
            self._outbox.close()
            self._sock.close()

    def _receive(self) -> None:
        try:
            reply = packet.loads(packet.receive(self._sock))
        except BlockingIOError:
            return
        except (EOFError, ConnectionError):
            self._loop.unregister(self._sock.fileno())
            self._outbox.close()
            self._sock.close()
            self._process.wait()
            self._observer.on_zygote_exit(self)
            self._gone.set()
            return
        self._has_replied = True
        self._observer.on_reply(self, self._completed(reply))

    def _completed(self, reply: tuple[Any, ...]) -> tuple[Any, ...]:
        """Return ``reply`` with the child that it is about, if the zygote could not name it."""
        kind, child, *rest = reply
        if kind != zygote.EXITED and self._asked and child in (None, self._asked[0]):
            child = self._asked.popleft()
        return kind, child, *rest


def dup_or_null(fd: int) -> int:
    return os.dup(fd) if is_standard_stream(fd) else os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)


def close_all(fds: Sequence[int]) -> None:
    for fd in fds:
        os.close(fd)
