"""The agent: starts, watches and kills the children of one host.

With the local backend the agent runs inside the program, on the program's loop.  Elsewhere it is a
separate process (``python -m fiber.agent``), whose observers send events over the link.

The agent runs on the loop thread.  Any thread may call ``Agent.child``, which registers nothing,
and a child's ``recall`` and ``signal``, which only put a call into the loop's queue.  So the agent
needs no lock, on which a finalizer or a signal handler could block.
"""

from __future__ import annotations

import itertools
import os
import resource
import select
import signal
import socket
import struct
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from fiber._agent import zygote
from fiber._agent.child import StartRequest, lineage
from fiber._agent.interface import OUT_OF_MEMORY, Cause, ChildObserver, ChildSpec, ExitReport
from fiber._agent.last_words import MemoryLimit, ProgressTable, describe
from fiber._agent.preload import Imports
from fiber._agent.usage import usage_of
from fiber._agent.zygote_link import ZygoteLink
from fiber._agent.zygote_process import is_standard_stream
from fiber._hub import client as hub_client
from fiber._hub.hub import Hub
from fiber._hub.protocol import HubAddress
from fiber._transport.channels import Outbox, naming_the_limit, socketpair
from fiber._transport.loop import Loop
from fiber._wire import packet
from fiber._wire.memory_files import Blob, BytesLike
from fiber._wire.packet import Message
from fiber.errors import TooManyOpenFiles

_ENDING = "this process is ending, so it starts no process"

_CLOSE_TIMEOUT = 10.0
"""Seconds that the loop may take to run the calls that were queued before the close."""


class Agent:
    """Agent of this host, which runs the host's children."""

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
        """Kill every child and end the zygotes.  Must not be called on the loop thread."""
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
                self.loop,
                self.progress_table.fd,
                self._cleanup_directory,
                on_reply=self._on_reply,
                on_exit=self._on_zygote_exit,
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

    # Messages of zygotes, on the loop thread

    def _on_reply(self, link: ZygoteLink, reply: tuple[Any, ...]) -> None:
        """Handle a zygote's message about one of this agent's children."""
        child = self._children.get(reply[1])
        if child is None:
            self._on_reply_about_abandoned(link, reply)
        elif reply[0] == zygote.STARTED:
            child.started(reply[2])
        elif reply[0] == zygote.EXITED:
            reason, stack = self.describe_end(reply[2]), "".join(reply[3:])
            self._child_exited(child, reply[2], reason, stack=stack)
        elif reply[0] == zygote.FAILED:
            self._refused(child, reply[2])
        elif reply[0] == zygote.STACK:
            child.observer.showed_stack(reply[2])
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
        elif reply[0] == zygote.STACK:
            return
        elif (slot := self._abandoned.pop(reply[1], None)) is not None:
            self.progress_table.release(slot)  # the child can no longer write to the slot

    def _on_zygote_exit(self, link: ZygoteLink) -> None:
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
        if self._hub is not None:
            self._hub.read_from_ended()  # what the child has sent comes before its report
        report = ExitReport(
            exitcode, reason, unread, running, host=self.host, cause=cause, stack=stack
        )
        child.observer.exited(report)

    def describe_end(self, exitcode: int) -> str:
        """Return an exit code in words, and whether the memory limit caused a SIGKILL."""
        if exitcode == -signal.SIGKILL and self.memory_limit.was_exceeded():
            return f"{OUT_OF_MEMORY}: {self.memory_limit.describe()}"
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


class LocalBackend(Agent):
    """Backend whose children are subprocesses of this program: an agent in this process."""

    name = "local"
    elastic = False
    same_host = True
    same_pids = True
    sends_program = False
    passes_on = False


_SEQ = struct.Struct("<Q")

_NO_ROOM = (TooManyOpenFiles, MemoryError)
_LOST = (*_NO_ROOM, ValueError, struct.error)
"""Errors that lose a packet, which was taken from its socket and cannot be delivered."""


