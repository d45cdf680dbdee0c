"""The process of a zygote, from the program's side; it may be started before anything needs it.

To start an interpreter and import what children need takes as long as the program takes to import
the rest of Fiber.  So the first process or pool starts its zygote first, and this module imports
next to nothing.
"""

from __future__ import annotations

import atexit
import fcntl
import os
import socket
import subprocess
import sys
from typing import Any, NamedTuple, cast


class ZygoteProcess(NamedTuple):
    """A started process and our end of the socket over which it is told what to do."""

    process: subprocess.Popen[bytes]
    sock: socket.socket


interpreter_flags: list[str] | None = None
"""Flags for new interpreters; None: those of this one."""

_early: ZygoteProcess | None = None


def start_early() -> None:
    """Start one for the next ``launch``."""
    global _early
    if _early is None:
        _early = _start()
        atexit.register(discard_early)


def launch() -> ZygoteProcess:
    """The one that was started early, or a new one."""
    global _early
    ready, _early = _early, None
    return ready or _start()


def discard_early() -> None:
    """End the one that was started early and that nobody came for."""
    global _early
    unused, _early = _early, None
    if unused is not None:
        unused.sock.close()
        unused.process.kill()
        unused.process.wait()


def interpreter_arguments(executable: str, statement: str) -> list[str]:
    """The command line of a fresh interpreter with our flags that can import this package."""
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    code = f"import sys; sys.path.insert(0, {root!r}); {statement}"
    return [executable, *flags(), "-c", code]


def flags() -> list[str]:
    """Return the flags for new interpreters."""
    if interpreter_flags is not None:
        return interpreter_flags
    return cast("list[str]", cast("Any", subprocess)._args_from_interpreter_flags())


def is_standard_stream(fd: int) -> bool:
    """Whether the program still has its standard stream ``fd``."""
    # Python makes no descriptor inheritable by itself: one that is not has taken the number of a
    # stream that the program closed.
    try:
        return os.get_inheritable(fd)
    except OSError:
        return False


def _start() -> ZygoteProcess:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        # The zygote waits for what it is told: socket.setdefaulttimeout() is for the user's own.
        theirs.setblocking(True)
        return ZygoteProcess(_run(theirs.fileno()), ours)
    except BaseException:
        ours.close()
        raise
    finally:
        theirs.close()


def _run(control: int) -> subprocess.Popen[bytes]:
    # A program that closed its standard streams may have their numbers under ours; the zygote and
    # its children must not.
    fd = fcntl.fcntl(control, fcntl.F_DUPFD_CLOEXEC, 3)
    try:
        return subprocess.Popen(
            interpreter_arguments(
                sys.executable, f"from fiber._agent.zygote import main; main({fd}, {os.getpid()})"
            ),
            pass_fds=(fd,),
            stdin=subprocess.DEVNULL,
            stdout=_null_if_closed(1),
            stderr=_null_if_closed(2),
            # Ctrl-C in the terminal is for the program's own group.  A session of its own would
            # make the kernel's scheduler share the processors between program and children by half
            # (sched_autogroup), however many children there are.
            process_group=0,
        )
    finally:
        os.close(fd)


def _null_if_closed(fd: int) -> int | None:
    return None if is_standard_stream(fd) else subprocess.DEVNULL


def _forget_early() -> None:
    # It is the child of the process that we were forked from.
    global _early
    if _early is not None:
        _early.sock.close()
        _early.process.returncode = 0  # what its destructor would warn of is not our child
        _early = None


os.register_at_fork(after_in_child=_forget_early)
