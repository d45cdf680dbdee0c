"""Standard output and errors of a command that passes on the bytes of a program."""

from __future__ import annotations

import contextlib
import os
import select
import sys

from fiber._cli.failures import CommandError


class OutputClosed(Exception):
    """Error: nobody reads this command's output any longer, as after ``| head``."""


def write(data: bytes, *, to_stderr: bool = False) -> None:
    """Write all bytes at once.  OutputClosed; a stream that was closed at the start is left out."""
    stream = sys.stderr if to_stderr else sys.stdout
    if stream is None:
        return
    try:
        stream.flush()
        descriptor = stream.fileno()
        left = memoryview(data)
        while left:
            left = left[_write_some(descriptor, left) :]
    except BrokenPipeError as error:
        raise OutputClosed from error
    except OSError as error:
        raise CommandError(
            "cannot write the output of the program",
            str(error.strerror or error),
            "the program goes on: `fiber ps` shows it",
        ) from error


def _write_some(descriptor: int, data: memoryview) -> int:
    try:
        return os.write(descriptor, data)
    except BlockingIOError:  # another program has made the terminal non-blocking
        poller = select.poll()
        poller.register(descriptor, select.POLLOUT)
        poller.poll()
        return 0


def say(line: str) -> None:
    """Write a line to the standard errors, if anybody reads them."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError):
            print(line, file=sys.stderr, flush=True)
