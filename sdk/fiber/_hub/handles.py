"""Handles: how a channel or counter gets into another process.

To a process that is being started on the same host the descriptor itself goes along.
"""

from __future__ import annotations

import copyreg
from collections.abc import Sequence
from multiprocessing import context as mp_context
from typing import Any, Protocol

from fiber._hub.local import LocalChannel, LocalCounter
from fiber._transport.base import Channel, Counter
from fiber._wire.packet import BytesLike


class SharedChannel(Channel, Protocol):
    """A channel that a queue can use: it never has to wait."""

    def try_send(self, payload: BytesLike, buffers: Sequence[memoryview] = ()) -> bool:
        """Send one message if there is room for it now."""


class SharedCounter(Counter, Protocol):
    """A counter whose every change can be waited for."""

    def changed(self, since: int, timeout: float | None) -> bool:
        """Wait until the count is not ``since``; False when ``timeout`` is over."""


class Handle(Protocol):
    """What is pickled in place of a descriptor."""

    def detach(self) -> int:
        """In the other process: a descriptor of its own."""


def lend(end: Any) -> Any:
    spawning = mp_context.get_spawning_popen()
    return spawning.DupFd(spawning.duplicate_for_child(end.fileno()))


def channel(handle: Handle) -> SharedChannel:
    """In the other process: the channel that a handle stands for."""
    return LocalChannel.from_fd(handle.detach())


def counter(handle: Handle) -> SharedCounter:
    """In the other process: the counter that a handle stands for."""
    return LocalCounter(handle.detach())


def _reduce_channel(end: Any) -> tuple[Any, ...]:
    return channel, (lend(end),)


def _reduce_counter(end: Any) -> tuple[Any, ...]:
    return counter, (lend(end),)


copyreg.pickle(LocalChannel, _reduce_channel)
copyreg.pickle(LocalCounter, _reduce_counter)
