"""Putting off signals while the main thread changes what a pool knows.

Python runs signal handlers on the main thread between any two of its steps, and a handler may
raise, as Ctrl-C does, or ask for something that needs a lock which this very thread holds.  Either
would leave a pool half changed: a task that nobody has, an answer that nobody gets.
multiprocessing is spared that since other threads do its work, which costs it a wake-up of each for
every call.  Here the calling thread does it, and ``unbroken`` puts its handlers off meanwhile::

    with unbroken:
        ...                       # microseconds: no handler runs
        with unbroken.lifted:
            ...                   # the user's code, which may take its time: handlers run again

What came within runs at the end of the block, where it may raise.  On other threads, where no
handler ever runs, nothing happens.
"""

from __future__ import annotations

# What is behind the functions of ``signal``, which make enums of all; that takes longer than the
# rest together.
import _signal  # type: ignore[import-not-found]
import os
import signal
import threading
from threading import get_ident
from types import FrameType, TracebackType
from typing import Any

_handler_of = _signal.getsignal
_handle = _signal.signal

SIGNALS = (
    signal.SIGINT,
    signal.SIGTERM,
    signal.SIGALRM,
    signal.SIGHUP,
    signal.SIGUSR1,
    signal.SIGUSR2,
)
"""Those whose handlers raise or end something."""

_NUMBERS = tuple(map(int, SIGNALS))


class Shield:
    """Puts off what is asked of the main thread by signals; a context manager, and reentrant."""

    def __init__(self) -> None:
        self.lifted = _Lifted(self)
        self._depth = 0
        self._seen: tuple[Any, ...] = ()
        self._handlers: list[tuple[int, Any]] = []
        self._pending: list[tuple[int, FrameType | None]] = []
        self._put_off = lambda signum, frame: self._pending.append((signum, frame))

    def up(self) -> bool:
        """Whether this thread is shielded."""
        return self._depth > 0 and get_ident() == _main

    def __enter__(self) -> None:
        if get_ident() == _main:
            if not self._depth:
                self._raise()
            self._depth += 1

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if get_ident() != _main:
            return
        depth = self._depth = self._depth - 1
        if depth:
            return
        try:
            for number, handler in self._handlers:
                _handle(number, handler)
        except BaseException:  # one that is back already raised: the others have to be, too
            self._lower()
            raise
        if self._pending:
            self._deliver()

    def _raise(self) -> None:
        put_off = self._put_off
        seen = tuple(map(_handler_of, _NUMBERS))
        if seen != self._seen:
            pairs = zip(_NUMBERS, seen, strict=True)
            self._handlers = [(number, handler) for number, handler in pairs if callable(handler)]
            self._seen = seen
        try:
            for number, _ in self._handlers:
                _handle(number, put_off)
        except BaseException as error:
            if isinstance(error, ValueError) and error.__traceback__.tb_next is None:  # type: ignore[union-attr]
                # No handler's: this is an interpreter within the interpreter, where none runs.
                self._handlers = []
                return
            self._restore()  # one that is not replaced yet was first
            raise

    def _lower(self) -> None:
        try:
            self._restore()
        finally:
            if self._pending:
                self._deliver()

    def _restore(self) -> None:
        try:
            for number, handler in self._handlers:
                _handle(number, handler)
        except BaseException:  # one that is back already raised: the others have to be, too
            self._restore()
            raise

    def _deliver(self) -> None:
        number, frame = self._pending.pop(0)
        try:
            dict(self._handlers)[number](number, frame)
        finally:
            if self._pending:
                self._deliver()


class _Lifted:
    """A gap in the shield."""

    def __init__(self, shield: Shield) -> None:
        self._shield = shield

    def __enter__(self) -> None:
        if self._shield.up():
            try:
                self._shield._lower()
            except BaseException:
                self._shield._raise()
                raise

    def __exit__(self, *_: object) -> None:
        if self._shield.up():
            try:
                self._shield._raise()
            except BaseException:  # the last one that came through
                self._shield._raise()
                raise


def _find_main_thread() -> None:
    global _main
    _main = threading.main_thread().ident


_main: int | None = None
_find_main_thread()
os.register_at_fork(after_in_child=_find_main_thread)
unbroken = Shield()
"""The main thread's."""