class LocalChild:
    """A child of this host; a ``ChildHandle``."""

    def __init__(self, agent: Agent, id_: int, spec: ChildSpec, observer: ChildObserver) -> None:
        self.id = id_
        self.name = spec.name
        self.host = agent.host
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
        self._agent = agent
        self._loop = agent.loop
        self._ours: socket.socket | None = None
        self._theirs: socket.socket | None = None
        self._outbox: Outbox | None = None
        self._in_direct_use = False

    def start(self) -> None:
        """Start the child.  Calls that follow in the same turn of the loop find it registered."""
        self._agent.start(self)

    def _make_channel(self) -> None:
        slot = self._agent.progress_table.claim()
        try:
            ours, theirs = socketpair("starting a pool worker")
        except BaseException:
            self._agent.progress_table.release(slot)
            raise
        ours.setblocking(False)
        self.slot = slot
        # The agent keeps the child's end too.  From there it takes back packets that the child has
        # not read, when the child dies or another worker is idle.  The kernel gives each packet to
        # exactly one reader.
        self._ours, self._theirs = ours, theirs

    def open(self) -> None:
        """Make the task channel of a pool worker."""
        if self._spec.tasks:
            self._make_channel()
        if self._ours is not None:
            self._outbox = Outbox(self._loop, self._ours)
            self._loop.register(self._ours.fileno(), self._receive)
            self.pause()

    def started(self, pid: int) -> None:
        """Report that the child runs, and begin to receive its packets.

        The first answer of a worker may arrive before its zygote reports the start.  It waits, so
        that the worker's process identifier is known to a caller that has an answer.  The last
        packets of a worker that ends without such a report do not wait.
        """
        self.pid = pid
        self.release_descriptors()
        try:
            self.observer.started(pid)
        finally:
            self.resume()

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
        """Stop counting the child as its zygote's: the child is gone, or gets another zygote."""
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
                    fds += map(_dup_or_null, (1, 2))
                handed = [owner.fileno() for owner in self._spec.fds]
                fds += map(os.dup, [*(self._spec.stdio or ()), *ours, *handed])
        except BaseException:
            zygote.close_all(fds)
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

    def lease_channel(self) -> LocalTaskChannel | None:
        """Return the task channel for direct use; None if it is gone, or without descriptors."""
        if self._ours is None or self._ours.fileno() < 0:
            return None
        try:
            # A duplicate, since the kernel may reuse the number of a closed descriptor while the
            # user of the channel waits on it.
            fd = os.dup(self._ours.fileno())
        except OSError:
            return None
        self._loop.pause(self._ours.fileno())
        self._in_direct_use = True
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET, fileno=fd)
        return LocalTaskChannel(sock, self.abort)

    def reclaim(self) -> None:
        """Receive the child's packets again, after ``lease_channel``."""
        self._in_direct_use = False
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
        """Take back unread packets; ``observer.recalled`` gets the answer on the loop thread."""
        self._loop.call_soon(self._send_recalled)

    def drain(self) -> None:
        """Take back the tasks that a worker has not begun: its host is about to end."""
        if self.slot is not None:
            self._agent.progress_table.stop(self.slot)
        self.recall()

    def signal(self, signum: int) -> None:
        """Signal the child through its zygote."""
        if self._loop.broken:
            self._signal(signum)  # the loop runs no calls
        else:
            self._loop.call_soon(self._signal, signum)

    def measure(self) -> None:
        """Report the child's memory and processor time to the observer, if it runs."""
        usage = None if self.pid is None else usage_of(self.pid)
        if usage is not None:
            self.observer.measured(usage)

    def _signal(self, signum: int) -> None:
        if self.zygote is not None:
            self.zygote.send(zygote.SIGNAL, self.id, signum)
        if signum == signal.SIGKILL and self.pid is None:
            self._agent.abandon(self)

    def abort(self, fault: Exception) -> None:
        """Kill the child because a packet to or from it is lost; its exit report says so."""
        self.fault = self.fault or fault
        self.signal(signal.SIGKILL)

    def drain_and_close(self) -> tuple[int, ...]:
        """Pass on the dead child's last packets, close its channel and return the unread packets.

        Runs on the loop thread.
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
        if (
            not self._in_direct_use
        ):  # an event from before ``lease_channel``: its packet is for the channel's user
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


class LocalTaskChannel:
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


def _dup_or_null(fd: int) -> int:
    return os.dup(fd) if is_standard_stream(fd) else os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
