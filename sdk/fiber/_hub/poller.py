"""Readiness of a hub's descriptors, watched through one descriptor that the loop reads."""

from __future__ import annotations

import select
from collections.abc import Callable

from fiber._transport.loop import Loop

IN, OUT, EDGE = select.EPOLLIN, select.EPOLLOUT, select.EPOLLET


class Poller:
    """Calls back on the loop's thread with what is ready, for masks that change all the time."""

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self._epoll = select.epoll()
        self._watched: dict[int, tuple[int, Callable[[int], None]]] = {}
        loop.register(self._epoll.fileno(), self._ready)

    def watch(self, fd: int, mask: int, callback: Callable[[int], None]) -> None:
        """Call back when ``fd`` is ready as ``mask`` says, or at its end; 0 forgets it."""
        before, _ = self._watched.get(fd, (0, None))
        if not mask:
            if self._watched.pop(fd, None) is not None:
                self._epoll.unregister(fd)
            return
        self._watched[fd] = mask, callback
        if not before:
            self._epoll.register(fd, mask)
        elif before != mask or mask & EDGE:
            self._epoll.modify(fd, mask)

    def forget(self, fd: int) -> None:
        """Watch it no more; do it before it is closed."""
        if self._watched.pop(fd, None) is not None:
            self._epoll.unregister(fd)

    def close(self) -> None:
        """Watch nothing more."""
        self._loop.unregister(self._epoll.fileno())
        self._epoll.close()
        self._watched.clear()

    def _ready(self) -> None:
        for fd, events in self._epoll.poll(0):
            watched = self._watched.get(fd)
            if watched is not None:  # otherwise forgotten by an earlier one of these events
                watched[1](events)
