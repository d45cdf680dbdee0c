"""Channels and counters of another host: every operation is a request to the hub there.

An operation takes a stream for itself, so that threads which wait do not wait for each other.  There
are as many streams as threads that ever used the object at once.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Sequence

from fiber._hub.access import Access
from fiber._hub.client import Line, Reply
from fiber._hub.protocol import HEAD, ONE, TWO, Op, Status
from fiber._wire.packet import BytesLike, Message
from fiber.errors import ConnectionClosed


class RemoteObject:
    """An object that lives elsewhere; attached to it as long as it is open."""

    def __init__(self, home: Access, number: int, grant: int) -> None:
        self.home = home
        self.number = number
        self._lock = threading.Lock()
        self._pid = os.getpid()
        self._closed = False
        # This stream is opened now, so that the grant is used and the object stays; what goes wrong
        # shows at the first request, because whoever unpickles a handle may not be able to wait.
        self._idle = [self._open(grant)]

    def ask(
        self,
        operation: Op,
        *values: int,
        form: struct.Struct = HEAD,
        timeout: float | None = None,
        buffers: Sequence[memoryview] = (),
    ) -> Reply:
        """Make a request to the object's hub."""
        line = self._take_line()
        try:
            return line.ask(operation, *values, form=form, timeout=timeout, buffers=buffers)
        finally:
            self._give_back(line)

    def fork_line(self) -> Line:
        """A stream of its own, attached to the object."""
        self._check()
        return self._open(0)

    def close(self) -> None:
        """Let go of the object."""
        with self._lock:
            self._closed = True
            idle, self._idle = self._idle, []
        for line in idle:
            line.close()

    def __del__(self) -> None:
        if hasattr(self, "_idle"):
            self.close()

    def settled(self, operation: Op, reply: Reply) -> None:
        """A request that was given up (Ctrl-C) had been granted."""

    def _open(self, grant: int) -> Line:
        return Line(self.home, [TWO.pack(Op.ATTACH, 0, self.number, grant)])

    def _check(self) -> None:
        if self._closed:
            raise OSError("handle is closed")

    def _take_line(self) -> Line:
        self._check()
        with self._lock:
            if self._pid != os.getpid():
                # Forked by someone else: the streams are our parent's, who keeps the object there.
                self._pid, self._idle = os.getpid(), []
            line = self._idle.pop() if self._idle else None
        if line is None:
            return self._open(0)
        late = line.settle()
        if late is not None:
            self.settled(*late)
        return line

    def _give_back(self, line: Line) -> None:
        with self._lock:
            if not self._closed:
                self._idle.append(line)
                return
        line.close()


class RemoteChannel(RemoteObject):
    """One end of a message pipe on another host; a ``SharedChannel``."""

    def __init__(self, home: Access, number: int, grant: int) -> None:
        super().__init__(home, number, grant)
        self._late: deque[Reply] = deque()
        self._watch: Line | None = None
        self._watch_lock = threading.Lock()

    def send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send one message; returns when it can be received."""
        parts = [memoryview(payload), *buffers]
        try:
            reply = self.ask(Op.SEND, buffers=parts)
        except ConnectionClosed as error:
            raise BrokenPipeError(str(error)) from error
        if reply.status is Status.BROKEN:
            raise BrokenPipeError("the other end is closed")

    def try_send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Never: it would take a round trip to find out."""
        return False

    def recv(self) -> Message:
        """The next message; EOFError at the end."""
        return self._message(Op.RECV) or self.recv()

    def try_recv(self) -> Message | None:
        """The next message if one is there."""
        return self._message(Op.TRY_RECV)

    def poll(self, timeout: float | None) -> bool:
        """Whether ``recv`` would return or raise at once."""
        return bool(self._late) or self.ask(Op.POLL, timeout=timeout).status is Status.OK

    def fileno(self) -> int:
        """A descriptor that is readable exactly if there is something to receive now.

        Who keeps it instead of asking again finds it readable too early at times, if others receive
        from the same end.
        """
        with self._watch_lock:
            if self._watch is None:
                self._watch = self.fork_line()
            number = self._check_watch(self._watch)
            del number
            return self._watch.fileno()

    def close(self) -> None:
        """Let go of this end."""
        super().close()
        if getattr(self, "_watch", None) is not None:
            self._watch.close()
