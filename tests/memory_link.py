"""Links in memory, on a simulated clock, over a connection that is as bad as a test wants it.

Everything but the wire is what runs over nng.  The same seed gives the same run.
"""

from __future__ import annotations

import heapq
import itertools
import random
from collections import deque
from collections.abc import Callable
from typing import Any

from fiber._transport.authentication import Identity
from fiber._transport.link import DEFAULT_KEEPALIVE, Keepalive, Link
from fiber._transport.link_protocol import Datagram


class SimulatedTimer:
    """A call that is due; a ``ScheduledCall``."""

    __slots__ = ("callback",)

    def __init__(self, callback: Callable[[], None]) -> None:
        self.callback: Callable[[], None] | None = callback

    def cancel(self) -> None:
        """Never call it."""
        self.callback = None


class SimulatedLoop:
    """A loop whose time passes only in ``run_for`` and ``run_until``; an ``EventLoop``."""

    def __init__(self) -> None:
        self._now = 0.0
        self._ready: deque[Callable[[], object]] = deque()
        self._timers: list[tuple[float, int, SimulatedTimer]] = []
        self._sequence = itertools.count()

    def now(self) -> float:
        """Simulated seconds since the beginning."""
        return self._now

    def call_soon(self, callback: Callable[..., object], *args: Any) -> None:
        """Call it in the next turn."""
        self._ready.append(lambda: callback(*args))

    def call_later(
        self, seconds: float, callback: Callable[..., None], *args: Any
    ) -> SimulatedTimer:
        """Call it once, ``seconds`` from now."""
        timer = SimulatedTimer(lambda: callback(*args))
        heapq.heappush(self._timers, (self._now + seconds, next(self._sequence), timer))
        return timer

    def run_for(self, seconds: float) -> None:
        """Let time pass."""
        end = self._now + seconds
        while self._turn(end):
            pass
        self._now = end

    def run_until(self, condition: Callable[[], bool], *, within: float) -> None:
        """Let time pass until ``condition`` holds; TimeoutError after ``within`` seconds."""
        end = self._now + within
        while not condition():
            if not self._turn(end):
                raise TimeoutError(f"it did not happen within {within:g} simulated seconds")

    def _turn(self, end: float) -> bool:
        """Make the next call; False if none is due before ``end``."""
        if self._ready:
            self._ready.popleft()()
            return True
        if not self._timers or self._timers[0][0] > end:
            return False
        due, _, timer = heapq.heappop(self._timers)
        self._now = max(self._now, due)
        if timer.callback is not None:
            timer.callback()
        return True


class Cable:
    """The two ends of a link, ``master`` and ``agent``, and what lies between them."""

    def __init__(
        self,
        loop: SimulatedLoop,
        *,
        seed: int = 0,
        delay: tuple[float, float] = (0.0001, 0.001),
        drop: float = 0.0,
        redial_after: float = 0.1,
        keepalive: Keepalive = DEFAULT_KEEPALIVE,
    ) -> None:
        self.delay = delay
        self.drop = drop
        self.loop = loop
        self.random = random.Random(seed)
        self.is_cut = False
        self._redial_after = redial_after
        self._wires: tuple[MemoryWire, ...] = ()
        self._ended: set[Link] = set()
        self.agent, self.master = (
            Link(loop, Identity.of_this_process(peer), keepalive, self._ended.add, dials=dials)
            for peer, dials in (("the master", True), ("agent", False))
        )
        self._connect()

    def cut(self) -> None:
        """Drop all packets, without notice to either side."""
        self.is_cut = True

    def mend(self) -> None:
        """Let everything through again."""
        self.is_cut = False

    def break_off(self) -> None:
        """Break the connection; packets in flight are lost, and the agent dials again."""
        broken, self._wires = self._wires, ()
        for wire in broken:
            wire.disconnect()
        if broken:
            self.loop.call_later(self._redial_after, self._connect)

    def _connect(self) -> None:
        if self.is_cut:
            self.loop.call_later(self._redial_after, self._connect)
        elif self._ended:
            for link in (self.agent, self.master):
                link.refused("the other side has ended the session")
        else:
            ends = MemoryWire(self, self.agent), MemoryWire(self, self.master)
            ends[0].other, ends[1].other = ends[1], ends[0]
            self._wires = ends
            arrived = self.agent.arrived, self.master.arrived
            self.agent.connected(ends[0], arrived[1])
            self.master.connected(ends[1], arrived[0])


class MemoryWire:
    """End of one connection; a ``LinkConnection``."""

    def __init__(self, cable: Cable, link: Link) -> None:
        self.other: MemoryWire | None = None
        self._cable = cable
        self._link = link
        self._free_at = 0.0

    def put(self, datagram: Datagram) -> None:
        """Send it, or lose it."""
        cable = self._cable
        datagram = datagram if isinstance(datagram, bytes) else b"".join(datagram)
        lost = cable.is_cut or cable.random.random() < cable.drop
        if lost or self.other is None:
            return
        # Never before an earlier message.
        self._free_at = max(self._free_at, cable.loop.now() + cable.random.uniform(*cable.delay))
        cable.loop.call_later(self._free_at - cable.loop.now(), self._arrive, self.other, datagram)

    def break_off(self) -> None:
        """Break the connection; both sides are notified."""
        if self.other is not None:
            self._cable.break_off()

    close = break_off

    def disconnect(self) -> None:
        """The connection broke."""
        self.other = None
        self._link.disconnected(self)

    def _arrive(self, other: MemoryWire, datagram: bytes) -> None:
        if self.other is other:
            other._link.datagram(other, datagram)
