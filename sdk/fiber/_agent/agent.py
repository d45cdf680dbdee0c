"""The agent: starts, watches and kills the children of one host.

In a program with the local backend it lives in the program itself, on its loop; elsewhere it is a
process of its own (``python -m fiber.agent``) whose ``ChildObserver`` is the link to the master.

Who touches what: ``start``, ``deliver``, ``take_back`` and ``signal`` come from any thread and only
append to outboxes or tables under ``_lock``; everything that arrives is handled on the loop's
thread.
"""

from __future__ import annotations

import fcntl
import itertools
import os
import pickle
import resource
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Sequence
from typing import Any

from fiber._agent import child as child_module
from fiber._agent import zygote
from fiber._agent.board import Board
from fiber._agent.child import Start, interpreter_arguments
from fiber._agent.port import ChildObserver, ChildSpec, ExitReport
from fiber._hub import access
from fiber._hub.access import Access
from fiber._hub.hub import Hub
from fiber._transport.loop import Loop
from fiber._transport.outbox import Outbox
from fiber._transport.unix import naming_the_limit, socketpair, wait_readable
from fiber._wire import packet
from fiber._wire.packet import BytesLike

_SEQ = struct.Struct("<Q")
_ATTENTION = 5e-3
"""Seconds that a caller waits for a worker itself before it leaves the answer to the loop."""

_QUIT_TIMEOUT = 10.0


class Agent:
    """Runs the children of this host; an ``AgentPort``."""

    def __init__(self, loop: Loop, host: str, hub: Hub | None = None) -> None:
        self.host = host
        self._hub = hub
        self._loop = loop
        self._lock = threading.Lock()
        self._ids = itertools.count(1)
        self._children: dict[int, LocalChild] = {}
        self._board = Board()
        self._zygotes: list[_ZygoteLink] = []
        self._closed = False

    def start(self, spec: ChildSpec, observer: ChildObserver) -> LocalChild:
        """Start a child; it has its pid when ``observer.started`` is called."""
        with self._lock:
            if self._closed:
                _close_all(spec.fds)
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

    def access(self) -> Access | None:
        """What our children are told of this host's hub."""
        return self._hub.access if self._hub is not None else access.told()

    def _zygote(self, *, preload: bool = True) -> _ZygoteLink:
        if not self._zygotes or not preload:
            directory = None if self._hub is None else os.path.dirname(self._hub.access.address)
            self._zygotes.append(
                _ZygoteLink(self, self._loop, self._board.fd, directory, preload=preload)
            )
        return self._zygotes[-1]

    # What zygotes say, on the loop's thread

    def heard(self, link: _ZygoteLink, answer: tuple[Any, ...]) -> None:
        """An answer of a zygote about one of our children."""
        child = self._children.get(answer[1])
        if child is None:
            return
        if answer[0] == zygote.STARTED:
            child.pid = answer[2]
            child.release_descriptors()
            child.observer.started(answer[2])
        elif answer[0] == zygote.EXITED:
            self._gone(child, answer[2], describe(answer[2]))
        elif answer[0] == zygote.FAILED:
            self._gone(child, 1, f"could not be started: {answer[2]}")
        elif answer[0] == zygote.UNFIT:
            self._start_elsewhere(child)

    def zygote_gone(self, link: _ZygoteLink) -> None:
        """A zygote died, and its children with it."""
        with self._lock:
            if link in self._zygotes:
                self._zygotes.remove(link)
        for child in [c for c in self._children.values() if c.zygote is link]:
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
        self.zygote: _ZygoteLink | None = None
        self.observer = observer
        self.spec = spec
        self._fds = spec.fds
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
        ours, theirs = socketpair("starting a pool worker")
        ours.setblocking(False)
        self.slot = agent._board.claim()
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
                    fds += map(_dup_or_null, (1, 2))
                fds += map(os.dup, [*(self.spec.stdio or ()), *ours, *self._fds])
        except BaseException:
            _close_all(fds)
            raise
        return fds

    def release_descriptors(self) -> None:
        """It has its own now: the other end must see EOF when the child lets go."""
        fds, self._fds = self._fds, ()
        _close_all(fds)

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
        self.observer.said(message)
        return True

    def _recall(self) -> list[int]:
        assert self._theirs is not None
        assert self._outbox is not None
        seqs = []
        try:
            while True:
                message = packet.receive(self._theirs, wait=False)
                seqs.append(_SEQ.unpack_from(message.payload)[0])
                message.release()
        except (BlockingIOError, EOFError):
            pass
        return seqs + [_SEQ.unpack_from(payload)[0] for payload in self._outbox.recall()]


