"""The agent's side of a zygote: starts its process, asks for children, hears of them."""

from __future__ import annotations

import fcntl
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Sequence
from typing import Any, Protocol

from fiber._agent import zygote
from fiber._agent.child import Start, interpreter_arguments, lineage
from fiber._transport.loop import Loop
from fiber._transport.outbox import Outbox
from fiber._transport.unix import naming_the_limit, socketpair
from fiber._wire import packet

_QUIT_TIMEOUT = 10.0


class ZygoteObserver(Protocol):
    """Hears what a zygote says; on the loop's thread."""

    def heard(self, link: ZygoteLink, answer: tuple[Any, ...]) -> None:
        """What became of a child."""

    def zygote_gone(self, link: ZygoteLink) -> None:
        """The zygote died, and its children with it.  Once, and last."""


class ZygoteLink:
    """Our side of one zygote process."""

    def __init__(
        self,
        observer: ZygoteObserver,
        loop: Loop,
        board: int,
        heirloom: str | None,
        *,
        preload: bool,
    ) -> None:
        self._observer = observer
        self._loop = loop
        self._gone = threading.Event()
        self._answered = False
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

    def start(self, child: int, request: Start, fds: list[int]) -> None:
        """Ask for a child that gets ``fds``, which are this object's from now on."""
        while len(fds) > packet.MAX_DESCRIPTORS:
            some, fds = fds[: packet.MAX_DESCRIPTORS], fds[packet.MAX_DESCRIPTORS :]
            self._outbox.send(pickle.dumps((zygote.DESCRIPTORS, child)), fds=some)
        self._outbox.send(pickle.dumps((zygote.START, child, tuple(request)), protocol=5), fds=fds)

    def send(self, *request: Any) -> None:
        """Ask for something else.  On the loop's thread, as ``start``."""
        self._outbox.send(pickle.dumps(request))

    def quit(self) -> None:
        """End it and its children, and wait for that; on any thread but the loop's."""
        if self._answered:
            self._loop.call_soon(self.send, zygote.QUIT)
            if not self._loop.running:
                self.send(zygote.QUIT)
        else:
            # It has no child yet and may be importing the program's main module for ever.
            self._process.kill()
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
            self._observer.zygote_gone(self)
            self._gone.set()
            return
        self._answered = True
        self._observer.heard(self, answer)


def _launch(
    control: int, board: int, heirloom: str | None, *, preload: bool
) -> subprocess.Popen[bytes]:
    # A program that closed its standard streams may have their numbers under ours; the zygote and
    # its children must not.
    fds = [fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, 3) for fd in (control, board)]
    arguments = f"{fds[0]}, {fds[1]}, {lineage()}, {preload}, {heirloom!r}"
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
        close_all(fds)


def _null_if_closed(fd: int) -> int | None:
    return None if _is_standard_stream(fd) else subprocess.DEVNULL


def dup_or_null(fd: int) -> int:
    return os.dup(fd) if _is_standard_stream(fd) else os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)


def _is_standard_stream(fd: int) -> bool:
    # Python makes no descriptor inheritable by itself: one that is not has taken the number of a
    # stream that the program closed.
    try:
        return os.get_inheritable(fd)
    except OSError:
        return False


def close_all(fds: Sequence[int]) -> None:
    for fd in fds:
        os.close(fd)
