"""The task channel of a worker on another host, lent to the threads of the master."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence

from fiber._transport.link import EventLoop
from fiber._wire.packet import BytesLike, Message


class RemoteTaskChannel:
    """A ``DirectChannel``.  What it sends and receives passes the loop, and nothing above it.

    ``deliver`` is the child handle's own.  Each wait has a lock of its own, which the loop
    releases: an interruption at any line leaves at most a lock that nobody waits for.
    """

    def __init__(self, loop: EventLoop, deliver: Callable[..., bool]) -> None:
        self._loop = loop
        self._deliver = deliver
        self._messages: deque[Message] = deque()
        self._waiting: deque[threading.Lock] = deque()
        self._under_way = 0
        """The last packet that was sent and that the link does not have yet."""
        self._ended = False

    # Whoever borrowed it

    def send(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> None:
        """Send a packet; BrokenPipeError if the worker is gone."""
        if self._ended:
            raise BrokenPipeError("the worker is gone")
        self._under_way = seq
        self._loop.call_soon(self._send, seq, payload, buffers)

    def receive(self, timeout: float) -> Message | None:
        """The next packet, None after ``timeout`` seconds.

        At the end EOFError, or BrokenPipeError if what was sent last never left.
        """
        if not self._messages and not self._ended:
            self._wait(timeout)
        try:
            return self._messages.popleft()
        except IndexError:
            if not self._ended:
                return None
        if self._under_way:
            raise BrokenPipeError("the worker was gone before this was sent")
        raise EOFError

    def close(self) -> None:
        """Let go of it."""

    def _wait(self, timeout: float) -> None:
        lock = threading.Lock()
        lock.acquire()
        self._waiting.append(lock)
        # The loop notes what there is first and looks who waits then.
        if not self._messages and not self._ended:
            lock.acquire(timeout=timeout)

    # The loop's thread

    def put(self, message: Message) -> None:
        """The worker sent it."""
        self._messages.append(message)
        self._wake()

    def end(self) -> None:
        """The worker is gone."""
        self._ended = True
        self._wake()

    def drain(self) -> Iterator[Message]:
        """Yield the messages that were not received."""
        while self._messages:
            yield self._messages.popleft()

    def _send(self, seq: int, payload: BytesLike, buffers: Sequence[memoryview]) -> None:
        if self._deliver(seq, payload, buffers):
            self._under_way = 0

    def _wake(self) -> None:
        while self._waiting:
            self._waiting.popleft().release()
