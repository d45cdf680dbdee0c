"""The process of a zygote, from the program's side, which may start it before it is needed.

Starting an interpreter with the imports that children need takes as long as the program takes to
import the rest of Fiber.  So the first process or pool starts its zygote first, and this module
imports as little as possible.
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
    """A started process, and the agent's end of its control socket."""

    process: subprocess.Popen[bytes]
    sock: socket.socket


interpreter_flags: list[str] | None = None
"""Flags for new interpreters; None for the flags of this one."""

_early: ZygoteProcess | None = None


def start_early() -> None:
    """Start a zygote's process for the next ``launch``."""
    global _early
    if _early is None:
        _early = _start()
        atexit.register(discard_early)


def launch() -> ZygoteProcess:
    """Return the process that was started early, or a new one."""
    global _early
    ready, _early = _early, None
    return ready or _start()


def discard_early() -> None:
    """End the process that was started early, if ``launch`` has not taken it."""
    global _early
    unused, _early = _early, None
    if unused is not None:
        unused.sock.close()
        unused.process.kill()
        unused.process.wait()


def interpreter_arguments(executable: str, statement: str) -> list[str]:
    """Return the command of an interpreter with these flags that can import this package."""
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    code = f"import sys; sys.path.insert(0, {root!r}); {statement}"
    return [executable, *flags(), "-c", code]


def flags() -> list[str]:
    """Return the flags for new interpreters."""
    if interpreter_flags is not None:
        return interpreter_flags
    return cast("list[str]", cast("Any", subprocess)._args_from_interpreter_flags())


def is_standard_stream(fd: int) -> bool:
    """Return whether the program still has its standard stream ``fd``."""
    # Standard streams are inheritable, and Python makes other descriptors non-inheritable.  So a
    # non-inheritable one has taken the number of a stream that the program closed.
    try:
        return os.get_inheritable(fd)
    except OSError:
        return False


def _start() -> ZygoteProcess:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        # The zygote waits for packets without the timeout that socket.setdefaulttimeout() sets.
        theirs.setblocking(True)
        return ZygoteProcess(_run(theirs.fileno()), ours)
    except BaseException:
        ours.close()
        raise
    finally:
        theirs.close()


def _run(control: int) -> subprocess.Popen[bytes]:
    # If the program closed its standard streams, this socket may have one of their numbers.  The
    # zygote and its children need these numbers for streams.
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
            # Ctrl-C in the terminal is for the program's group.  With a new session, the kernel's
            # scheduler (sched_autogroup) would give half of the processors to the program and
            # half to its children, however many there are.
            process_group=0,
        )
    finally:
        os.close(fd)


def _null_if_closed(fd: int) -> int | None:
    return None if is_standard_stream(fd) else subprocess.DEVNULL


def _forget_early() -> None:
    # The early process is a child of the process that this one was forked from.
    global _early
    if _early is not None:
        _early.sock.close()
        _early.process.returncode = 0  # keeps its destructor from a warning
        _early = None


os.register_at_fork(after_in_child=_forget_early)