class _ZygoteLink:
    """Our side of one zygote process."""

    def __init__(
        self, agent: Agent, loop: Loop, board: int, heirloom: str | None, *, preload: bool
    ) -> None:
        self._agent = agent
        self._loop = loop
        self._gone = threading.Event()
        self._sock, theirs = socketpair("starting the zygote")
        try:
            with naming_the_limit("starting the zygote"):
                self._process = _launch(theirs.fileno(), board, heirloom, preload=preload)
        except BaseException:
            self._sock.close()
            raise
        finally:
            theirs.close()
        self._sock.setblocking(False)
        self._outbox = Outbox(loop, self._sock)
        loop.register(self._sock.fileno(), self._receive)

    def request(self, child: LocalChild) -> None:
        """Ask for a child."""
        spec = child.spec
        fds = child.descriptors()
        while len(fds) > packet.MAX_DESCRIPTORS:
            some, fds = fds[: packet.MAX_DESCRIPTORS], fds[packet.MAX_DESCRIPTORS :]
            self._outbox.send(pickle.dumps((zygote.DESCRIPTORS,)), fds=some)
        start = Start(
            spec.method,
            spec.preparation,
            spec.payload,
            child.slot,
            spec.executable,
            captured=spec.stdio is not None,
            open_files=resource.getrlimit(resource.RLIMIT_NOFILE),
            hub=self._agent.access(),
            elders=_elders(),
        )
        self._outbox.send(pickle.dumps((zygote.START, child.id, tuple(start)), protocol=5), fds=fds)

    def send(self, *request: Any) -> None:
        """Ask for something else."""
        self._outbox.send(pickle.dumps(request))

    def quit(self) -> None:
        """End it and its children, and wait for that; on any thread but the loop's."""
        self.send(zygote.QUIT)
        try:
            self._process.wait(_QUIT_TIMEOUT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._loop.running:
            # Its last words tell of its children.
            self._gone.wait(_QUIT_TIMEOUT)

    def _receive(self) -> None:
        try:
            answer = packet.loads(packet.receive(self._sock))
        except BlockingIOError:
            return
        except (EOFError, ConnectionError):
            self._loop.unregister(self._sock.fileno())
            self._outbox.close()
            self._sock.close()
            self._process.wait()
            self._agent.zygote_gone(self)
            self._gone.set()
            return
        self._agent.heard(self, answer)


def _elders() -> tuple[int, ...]:
    return os.getpid(), *child_module.elders


def _launch(
    control: int, board: int, heirloom: str | None, *, preload: bool
) -> subprocess.Popen[bytes]:
    # A program that closed its standard streams may have their numbers under ours; the zygote and
    # its children must not.
    fds = [fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, 3) for fd in (control, board)]
    arguments = f"{fds[0]}, {fds[1]}, {_elders()}, {preload}, {heirloom!r}"
    try:
        return subprocess.Popen(
            interpreter_arguments(
                sys.executable, f"from fiber._agent.zygote import main; main({arguments})"
            ),
            pass_fds=fds,
            stdin=subprocess.DEVNULL,
            stdout=_null_if_closed(1),
            stderr=_null_if_closed(2),
            # Ctrl-C in the terminal is for the program's own group.  A session of its own would
            # make the kernel's scheduler share the processors between program and children by half
            # (sched_autogroup), however many children there are.
            process_group=0,
        )
    finally:
        _close_all(fds)


def _null_if_closed(fd: int) -> int | None:
    return None if _is_standard_stream(fd) else subprocess.DEVNULL


def describe(exitcode: int) -> str:
    """An exit code in words."""
    if exitcode >= 0:
        return f"exit status {exitcode}"
    try:
        return f"killed by {signal.Signals(-exitcode).name}"
    except ValueError:
        return f"killed by signal {-exitcode}"


def _dup_or_null(fd: int) -> int:
    return os.dup(fd) if _is_standard_stream(fd) else os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)


def _is_standard_stream(fd: int) -> bool:
    # Python makes no descriptor inheritable by itself: one that is not has taken the number of a
    # stream that the program closed.
    try:
        return os.get_inheritable(fd)
    except OSError:
        return False


def _close_all(fds: Sequence[int]) -> None:
    for fd in fds:
        os.close(fd)
