"""Sending packets without ever blocking: what the kernel does not take waits for the loop."""

from __future__ import annotations

import os
import socket
from collections import deque
from collections.abc import Callable, Sequence

from fiber._transport.loop import Loop
from fiber._wire import packet
from fiber._wire.packet import BytesLike

_PAUSE = 0.05
"""Seconds before a message that the system refused is tried again."""

_Waiting = tuple[BytesLike, Sequence[memoryview], tuple[int, ...]]


class Outbox:
    """The sending side of a non-blocking socket that the loop already reads.

    On the loop's thread only.
    """

    def __init__(self, loop: Loop, sock: socket.socket) -> None:
        self._loop = loop
        self._sock = sock
        self._waiting: deque[_Waiting] = deque()
        self._closed = False
        self._stalled = False

    def send(
        self, payload: BytesLike, buffers: Sequence[memoryview] = (), fds: Sequence[int] = ()
    ) -> bool:
        """Send now or as soon as there is room, in order; False if this outbox is closed.

        Takes over ``fds``.  A peer that is gone swallows it.
        """
        if self._closed:
            _close_all(fds)
            return False
        try:
            packet.check_buffers(buffers)
            if not self._waiting and self._try(payload, buffers, fds):
                return True
        except BaseException:
            _close_all(fds)
            raise
        self._waiting.append((payload, buffers, tuple(fds)))
        if len(self._waiting) == 1:
            self._watch(self._flush)
        return True

    def recall(self) -> list[BytesLike]:
        """Take back the payloads that never left."""
        payloads = [payload for payload, _, _ in self._waiting]
        self._drop()
        return payloads

    def close(self) -> None:
        """Send nothing more.  On the loop's thread, before the socket is closed."""
        self._closed = True
        self._drop()

    def _drop(self) -> None:
        for _, _, fds in self._waiting:
            _close_all(fds)
        self._waiting.clear()

    def _try(self, payload: BytesLike, buffers: Sequence[memoryview], fds: Sequence[int]) -> bool:
        try:
            packet.send(self._sock, payload, buffers, fds)
        except BlockingIOError:
            return False
        except BrokenPipeError:
            # The peer is gone; whoever watches it will say so.
            pass
        _close_all(fds)
        return True

    def _flush(self) -> None:
        while self._waiting:
            try:
                if not self._try(*self._waiting[0]):
                    return
            except OSError:
                # No descriptor or no memory.  Its sender cannot be told any more, and others'
                # ends give back what is missing.
                self._watch(None)
                self._loop.call_later(_PAUSE, self._watch, self._flush)
                if self._stalled:
                    return
                self._stalled = True
                raise
            self._stalled = False
            self._waiting.popleft()
        self._watch(None)

    def _watch(self, callback: Callable[[], None] | None) -> None:
        if not self._closed:
            self._loop.want_write(self._sock.fileno(), callback)


def _close_all(fds: Sequence[int]) -> None:
    for fd in fds:
        os.close(fd)
