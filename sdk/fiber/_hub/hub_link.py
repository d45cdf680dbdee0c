"""Link between the hubs of two hosts."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from fiber._hub.replicas import MemoryLink
from fiber._hub.tunnel import Frame as TunnelFrame
from fiber._hub.tunnel import Tunnels
from fiber._wire.messages import Memory, OfHubs

Send = Callable[[OfHubs], None]


class HubLink:
    """Side of a link between two hubs.  Runs on the loop's thread.

    Whatever else is sent over the link has to be preceded by ``flush``.
    """

    memory: MemoryLink
    tunnels: Tunnels

    def __init__(self, call_soon: Callable[..., None], send: Send) -> None:
        self._call_soon = call_soon
        self._send = send
        self._waiting: deque[TunnelFrame] = deque()

    def on_frame(self, frame: OfHubs) -> None:
        """A frame of the other side's hub."""
        if isinstance(frame, Memory):
            self.memory.on_frame(frame)
        else:
            self.tunnels.on_frame(frame)

    def send(self, frame: TunnelFrame) -> None:
        """Send a frame of a tunnel, after what has changed in shared memory."""
        if not self.memory and not self._waiting:
            self._send(frame)
            return
        # To look for changes takes time: once for all frames of a turn of the loop.
        self._waiting.append(frame)
        if len(self._waiting) == 1:
            self._call_soon(self.flush)

    def flush(self) -> None:
        """Send what has changed in shared memory, and what waits for that."""
        self.memory.flush()
        while self._waiting:
            self._send(self._waiting.popleft())
