"""Handles: how a channel or counter gets into another process.

To a process that is being started on the same host the descriptor itself goes along.
"""

from __future__ import annotations

from typing import Any, Protocol

from multiprocessing import context as mp_context

from fiber._transport.base import Channel, Counter
from fiber._transport.unix import UnixChannel, UnixCounter


class Handle(Protocol):
    """What is pickled in place of a descriptor."""

    def detach(self) -> int:
        """In the other process: a descriptor of its own."""


def lend(end: Any) -> Any:
    spawning = mp_context.get_spawning_popen()
    return spawning.DupFd(spawning.duplicate_for_child(end.fileno()))


def channel(handle: Handle) -> Channel:
    return UnixChannel.from_fd(handle.detach())


def counter(handle: Handle) -> Counter:
    return UnixCounter(handle.detach())
