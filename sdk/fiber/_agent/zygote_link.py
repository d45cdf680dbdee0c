"""The agent's side of a zygote: starts its process, asks for children, hears of them."""

from __future__ import annotations

import fcntl
import os
import pickle
import resource
import subprocess
import sys
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from fiber._agent import child as child_module
from fiber._agent import zygote
from fiber._agent.child import Start, interpreter_arguments
from fiber._transport.loop import Loop
from fiber._transport.outbox import Outbox
from fiber._transport.unix import naming_the_limit, socketpair
from fiber._wire import packet

if TYPE_CHECKING:
    from fiber._agent.agent import Agent, LocalChild

_QUIT_TIMEOUT = 10.0


class ZygoteLink:
    """Our side of one zygote process."""

    def __init__(
        self, agent: Agent, loop: Loop, board: int, heirloom: str | None, *, preload: bool
    ) -> None:
        self._agent = agent
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

    def request(self, child: LocalChild) -> None:
        """Ask for a child."""
        spec = child.spec
        fds = child.descriptors()
        while len(fds) > packet.MAX_DESCRIPTORS:
            some, fds = fds[: packet.MAX_DESCRIPTORS], fds[packet.MAX_DESCRIPTORS :]
            self._outbox.send(pickle.dumps((zygote.DESCRIPTORS, child.id)), fds=some)
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
        if self._answered:
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
            self._agent.zygote_gone(self)
            self._gone.set()
            return
        self._answered = True
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
